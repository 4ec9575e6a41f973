"""Files that mean harm, folders that are interrupted or shared: refused with a message, nothing outside is touched."""

import io
import json
import os
import struct
import subprocess
import sys
import time
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from adjust.model.errors import SurveyError
from adjust.model.names import natural_key
from survey import project as files
from survey.cli import FAILED, main
from survey.detection.gray import image_size, read_image
from survey.folder.messages import message
from survey.folder.replacing import recover
from survey.folder.text import cell_text, id_problem, read_bytes
from survey.jobs.adjusting.job import adjust_job
from survey.project.declared.node import read_toml
from survey.project.tables.files import read_table, write_table
from survey.project.tables.reading import Layout, marks
from survey.solution.earlier.previous import read_previous
from survey.solution.residual_tables import other_residuals_csv
from tests.adjust.test_deformation import adjusted, chain, measured
from tests.fuzz.replaced import unfinished_project
from tests.fuzz.small import small_project

LAYOUT = Layout("some", ("a_id",), ("x_mm",))


@pytest.fixture
def small(tmp_path: Path) -> Path:
    small_project(tmp_path / "small")
    return tmp_path / "small"


def content(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


# what a killed run leaves, written by somebody else


@pytest.mark.parametrize(
    "entries",
    ['{"../victim": false}', '{"/tmp/x": false}', '{"": false}', '{".": false}', '{"observations/../../victim": false}',
     '{"observations\\\\..": false}', '[1]', '{"results": 1}', "{", "[" * 5000, '{".before": false}'],
)  # fmt: skip
def test_list_of_a_killed_run_reaches_nothing_outside(tmp_path: Path, entries: str) -> None:
    lab = unfinished_project(tmp_path, entries.encode())
    before = content(tmp_path)
    with pytest.raises(SurveyError, match=r"entries\.json: is no list that labsurvey has written"):
        recover(lab)
    assert content(tmp_path) == before


def test_list_of_a_killed_run_follows_no_link(tmp_path: Path) -> None:
    lab = unfinished_project(tmp_path, b'{"link/thesis.txt": false, "link": false}')
    (lab / "link").symlink_to(tmp_path / "victim")
    with pytest.raises(SurveyError):
        recover(lab)
    (lab / ".before" / "entries.json").write_text('{"link": false}')
    assert recover(lab)
    assert (tmp_path / "victim" / "thesis.txt").read_text() == "the only copy"
    assert not (lab / "link").is_symlink()


# files that are no files, or too large


def test_a_pipe_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "survey.toml")
    with pytest.raises(SurveyError, match="is a device, a pipe or a socket"):
        read_bytes(tmp_path / "survey.toml")


