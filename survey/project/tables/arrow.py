"""Columns of large CSV tables and of Parquet files, by Arrow: the same doubles, to the bit, as Python reads and writes.

What Arrow does not read as Python would (or not at all) is left to the readers that say what is wrong and where.
"""

import io
import re
import sys
from collections.abc import Iterable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from adjust.model.arrays import BoolArray, FloatArray
from adjust.model.errors import SurveyError
from adjust.native.parallel import side_by_side
from survey.folder.ahead import LARGE
from survey.folder.text import LARGEST_NUMBER, csv_text, utf8
from survey.project.tables.reading import LARGEST_ROWS, Columns, Layout, TextColumn, check_header, check_rows, first_row

_WORTHWHILE = 2**14  # bytes of CSV once it is loaded
_LARGEST_DECODED = 8 * 2**30  # bytes of the columns of a Parquet file
_PIECE, _BLOCK, _ROWS = 2**22, 2**20, 2**17  # bytes of a thread, bytes read, rows written at a time
_PLAIN = re.compile(r"[\w.:/+-]+").fullmatch  # names that need no quotes in CSV
_ALIKE = (1e-4, 1e9)  # between these Arrow writes doubles as Python does, but for whole numbers


def csv_columns(data: bytes, layout: Layout) -> dict[str, TextColumn | FloatArray] | None:
    """The columns of a plain, faultless CSV table of many rows; None for any other, which is to be read row by row.

    Plain: no quotes, no blank line.
    """
    if len(data) < (min(_WORTHWHILE, LARGE) if "pyarrow" in sys.modules else LARGE) or b'"' in data:
        return None
    begin = data.find(b"\n") + 1
    header = data[: begin - 1].decode("utf-8-sig", "replace").rstrip("\r").split(",")
    if not set(layout.required) <= set(header) <= set(layout.columns) or not len(set(header)) == len(header) > 1:
        return None
    import pyarrow as pa
    from pyarrow import csv as arrow_csv

    types = {name: pa.dictionary(pa.int32(), pa.string()) if layout.is_text(name) else pa.float64() for name in header}
    whole = pa.py_buffer(data)

    def rows(ends: tuple[int, int]) -> Any:
        first, last = ends
        return arrow_csv.read_csv(
            pa.BufferReader(whole.slice(first, last - first)),
            arrow_csv.ReadOptions(use_threads=False, block_size=_BLOCK, column_names=header),
            arrow_csv.ParseOptions(quote_char=False, ignore_empty_lines=False),
            arrow_csv.ConvertOptions(column_types=types, null_values=[""], strings_can_be_null=False),
        )

    try:
        read = pa.concat_tables(side_by_side(rows, _pieces(data, begin))).unify_dictionaries()
    except (pa.ArrowException, OSError, ValueError):
        return None
    if read.num_rows > LARGEST_ROWS:
        return None
    found = side_by_side(lambda name: _text(read[name]) if layout.is_text(name) else _numbers(read[name]), header)
    out = {name: column for name, column in zip(header, found, strict=True) if column is not None}
    if len(out) < len(header) or any(_has_blank(out[name]) for name in layout.required):
        return None
    return out


def _pieces(data: bytes, begin: int) -> list[tuple[int, int]]:
    """Where pieces of whole rows begin and end."""
    ends = [begin]
    while ends[-1] < len(data):
        found = data.find(b"\n", ends[-1] + _PIECE)
        ends.append(found + 1 if found >= 0 else len(data))
    return list(pairwise(ends))


def _text(column: Any) -> TextColumn:
    names = tuple(column.chunk(0).dictionary.to_pylist()) if column.num_chunks else ()
    codes = [_values(chunk.indices, np.int32) for chunk in column.chunks]
    return TextColumn(names, np.concatenate([np.zeros(0, np.int64), *codes]))


