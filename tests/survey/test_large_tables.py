"""Tables of many rows go through Arrow: the same values to the bit, the same text to the letter, the same errors."""

import csv
import io
import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from adjust.model.errors import SurveyError
from survey.project.tables import arrow as arrow_columns
from survey.project.tables import files as table_reading
from survey.project.tables.arrow import csv_bytes, csv_columns
from survey.project.tables.files import read_table, write_table
from survey.project.tables.image_points import _distinct, one_code
from survey.project.tables.reading import Layout, Table, TextColumn
from tests.fuzz.mutate import nonsense

LAYOUT = Layout("t", ("a_id",), ("x_mm",), ("group",), ("sigma_mm",))
HEADER = "a_id,x_mm,group,sigma_mm\n"
CELLS = [1.5, -0.0, 0.1 + 0.2, 5e-324, 2.2250738585072014e-308, 1e15, -1e15, 123456789.12345678, 900719925474099.3]


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Tables of any size go through Arrow, in many blocks."""
    monkeypatch.setattr(arrow_columns, "LARGE", 0)
    monkeypatch.setattr(arrow_columns, "_BLOCK", 4096)
    monkeypatch.setattr(arrow_columns, "_ROWS", 100)


def _by_rows(path: Path, monkeypatch: pytest.MonkeyPatch) -> Table | str:
    with monkeypatch.context() as patched:
        patched.setattr(table_reading, "csv_columns", lambda *_: None)
        return _read(path)


def _read(path: Path) -> Table | str:
    try:
        return read_table(path, LAYOUT)
    except SurveyError as error:
        return str(error)


def _same(one: Table | str, other: Table | str) -> bool:
    if isinstance(one, str) or isinstance(other, str):
        return one == other
    names = all(one.text(c).names == other.text(c).names for c in ("a_id", "group"))
    codes = all(one.text(c).codes.tobytes() == other.text(c).codes.tobytes() for c in ("a_id", "group"))
    numbers = all(one.numbers(c).tobytes() == other.numbers(c).tobytes() for c in ("x_mm", "sigma_mm"))
    return names and codes and numbers and one.lines.tobytes() == other.lines.tobytes() and one.digest == other.digest


def _plain(n: int = 500) -> str:
    rng = np.random.default_rng(3)
    numbers = [*CELLS, *(rng.normal(size=n) * 10.0 ** rng.integers(-300, 15, n)).tolist()]
    return HEADER + "".join(
        f"p{i % 37}ä,{x!r},{'' if i < n / 2 else f'g{-i % 5}'},{'' if i % 3 else repr(abs(x))}\n"
        for i, x in enumerate(numbers)
    )


@pytest.mark.usefixtures("small")
@pytest.mark.parametrize(
    "change",
    [lambda t: t, lambda t: "\ufeff" + t, lambda t: t.replace("\n", "\r\n"), lambda t: t.rstrip("\n")],
    ids=["plain", "byte order mark", "lines of Windows", "no last end"],
)
def test_arrow_reads_the_same_bits(change, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "t.csv"
    path.write_bytes(change(_plain()).encode())
    assert csv_columns(path.read_bytes(), LAYOUT) is not None  # else nothing would be compared
    assert _same(_read(path), _by_rows(path, monkeypatch))


ODD = [
    "p,+1.5,,", "p,1_000,,", "p,nan,,", "p,NaN,,", "p,inf,,", "p,-Infinity,,", "p, 1.5 ,,", "p,\u0661,,", "p,0x10,,",
    "p,1e400,,", "p,1e16,,", "p,,,", ",1.5,,", "p,NULL,,", "p,#N/A,,", "p,1.5,,NA", "p,1.5,,null", "p,1.5,NULL,",
    "p,1.5", "p,1,5,,", '"p",1.5,,', "", "p,1.5,,\r", "p,1.5,\x00,", "p,.5,,", "p,5.,,", "p,1E5,,", "p,1d5,,", "p,1e,,",
    "p,-,,", "p,1.5,,\u00a02", "p,1.5f,,", "p,True,,", " p ,1.5, ,", "p,1e-400,,", "p,00012.50,,", "NULL,1.5,nan,",
]  # fmt: skip


@pytest.mark.usefixtures("small")
@pytest.mark.parametrize("line", ODD)
@pytest.mark.parametrize("at", [0, -1])
def test_odd_rows_are_taken_or_refused_as_row_by_row(
    line: str, at: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = [f"p{i},{i}.25,," for i in range(200)]
    rows.insert(at % 200, line)
    path = tmp_path / "t.csv"
    path.write_bytes((HEADER + "\n".join(rows) + "\n").encode())
    assert _same(_read(path), _by_rows(path, monkeypatch))


@pytest.mark.usefixtures("small")
@pytest.mark.parametrize(
    "data",
    [b"", b"a_id,x_mm\n", b"a_id\np\n", b"a_id,x_mm,x_mm\np,1,2\n", b"a_id,y_mm\np,1\n", b"x_mm,group\n1,g\n",
     b"a_id,x_mm\np,1\nq\xff,2\n", b"a_id,x_mm\np,1\r\nq,2\n", b"a_id,x_mm\np,1\rq,2\n", b"a_id,x_mm\n\n\np,1\n",
     b"a_id,x_mm\np,1\n\n\n", b"\xff\xfea\x00"],
)  # fmt: skip
def test_odd_files_are_taken_or_refused_as_row_by_row(
    data: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "t.csv"
    path.write_bytes(data)
    assert _same(_read(path), _by_rows(path, monkeypatch))


def test_arrow_writes_what_the_csv_module_writes() -> None:
    """Doubles of any bits, everyday ones and special ones; words of any characters, and of those that matter."""
    rng, scraps = np.random.default_rng(6), nonsense(6, ",\"'\r\n\t =+-@;0e")
    for _ in range(200):
        n = int(rng.integers(1, 31))
        drawn = np.stack([rng.integers(0, 2**64, n, dtype=np.uint64).view(float), rng.integers(-9999, 9999, n) / 8.0,
                          rng.choice([*CELLS, 0.0, np.nan, np.inf, -np.inf], n)])  # fmt: skip
        numbers = drawn[rng.integers(0, 3, n), np.arange(n)].tolist()
        words = [next(scraps).decode(errors="ignore")[: rng.integers(0, 9)] for _ in range(rng.integers(1, 6))]
        _written_alike(numbers, words)


def _written_alike(numbers: list[float], words: list[str]) -> None:
    texts = [words[i % len(words)] for i in range(len(numbers))]
    index = dict.fromkeys(texts)
    coded = TextColumn(tuple(index), np.array([list(index).index(t) for t in texts]))
    finite = np.array([x if math.isfinite(x) else math.nan for x in numbers])
    out = io.StringIO(newline="")
    cells = [repr(x) if math.isfinite(x) else "" for x in numbers]
    csv.writer(out, lineterminator="\n").writerows(zip(texts, cells, texts, strict=True))
    assert csv_bytes({"a": texts, "x": finite, "b": coded}).decode() == out.getvalue()


def test_arrow_writes_numbers_of_every_size_as_python_does() -> None:
    rng = np.random.default_rng(5)
    powers = np.array([float(f"1e{k}") for k in range(-320, 308)])
    values = np.concatenate([powers, np.nextafter(powers, 0), powers * rng.uniform(1, 10, powers.size), -powers])
    assert csv_bytes({"x": values, "y": values}).decode().splitlines() == [f"{v!r},{v!r}" for v in values.tolist()]


@pytest.mark.slow
@pytest.mark.usefixtures("small")
def test_a_large_table_comes_back_as_it_was_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(4)
    values = np.r_[CELLS, rng.normal(size=60_000)]
    sigma = np.where(rng.random(len(values)) < 0.3, math.nan, np.abs(values))
    ids = [f"p{i % 999}" for i in range(len(values))]
    columns = {"a_id": ids, "x_mm": values, "sigma_mm": sigma}
    path = write_table(tmp_path, "t", columns)
    monkeypatch.setattr("survey.project.tables.files.LARGE", 2**60)
    assert write_table(tmp_path / "rows", "t", columns).read_bytes() == path.read_bytes()
    table = _read(path)
    assert isinstance(table, Table)
    assert _same(table, _by_rows(path, monkeypatch))
    assert table.numbers("x_mm").tobytes() == values.tobytes()
    assert table.text("a_id").values() == ids


@pytest.mark.slow
def test_a_small_table_loads_no_arrow_and_a_large_one_no_pandas(tmp_path: Path) -> None:
    for name, n in (("small", 100), ("large", 150_000)):
        (tmp_path / f"{name}.csv").write_text(HEADER + "p1,1.25,g,0.125\n" * n)
    code = """