def test_a_file_of_petabytes_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "survey.toml"
    with path.open("wb") as stream:
        stream.truncate(2**40)  # takes no room on the disk
    begin = time.process_time()
    with pytest.raises(SurveyError, match="more than the 268 MB that are read"):
        read_toml(path)
    with pytest.raises(SurveyError, match="more than the 4295 MB that are read"):
        read_bytes(path)
    assert time.process_time() - begin < 1.0


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("format = 1\na" + ".a" * 100_000 + " = 1\n", ":2: a key has too many dots"),
        ("x = " + "9" * 10_000 + "\n", ":1: not valid TOML: Exceeds the limit"),
        ("\nx = 0x" + "f" * 10_000 + "\n", ":2: x: the number is too large to be meant"),
        ("x = " + "[" * 100_000, ":1: lists or tables are nested too deeply"),
        ("x = " + "{a=" * 100_000, ":1: lists or tables are nested too deeply"),
    ],
)
def test_toml_that_would_take_for_ever(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "survey.toml"
    path.write_text(text)
    begin = time.process_time()
    with pytest.raises(SurveyError) as caught:
        read_toml(path)
    assert said in str(caught.value)
    assert len(str(caught.value)) < 500
    assert time.process_time() - begin < 5.0


def test_numbers_too_large_to_be_meant(tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text("a_id,x_mm\nA,1\nB,1e200\n")
    with pytest.raises(SurveyError, match=r"t\.csv:3: x_mm: found '1e200'; too large to be meant"):
        read_table(tmp_path / "t.csv", LAYOUT)
    (tmp_path / "t.toml").write_text("x = 1e200\n")
    with pytest.raises(SurveyError, match="too large to be meant"):
        read_toml(tmp_path / "t.toml")[0].number("x")


def test_more_rows_than_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("survey.project.tables.reading.LARGEST_ROWS", 2)
    (tmp_path / "t.csv").write_text("a_id,x_mm\nA,1\nB,1\n")
    with pytest.raises(SurveyError, match="found 3 rows, at most 2 are read; split the survey"):
        read_table(tmp_path / "t.csv", LAYOUT)


@pytest.mark.slow
def test_a_billion_equal_rows_of_parquet(tmp_path: Path) -> None:
    """Run lengths make them a small file; they are counted before they are unpacked."""
    pa, pq = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    path = tmp_path / "t.parquet"
    rows = 4_000_000
    part = pa.table({"a_id": pa.array(["A"]).take(pa.array(np.zeros(rows, np.int8))), "x_mm": pa.array(np.zeros(rows))})
    with pq.ParquetWriter(path, part.schema, compression="zstd") as writer:
        for _ in range(13):
            writer.write_table(part)
    assert path.stat().st_size < 1_000_000
    with pytest.raises(SurveyError, match="found 52000000 rows, at most 50000000 are read"):
        read_table(path, LAYOUT)


@pytest.mark.parametrize(
    ("name", "said"),
    [("CON", "Windows has no files"), ("nul.txt", "Windows has no files"), ("a.", "Windows has no files"),
     ("..", "cannot be an id"), ("a/b", "cannot be an id"), ("a\x00", "cannot be an id"), ("x" * 121, "at most 120"),
     ("\u202eevil", "cannot be an id"), ("ö" * 61, "at most 120"), ("=1+1", "for a formula"), ("+A1", "for a formula"),
     ("-1", "for a formula"), ("@SUM(A1)", "cannot be an id")],
)  # fmt: skip
def test_ids_that_are_no_names_of_files(name: str, said: str) -> None:
    assert said in str(id_problem(name))


@pytest.mark.parametrize("text", ["=1+1", "+A1", "-A1", "@SUM(A1)", "\t=1", "\r=1"])
def test_no_cell_of_a_table_is_taken_for_a_formula(tmp_path: Path, text: str) -> None:
    """Refused where a table is read again, shown with an apostrophe where it is not; in projects made in Python too."""
    assert cell_text(text) == f"'{text}"
    assert [cell_text(x) for x in ("", "A1", "a=b", "1-2")] == ["", "A1", "a=b", "1-2"]
    with pytest.raises(SurveyError, match=r"distances: group: .*takes? what begins with"):
        write_table(tmp_path, "distances", {"group": ["ok", text], "value_m": np.array([-1.0, 2.0])})
    assert list(tmp_path.iterdir()) == []
    if text[0] in "\t\r":  # no cell that is read begins with these
        return
    path = tmp_path / "distances.csv"
    path.write_text(f'a_id,value_m,group\nA,1.0,image\nA,2.0,"{text}"\n', encoding="utf-8", newline="")
    table = read_table(path, Layout("distances", ("a_id",), ("value_m",), ("group",)))
    with pytest.raises(SurveyError, match=r"distances.csv:3: group: .* cannot be a name"):
        marks(table, "distance", {})


def test_residuals_of_evil_names_are_shown_as_text() -> None:
    survey = measured(chain(), np.random.default_rng(1))
    evil = replace(survey, pairs=(replace(survey.pairs[0], pair_id="=1+1", group="@x"), *survey.pairs[1:]))
    lines = b"".join(other_residuals_csv(adjusted(evil))).decode().splitlines()
    cells = next(line.split(",") for line in lines if "=1+1" in line)
    assert cells[1:3] == ["'@x", "'=1+1 station:S0 station:S1"]


def test_ids_of_every_language_are_fine() -> None:
    assert [id_problem(x) for x in ("Pfeiler_ä", "標的-1", "Станция", "P.1", "CONE", "x" * 120)] == [None] * 6
    assert natural_key("9" * 5000) > natural_key("8" * 5000)


# images


def claimed(width: int, height: int) -> dict[str, bytes]:
    """Heads that claim a size and hold nothing, by the formats' own specifications."""
    entry = struct.Struct("<HHII")
    tiff = b"II*\0" + struct.pack("<IH", 8, 2) + entry.pack(256, 4, 1, width) + entry.pack(257, 4, 1, height)
    frame = struct.pack(">BBHBHHB", 0xFF, 0xC0, 11, 8, min(height, 65535), min(width, 65535), 1)
    return {
        "a.png": b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sII", 13, b"IHDR", width, height) + b"\x08\0\0\0\0" + b"\0" * 4,
        "a.tif": tiff,
        "a.bmp": b"BM" + b"\0" * 12 + struct.pack("<Iii", 40, width, -height) + b"\x01\0\x08\0" + b"\0" * 24,
        "a.jpg": b"\xff\xd8\xff\xe0\0\x10" + b"\0" * 14 + frame,
    }


@pytest.mark.parametrize("name", ["a.png", "a.tif", "a.bmp", "a.jpg"])
def test_image_bombs(tmp_path: Path, name: str) -> None:
    data = claimed(100_000, 100_000)[name]
    (tmp_path / name).write_bytes(data)
    with pytest.raises(SurveyError, match=r"x \d+ px are more than 4e\+08"):
        read_image(tmp_path / name)
    assert image_size(claimed(640, 480)[name]) == (640, 480)


# results


def bomb(folder: Path, arrays: dict[str, bytes]) -> None:
    with zipfile.ZipFile(folder / "results" / "covariance.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in arrays.items():
            archive.writestr(f"{name}.npy", bytes(data))  # a number: as many zeros


def head(shape: str, dtype: str = "<f8") -> bytes:
    text = f"{{'descr': '{dtype}', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text.encode()


@pytest.mark.slow
@pytest.mark.parametrize(
    "arrays",
    [
        {"start": head("(1000000000000,)")},
        {"start": head("(2,)", "|O") + b"\0" * 99},
        {"start": 200_000_000},
        {"start": b"cos\nsystem\n(S'true'\ntR."},
        {"start": head("(2,)") + struct.pack("<2d", 0, 1e9)},
    ],
    ids=["shape", "objects", "zeros", "pickle", "doubles"],
)
def test_archives_that_mean_harm(small: Path, arrays: dict[str, bytes | int]) -> None:
    adjust_job(small, progress=False)
    project = files.read(small)
    bomb(small, arrays)
    with pytest.raises(SurveyError, match="cannot be read as a solution"):
        read_previous(project)


def test_arrays_of_objects_are_never_unpickled(small: Path, tmp_path: Path) -> None:
    class Harm:
        def __reduce__(self) -> tuple[object, tuple[str]]:
            return os.mkdir, (str(tmp_path / "harmed"),)

    adjust_job(small, progress=False)
    project = files.read(small)
    out = io.BytesIO()
    np.savez(out, start=np.array([Harm()], dtype=object))
    (small / "results" / "covariance.npz").write_bytes(out.getvalue())
    with pytest.raises(SurveyError, match="cannot be read as a solution"):
        read_previous(project)
    assert not (tmp_path / "harmed").exists()


@pytest.mark.slow
@pytest.mark.parametrize("text", ["[]", "{}", "null", "[" * 100_000, '{"inputs": 1}', "\x00", '{"summary": NaN}'])
def test_solutions_of_others(small: Path, text: str) -> None:
    adjust_job(small, progress=False)
    project = files.read(small)
    (small / "results" / "solution.json").write_text(text)
    with pytest.raises(SurveyError, match="cannot be read as a solution"):
        read_previous(project)


# the terminal, the page


def test_names_do_not_drive_the_terminal() -> None:
    assert message(SurveyError("x: found \x1b[2J\x07\u202e\nnext")) == "x: found \\x1b[2J\\x07\\u202e\nnext"


# locales, line ends, names


@pytest.mark.parametrize("name", ["Labor Süd", "実験室", "a b'c\"d", "лаборатория"])
def test_folders_of_any_name(tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]) -> None:
    small_project(tmp_path / name)
    assert main(["adjust", str(tmp_path / name), "--quiet", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["summary"]["redundancy"] == 6
    assert name[:3] in (tmp_path / name / "results" / "solution.json").read_text("utf-8")


def test_windows_line_ends_and_byte_order_marks(small: Path) -> None:
    plain = adjust_job(small, progress=False).solution["summary"]["sigma0"]
    for path in (small / "survey.toml", small / "observations" / "pairs.csv"):
        path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes().replace(b"\n", b"\r\n"))
    assert adjust_job(small, progress=False).solution["summary"]["sigma0"] == plain


@pytest.mark.slow
@pytest.mark.parametrize("locale", ["C", "tr_TR.UTF-8"])
def test_odd_locales(small: Path, locale: str) -> None:
    """A folder with names of another alphabet, where the terminal knows ASCII alone."""
    folder = small.rename(small.parent / "Labor Süd")
    text = (folder / "survey.toml").read_text("utf-8")
    (folder / "survey.toml").write_text('title = "Größe"\n' + text, encoding="utf-8")
    environment = {**os.environ, "LC_ALL": locale, "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    command = [sys.executable, "-m", "survey", "adjust", str(folder), "--quiet"]
    done = subprocess.run(command, env=environment, capture_output=True, cwd=Path(__file__).parents[2], check=False)
    assert b"Traceback" not in done.stderr
    assert done.returncode == 0, done.stderr


# folders that cannot be written


def test_results_that_cannot_be_written(small: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """As a full disk or a read-only folder does; root may write everywhere, so a file stands in the way."""
    (small / "results").write_text("not a folder")
    before = content(small)
    assert main(["adjust", str(small), "--quiet"]) == FAILED
    assert "results" in capsys.readouterr().err
    assert content(small) == before
