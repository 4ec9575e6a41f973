"""Whatever stands in a file, a reader gives a network or a SurveyError that names the file, and nothing else."""

import re
import tempfile

import pytest
from hypothesis import HealthCheck, configuration, given, settings
from hypothesis import strategies as st

from adjust.model.errors import SurveyError
from survey.jobs.converting import READERS
from tests.sizes import size
from tests.survey.interop_samples import AICON, CSV, DBAT, DBAT_FILES, GKF, KRUMM, LGC

pytestmark = pytest.mark.slow

# no folder of its own among the sources
configuration.set_hypothesis_home_dir(tempfile.gettempdir())
_QUICK = settings(
    max_examples=size(80, 20), deadline=None, database=None, derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)  # fmt: skip
_SAMPLES = {"gama": GKF, "krumm": KRUMM, "lgc": LGC, "csv": CSV, "dbat": DBAT}
_WORD = re.compile(r"[^\s<>=\"',]+")
# words that are near to right, and some that are far from it
_REPLACEMENTS = st.sampled_from(
    ["", "0", "-1", "nan", "inf", "1e400", "1e-400", "1_0", "A", "B", "xyz", "XYZ", "360-00-00", "-0-0-0", "°", "\x00",
     "9" * 400, "é", "<", "&amp;", "&x;", "[Datum]", "*END", "/", "\\", "%", "..", "1e15", "0.0000001", "٣", "²"]
)  # fmt: skip


@st.composite
def _damaged(draw, text):
    """A file with some of its words replaced, or lines lost, doubled or cut."""
    for _ in range(draw(st.integers(1, 4))):
        words = list(_WORD.finditer(text))
        lines = text.split("\n")
        what = draw(st.integers(0, 4))
        if what <= 1 and words:
            word = draw(st.sampled_from(words))
            text = text[: word.start()] + draw(_REPLACEMENTS) + text[word.end() :]
        elif what == 2:
            i = draw(st.integers(0, len(lines) - 1))
            text = "\n".join(lines[:i] + lines[i + 1 :])
        elif what == 3:
            i, j = (draw(st.integers(0, len(lines) - 1)) for _ in range(2))
            text = "\n".join([*lines[:i], lines[j], *lines[i:]])
        else:
            text = text[: draw(st.integers(0, len(text)))]
    return text


def _try(read, path, data):
    path.write_bytes(data if isinstance(data, bytes) else data.encode("utf-8", "surrogatepass"))
    message = _message(read, path)
    assert message is None or str(path.parent) in message


def _message(read, path):
    """What the reader says against a file, None where it reads it."""
    try:
        read(path)
    except SurveyError as error:
        return str(error)
    return None


@pytest.mark.parametrize("name", list(_SAMPLES))
@_QUICK
@given(data=st.data())
def test_damaged_files(tmp_path, name, data):
    for file, content in DBAT_FILES.items():
        (tmp_path / file).write_text(content, encoding="utf-8")
    _try(READERS[name], tmp_path / "net.file", data.draw(_damaged(_SAMPLES[name])))


@pytest.mark.parametrize("ending", ["phc", "ior", "eor", "obc", "scale"])
@_QUICK
@given(data=st.data())
def test_damaged_files_of_aicon(tmp_path, ending, data):
    for file, content in AICON.items():
        (tmp_path / file).write_text(content, encoding="utf-8")
    text = data.draw(_damaged(AICON[f"net.{ending}"]))
    (tmp_path / f"net.{ending}").write_text(text, encoding="utf-8")
    message = _message(READERS["aicon"], tmp_path / "net.phc")
    assert message is None or str(tmp_path) in message


@pytest.mark.parametrize("file", list(DBAT_FILES))
@_QUICK
@given(data=st.data())
def test_damaged_tables_of_dbat(tmp_path, file, data):
    for name, content in DBAT_FILES.items():
        (tmp_path / name).write_text(content, encoding="utf-8")
    (tmp_path / file).write_text(data.draw(_damaged(DBAT_FILES[file])), encoding="utf-8")
    _try(READERS["dbat"], tmp_path / "net.xml", DBAT)


@pytest.mark.parametrize("name", [n for n in READERS if n != "aicon"])
@_QUICK
@given(data=st.one_of(st.binary(max_size=200), st.text(max_size=200)))
def test_anything_at_all(tmp_path, name, data):
    _try(READERS[name], tmp_path / "net.file", data)