def _numbers(column: Any) -> FloatArray | None:
    """Doubles, nan where blank; None where one is not finite or too large."""
    values = np.concatenate([np.zeros(0), *(_values(chunk, np.float64) for chunk in column.chunks)])
    if column.null_count:
        blank = np.concatenate([_blank(chunk) for chunk in column.chunks])
        values[blank] = 0.0
    if values.size and not max(values.max(), -values.min()) <= LARGEST_NUMBER:
        return None
    if column.null_count:
        values[blank] = np.nan
    return values


def _values(array: Any, kind: type[np.generic]) -> npt.NDArray[Any]:
    """What an array of Arrow holds, without ``to_numpy``, which loads pandas."""
    size = np.dtype(kind).itemsize
    return np.frombuffer(array.buffers()[1], kind, len(array), array.offset * size)


def _blank(array: Any) -> BoolArray:
    bits = array.buffers()[0]
    if bits is None:
        return np.zeros(len(array), bool)
    valid = np.unpackbits(np.frombuffer(bits, np.uint8), bitorder="little")[array.offset :][: len(array)]
    return ~valid.astype(bool)


def _array(values: npt.NDArray[Any], kind: Any, blank: BoolArray | None = None) -> Any:
    """The inverse of both."""
    import pyarrow as pa

    valid = None if blank is None else pa.py_buffer(np.packbits(~blank, bitorder="little"))
    held = np.packbits(values, bitorder="little") if values.dtype == bool else np.ascontiguousarray(values)
    return pa.Array.from_buffers(kind, len(values), [valid, pa.py_buffer(held)])


def _has_blank(column: TextColumn | FloatArray) -> bool:
    return "" in column.names if isinstance(column, TextColumn) else bool(np.isnan(column).any())


def csv_bytes(columns: Columns) -> bytes:
    """Rows of CSV without their header, as the csv module writes them; nan is blank."""
    import pyarrow.compute as pc

    comma, nothing, end = _strings((",", "", "\n"))
    arrays = [_dictionary(c) if isinstance(c, TextColumn) else c for c in map(_coded, columns.values())]

    def rows(first: int) -> bytes:
        texts = [_number_texts(c[first : first + _ROWS]) if isinstance(c, np.ndarray)
                 else c.slice(first, _ROWS).dictionary_decode() for c in arrays]  # fmt: skip
        found = pc.binary_join_element_wise(pc.binary_join_element_wise(*texts, comma), nothing, end)
        _, ends, data = found.buffers()
        return bytes(data.slice(0, int(np.frombuffer(ends, np.int32)[len(found)])))

    return b"".join(side_by_side(rows, range(0, len(arrays[0]), _ROWS)))


def _coded(column: Sequence[str] | TextColumn | FloatArray) -> TextColumn | FloatArray:
    if isinstance(column, TextColumn | np.ndarray):
        return column
    index = {name: i for i, name in enumerate(dict.fromkeys(column))}
    return TextColumn(tuple(index), np.fromiter(map(index.__getitem__, column), np.int64, len(column)))


def _dictionary(column: TextColumn) -> Any:
    """A column of texts for Arrow, quoted as the csv module does."""
    import pyarrow as pa

    return pa.DictionaryArray.from_arrays(_array(column.codes, pa.int64()), _strings(map(_quoted, column.names)))


def _quoted(name: str) -> str:
    if _PLAIN(name):
        return name
    return csv_text([(name, "")]).removesuffix(",\n")  # a row of one blank would be quoted


def _strings(texts: Iterable[str]) -> Any:
    """Texts for Arrow: ``pyarrow.array``, or a text given to its functions, loads pandas."""
    import pyarrow as pa

    held = [utf8(text) for text in texts]
    ends = np.cumsum([0, *map(len, held)], dtype=np.int32)
    return pa.StringArray.from_buffers(len(held), pa.py_buffer(ends), pa.py_buffer(b"".join(held)))


