"""Whatever stands in a camera file, its reader gives a network or a SurveyError that names the file."""

from pathlib import Path
from typing import Any

import pytest

from survey.interop.cameras.colmap import read_colmap
from survey.interop.cameras.formats import COLMAP, KALIBR_TARGET, READERS, write_cameras
from tests.fuzz.mutate import Mutator, nonsense
from tests.sizes import size
from tests.survey.test_interop_fuzz import damaged, stands

COUNT = size(400)
_PLAIN = sorted(set(READERS) - set(COLMAP))


@pytest.fixture(scope="module")
def samples(lab: Any, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A file of every format, by format."""
    folder, out = tmp_path_factory.mktemp("samples"), {}
    for format in (*_PLAIN, *COLMAP):
        write_cameras(lab[1], folder / format, format, None)
        path = folder / format
        out[format] = path if format in COLMAP or path.is_file() else sorted(path.iterdir())[-1]
    return out


@pytest.mark.slow
@pytest.mark.parametrize("format", _PLAIN)
def test_damaged_files_are_refused_or_read(samples: dict[str, Path], tmp_path: Path, format: str) -> None:
    files = damaged(samples[format].read_text(encoding="utf-8")[:4000])
    for _ in range(COUNT):
        stands(READERS[format], tmp_path / "file", files.next())


@pytest.mark.parametrize("format", _PLAIN)
def test_any_bytes_are_refused_or_read(tmp_path: Path, format: str) -> None:
    files = nonsense(1, "{}[]:,'\"-&*!#%\n ab01.e")
    for _ in range(COUNT):
        stands(READERS[format], tmp_path / "file", next(files))


def _of_model(model: Path, name: str, files: Mutator) -> None:
    good = (model / name).read_bytes()
    for _ in range(COUNT):
        (model / name).write_bytes(files.next())
        stands(lambda path: read_colmap(path.parent), model / name)
    (model / name).write_bytes(good)


@pytest.mark.parametrize("name", ["cameras.bin", "rigs.bin", "frames.bin", "images.bin", "points3D.bin"])
def test_damaged_binary_models_are_refused_or_read(samples: dict[str, Path], name: str) -> None:
    _of_model(samples["colmap"], name, Mutator([(samples["colmap"] / name).read_bytes()], 1, is_text=False))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cameras.txt", "rigs.txt", "frames.txt", "images.txt", "points3D.txt"])
def test_damaged_text_models_are_refused_or_read(samples: dict[str, Path], name: str) -> None:
    _of_model(samples["colmap-text"], name, damaged((samples["colmap-text"] / name).read_text(encoding="utf-8")[:6000]))


def test_kalibrs_target_is_among_them(samples: dict[str, Path]) -> None:
    assert "checkerboard" in samples[KALIBR_TARGET].read_text(encoding="utf-8")
