"""CSV text into columns of texts, chunk by chunk, taken apart by the interpreter's C code."""

import contextlib
import csv
import io
import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from adjust.model.errors import SurveyError
from adjust.model.survey import IntArray

CHUNK = 65536
Chunk = tuple[IntArray, Sequence[Sequence[str]]]


def csv_chunks(path: Path, text: str) -> tuple[list[str], Iterator[Chunk]]:
    """The header, and the rows after it: the line of each row, and the columns. Raises SurveyError for broken rows."""
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    try:
        header = next(reader)
    except csv.Error as error:
        raise SurveyError(f"{path}:1: not a CSV line ({error}); correct the quotes") from error
    return header, _plain_columns(text, len(header)) or _quoted_columns(path, text, reader, len(header))


def _plain_columns(text: str, n: int) -> Iterator[Chunk] | None:
    """Lines and columns of a text without quotes, blank lines or wrong lengths, chunk by chunk; None for any other."""
    if '"' in text or n < 2:
        return None
    body = text.replace("\r\n", "\n").rstrip("\n").encode()
    ends = np.flatnonzero(np.frombuffer(body, np.uint8) == ord("\n"))
    commas = np.flatnonzero(np.frombuffer(body, np.uint8) == ord(","))
    counts = np.diff(np.searchsorted(commas, np.r_[0, ends, len(body)]))
    if b"\r" in body or (counts != n - 1).any():
        return None
    return _split(body, ends, n)


def _split(body: bytes, ends: IntArray, n: int) -> Iterator[Chunk]:
    """Columns of the lines after the first; one list per chunk and no list per row keeps the garbage collector out."""
    starts = (ends + 1).tolist()
    for first in range(0, len(starts), CHUNK):
        stop = starts[first + CHUNK] - 1 if first + CHUNK < len(starts) else len(body)
        fields = body[starts[first] : stop].decode().replace("\n", ",").split(",")
        yield np.arange(first + 2, first + 2 + len(fields) // n), [fields[i::n] for i in range(n)]


def _quoted_columns(path: Path, text: str, reader: Any, n: int) -> Iterator[Chunk]:
    """The same for any CSV, through the csv module; raises where a row has a wrong length."""
    line = reader.line_num + 1
    while rows := _next_rows(path, text, reader):
        lines = np.arange(line, line + len(rows))
        _check_lengths(path, rows, lines, n, reader.line_num)
        line += len(rows)
        filled = np.fromiter(map(bool, rows), bool, len(rows))
        if filled.any():
            yield lines[filled], list(zip(*filter(None, rows), strict=True))


def _next_rows(path: Path, text: str, reader: Any) -> list[list[str]]:
    try:
        return list(itertools.islice(reader, CHUNK))
    except csv.Error as error:
        raise SurveyError(f"{path}:{_last_start(text)}: not a CSV line ({error}); correct the quotes") from error


def _check_lengths(path: Path, rows: list[list[str]], lines: IntArray, n: int, last_line: int) -> None:
    if not set(map(len, rows)) <= {0, n}:
        i = next(i for i, row in enumerate(rows) if len(row) not in (0, n))
        hint = "; numbers have a decimal point, not a comma" if len(rows[i]) > n else ""
        raise SurveyError(f"{path}:{lines[i]}: found {len(rows[i])} fields, expected {n} as in the first line{hint}")
    if last_line != lines[-1]:
        i = next(i for i, row in enumerate(rows) if any("\n" in field or "\r" in field for field in row))
        raise SurveyError(f"{path}:{lines[i]}: a quoted field runs over the end of the line; close its quotes")


def _last_start(text: str) -> int:
    """The line on which the row begins that the csv module cannot read."""
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    line = 1
    with contextlib.suppress(csv.Error):
        for _ in reader:
            line = reader.line_num + 1
    return line
