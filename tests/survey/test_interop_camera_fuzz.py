"""Whatever stands in a camera file, its reader gives a network or a SurveyError that names the file."""

import shutil
import tempfile

import pytest
from hypothesis import HealthCheck, configuration, given, settings
from hypothesis import strategies as st

from survey.interop.cameras.colmap import read_colmap
from survey.interop.cameras.formats import COLMAP, KALIBR_TARGET, READERS, write_cameras
from tests.sizes import size
from tests.survey.test_interop_fuzz import _damaged, _message

configuration.set_hypothesis_home_dir(tempfile.gettempdir())
_QUICK = settings(
    max_examples=size(40, 15), deadline=None, database=None, derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow, HealthCheck.data_too_large],
)  # fmt: skip
_PLAIN = sorted(set(READERS) - set(COLMAP))


@pytest.fixture(scope="module")
def samples(lab, tmp_path_factory):
    """A file of every format, by format."""
    folder, out = tmp_path_factory.mktemp("samples"), {}
    for format in (*_PLAIN, *COLMAP):
        write_cameras(lab[1], folder / format, format, None)
        path = folder / format
        out[format] = path if format in COLMAP or path.is_file() else sorted(path.iterdir())[-1]
    return out


def _try(read, path):
    message = _message(read, path)
    assert message is None or str(path.parent) in message


@pytest.mark.slow
@pytest.mark.parametrize("format", _PLAIN)
def test_damaged_files_are_refused_or_read(samples, tmp_path, format):
    text = samples[format].read_text(encoding="utf-8")
    path = tmp_path / "file"

    @_QUICK
    @given(st.data())
    def run(data):
        path.write_bytes(data.draw(_damaged(text[:4000])).encode("utf-8", "surrogatepass"))
        _try(READERS[format], path)

    run()


@pytest.mark.parametrize("format", _PLAIN)
def test_any_bytes_are_refused_or_read(tmp_path, format):
    path = tmp_path / "file"

    @_QUICK
    @given(st.binary(max_size=200) | st.text(alphabet="{}[]:,'\"-&*!#%\n ab01.e", max_size=80).map(str.encode))
    def run(data):
        path.write_bytes(data)
        _try(READERS[format], path)

    run()


@pytest.mark.parametrize("name", ["cameras.bin", "rigs.bin", "frames.bin", "images.bin", "points3D.bin"])
def test_damaged_binary_models_are_refused_or_read(samples, tmp_path, name):
    copy = tmp_path / "model"
    shutil.copytree(samples["colmap"], copy)
    good = (copy / name).read_bytes()

    @_QUICK
    @given(st.integers(0, len(good) - 1), st.binary(max_size=9), st.booleans())
    def run(at, new, cut):
        (copy / name).write_bytes(good[:at] if cut else good[:at] + new + good[at + len(new) :])
        _try(lambda _: read_colmap(copy), copy / name)

    run()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cameras.txt", "rigs.txt", "frames.txt", "images.txt", "points3D.txt"])
def test_damaged_text_models_are_refused_or_read(samples, tmp_path, name):
    copy = tmp_path / "model"
    shutil.copytree(samples["colmap-text"], copy)
    good = (copy / name).read_text(encoding="utf-8")

    @_QUICK
    @given(st.data())
    def run(data):
        (copy / name).write_bytes(data.draw(_damaged(good[:6000])).encode("utf-8", "surrogatepass"))
        _try(lambda _: read_colmap(copy), copy / name)

    run()


def test_kalibrs_target_is_among_them(samples):
    assert "checkerboard" in samples[KALIBR_TARGET].read_text(encoding="utf-8")
