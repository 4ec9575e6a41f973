"""How the tests run: side by side on all cores, statistical tests at a tenth of their size (``docs/testing.md``)."""

import os
from pathlib import Path

import pytest

from tests import sizes

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy: threads of several processes wait for each other
ACCEPTANCE = Path(__file__).parent / "acceptance"


def pytest_addoption(parser: pytest.Parser) -> None:
    """``--whole``."""
    parser.addoption("--whole", action="store_true", help="long statistical tests at their whole size, not a tenth")


def pytest_configure(config: pytest.Config) -> None:
    """Before test modules are imported: they ask for sizes then."""
    sizes.whole = config.getoption("--whole")


@pytest.hookimpl(tryfirst=True)
def pytest_cmdline_main(config: pytest.Config) -> None:
    """Folders run on all cores where pytest-xdist is there and nothing else is said (``-n``, ``--pdb``)."""
    option = config.option
    unsaid = hasattr(option, "numprocesses") and option.numprocesses is None and option.dist == "no" and not option.tx
    apart = hasattr(config, "workerinput") or option.usepdb or option.collectonly or option.trace
    if unsaid and not apart and all(Path(a).is_dir() for a in config.args):
        from adjust.native.parallel import cores

        os.environ.setdefault("OPENCV_FOR_THREADS_NUM", "1")  # of each process
        option.numprocesses = cores() + (not _daily(config))  # one waits for a table or a camera
        option.dist = "worksteal"  # neighbours stay together, so that what they share is made once


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Nothing of the whole jobs is imported for the daily loop."""
    return True if collection_path == ACCEPTANCE and _daily(config) else None


def _daily(config: pytest.Config) -> bool:
    return bool(config.option.markexpr.strip() == "not slow")


@pytest.fixture
def undiagnosed(monkeypatch: pytest.MonkeyPatch) -> None:
    """What does not fit is not explained by trial: for tests on numbers, where that takes most of the time."""
    monkeypatch.setattr("survey.jobs.adjusting.probable_causes._diagnosis", lambda *_: None)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Whole jobs are slow."""
    for item in items:
        if item.path.is_relative_to(ACCEPTANCE):
            item.add_marker("slow")