import sys
from pathlib import Path
from survey.project.tables.files import read_table, write_table
from survey.project.tables.image_points import _distinct, one_code
from survey.project.tables.reading import Layout
layout = Layout("t", ("a_id",), ("x_mm",), ("group",), ("sigma_mm",))
for name, seldom, parquet in (("small", "pyarrow", False), ("large", "pandas", False), ("large", "pandas", True)):
    table = read_table(Path(sys.argv[1]) / f"{name}.csv", layout)
    write_table(Path(sys.argv[1]) / "out", name, {**table.text_columns, **table.number_columns}, parquet=parquet)
    assert seldom not in sys.modules
assert "pyarrow" in sys.modules
"""
    subprocess.run([sys.executable, "-c", code, str(tmp_path)], check=True, cwd=Path(__file__).parents[2])


@pytest.mark.parametrize("largest", [5, 2**40])
def test_rows_in_the_order_of_several_codes(largest: int) -> None:
    """Whether their product fits into a number or not; codes as the other way to number them has them."""
    rng = np.random.default_rng(1)
    codes = [rng.choice(np.array([0, 1, 2, largest]), 500) for _ in range(3)]
    code = one_code(*codes)
    order = np.argsort(code, kind="stable")
    np.testing.assert_array_equal(order, np.lexsort(codes[::-1]))
    rows, same = np.stack(codes, axis=1)[order], np.diff(code[order]) == 0
    np.testing.assert_array_equal(same, (rows[1:] == rows[:-1]).all(axis=1))
    assert same.any()
    for some in (codes[0], codes[0] % 7, np.zeros(0, dtype=np.int64)):
        expected = np.unique(some, return_index=True, return_inverse=True)
        for a, b in zip(_distinct(some), expected, strict=True):
            np.testing.assert_array_equal(a, b)
