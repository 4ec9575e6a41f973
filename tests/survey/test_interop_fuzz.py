"""Whatever stands in a file, a reader gives a network or a SurveyError that names the file, and nothing else."""

from collections.abc import Callable
from pathlib import Path

import pytest

from adjust.model.errors import SurveyError
from survey.jobs.converting import READERS
from tests.fuzz.mutate import Mutator, nonsense
from tests.sizes import size
from tests.survey.interop_samples import AICON, CSV, DBAT, DBAT_FILES, GKF, KRUMM, LGC

pytestmark = pytest.mark.slow

COUNT = size(400)
_SAMPLES = {"gama": GKF, "krumm": KRUMM, "lgc": LGC, "csv": CSV, "dbat": DBAT}


def stands(read: Callable[[Path], object], path: Path, data: bytes | None = None) -> None:
    """Reads a file, in which something is written before; what is said against it names its folder."""
    if data is not None:
        path.write_bytes(data)
    assert str(path.parent) in _said_against(read, path)


def _said_against(read: Callable[[Path], object], path: Path) -> str:
    try:
        read(path)
    except SurveyError as error:
        return str(error)
    return str(path)


def damaged(text: str) -> Mutator:
    """Endless damaged versions of a good file."""
    return Mutator([text.encode()], 1, is_text=True)


@pytest.mark.parametrize("name", list(_SAMPLES))
def test_damaged_files(tmp_path: Path, name: str) -> None:
    for file, content in DBAT_FILES.items():
        (tmp_path / file).write_text(content, encoding="utf-8")
    files = damaged(_SAMPLES[name])
    for _ in range(COUNT):
        stands(READERS[name], tmp_path / "net.file", files.next())


@pytest.mark.parametrize("ending", ["phc", "ior", "eor", "obc", "scale"])
def test_damaged_files_of_aicon(tmp_path: Path, ending: str) -> None:
    for file, content in AICON.items():
        (tmp_path / file).write_text(content, encoding="utf-8")
    files = damaged(AICON[f"net.{ending}"])
    for _ in range(COUNT):
        (tmp_path / f"net.{ending}").write_bytes(files.next())
        stands(READERS["aicon"], tmp_path / "net.phc")


@pytest.mark.parametrize("file", list(DBAT_FILES))
def test_damaged_tables_of_dbat(tmp_path: Path, file: str) -> None:
    for name, content in DBAT_FILES.items():
        (tmp_path / name).write_text(content, encoding="utf-8")
    (tmp_path / "net.xml").write_text(DBAT, encoding="utf-8")
    files = damaged(DBAT_FILES[file])
    for _ in range(COUNT):
        (tmp_path / file).write_bytes(files.next())
        stands(READERS["dbat"], tmp_path / "net.xml")


@pytest.mark.parametrize("name", [n for n in READERS if n != "aicon"])
def test_anything_at_all(tmp_path: Path, name: str) -> None:
    files = nonsense(1)
    for _ in range(COUNT):
        stands(READERS[name], tmp_path / "net.file", next(files))