def _number_texts(values: FloatArray) -> Any:
    """What Python writes for doubles: by Arrow, and by Python where the two differ; blank for nan."""
    import pyarrow as pa
    import pyarrow.compute as pc

    texts = pc.cast(_array(values, pa.float64(), np.isnan(values)), pa.string())
    least, largest = _ALIKE
    own = (values == np.rint(values)) | (np.abs(values) < least) | (np.abs(values) >= largest)
    if own.any():
        texts = pc.replace_with_mask(texts, _array(own, pa.bool_()), _strings(map(repr, values[own].tolist())))
    return pc.fill_null(texts, _strings(("",))[0])


def parquet_bytes(columns: Columns) -> bytes:
    """A Parquet file: doubles, nan as null, and texts by their different names."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    arrays = {
        name: _array(column, pa.from_numpy_dtype(column.dtype), np.isnan(column))
        if isinstance(column, np.ndarray)
        else _strings(column.names).take(_array(column.codes, pa.int64())).dictionary_encode()
        for name, column in zip(columns, map(_coded, columns.values()), strict=True)
    }
    stream = io.BytesIO()
    pq.write_table(pa.table(arrays), stream)
    return stream.getvalue()


def parquet_columns(path: Path, data: bytes, layout: Layout) -> dict[str, TextColumn | FloatArray]:
    """The columns of a Parquet file. Raises SurveyError with file and row for whatever does not fit the layout."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        file = pq.ParquetFile(pa.BufferReader(data))
        check_rows(path, file.metadata.num_rows)
        sizes = (file.metadata.row_group(i).total_byte_size for i in range(file.metadata.num_row_groups))
        if sum(sizes) > _LARGEST_DECODED:
            raise SurveyError(f"{path}: its columns take more than {_LARGEST_DECODED >> 30} GB; split the survey")
        check_header(path, file.schema_arrow.names, layout)
        content = file.read()
        content.validate(full=True)
    except (pa.ArrowException, OSError, ValueError, MemoryError) as error:
        raise SurveyError(f"{path}:1: not a Parquet file ({error}); write it again") from error
    check_header(path, content.column_names, layout)
    out: dict[str, TextColumn | FloatArray] = {}
    for name in content.column_names:
        array = content[name].combine_chunks()
        columns_of = _parquet_text if layout.is_text(name) else _parquet_numbers
        out[name] = columns_of(path, name, array, name in layout.required)
    return out


def _parquet_text(path: Path, name: str, array: Any, is_required: bool) -> TextColumn:
    import pyarrow as pa

    value_type = array.type.value_type if pa.types.is_dictionary(array.type) else array.type
    if not (pa.types.is_string(value_type) or pa.types.is_large_string(value_type)):
        raise SurveyError(f"{path}:1: {name}: the column holds {value_type}, expected text; write it as strings")
    column = array.cast(value_type).fill_null("").dictionary_encode()
    try:
        names = tuple(column.dictionary.to_pylist())
    except ValueError as error:
        raise SurveyError(f"{path}:1: {name}: a text is not UTF-8 ({error}); write it again") from error
    codes = np.asarray(column.indices.to_numpy(zero_copy_only=False), dtype=np.int64)
    if is_required and "" in names:
        raise SurveyError(f"{path}:{first_row(codes == names.index('')) + 1}: {name}: is blank; fill it in")
    return TextColumn(names, codes)


def _parquet_numbers(path: Path, name: str, array: Any, is_required: bool) -> FloatArray:
    import pyarrow as pa

    if not (pa.types.is_floating(array.type) or pa.types.is_integer(array.type)):
        raise SurveyError(f"{path}:1: {name}: the column holds {array.type}, expected numbers; write it as doubles")
    blank = np.asarray(array.is_null().to_numpy(zero_copy_only=False), dtype=bool)
    values = np.array(array.cast(pa.float64()).fill_null(0.0).to_numpy(zero_copy_only=False), dtype=float)
    bad = ~(np.abs(values) <= LARGEST_NUMBER) | (blank & is_required)
    if bad.any():
        row = first_row(bad)
        found = "is blank; fill it in" if blank[row] else f"found {values[row]}; it must be a finite number"
        raise SurveyError(f"{path}:{row + 1}: {name}: {found}")
    values[blank] = np.nan
    return values
