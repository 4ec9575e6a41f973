"""How the tests run: side by side on all cores, statistical tests at a tenth of their size (``docs/testing.md``)."""

import gc
import os
import sys
from collections.abc import Generator
from pathlib import Path
from typing import Any

import pytest

from tests import measuring, sizes

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy: threads of several processes wait for each other
sys.dont_write_bytecode = False  # rewriting the assertions takes each process longer than all imports together
ACCEPTANCE = Path(__file__).parent / "acceptance"


def pytest_addoption(parser: pytest.Parser) -> None:
    """``--whole``, ``--measure``."""
    parser.addoption("--whole", action="store_true", help="long statistical tests at their whole size, not a tenth")
    parser.addoption("--measure", action="store_true", help="keep what files take, and list wrong marks ``slow``")


def pytest_configure(config: pytest.Config) -> None:
    """Before test modules are imported: they ask for sizes then."""
    sizes.whole = config.getoption("--whole")
    if config.getoption("--measure"):
        config.pluginmanager.register(measuring.Measuring())


@pytest.hookimpl(tryfirst=True)
def pytest_cmdline_main(config: pytest.Config) -> None:
    """Folders run on all cores where pytest-xdist is there and nothing else is said (``-n``, ``--pdb``)."""
    option = config.option
    unsaid = hasattr(option, "numprocesses") and option.numprocesses is None and option.dist == "no" and not option.tx
    apart = hasattr(config, "workerinput") or option.usepdb or option.collectonly or option.trace
    if unsaid and not apart and all(Path(a).is_dir() for a in config.args):
        from adjust.native.parallel import cores

        for threads in ("LABSURVEY_THREADS", "OPENCV_FOR_THREADS_NUM"):
            os.environ.setdefault(threads, "1")  # of each process; tests of threads ask for theirs
        option.numprocesses = cores() + (not _daily(config))  # one waits for a table or a camera
        option.dist = "loadfile"  # what a file prepares is made once
        option.loadscopereorder = _daily(config)  # by their number of tests; else by seconds, see below


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Nothing of the whole jobs is imported for the daily loop."""
    return True if collection_path == ACCEPTANCE and _daily(config) else None


def _daily(config: pytest.Config) -> bool:
    return bool(config.option.markexpr.strip() == "not slow")


@pytest.fixture(scope="session", autouse=True)
def _shared_labs(tmp_path_factory: pytest.TempPathFactory) -> None:
    """What one process has made serves all of them."""
    from tests import labs

    own = tmp_path_factory.getbasetemp()
    labs.place = (own.parent if "PYTEST_XDIST_WORKER" in os.environ else own) / "labs"


@pytest.fixture(scope="module")
def browser() -> Generator[Any]:
    """A browser, started once for a file."""
    from tests.browsing import launched

    with launched() as found:
        yield found


def _without_diagnosis() -> Generator[None]:
    """What does not fit is not explained by trial: for tests on numbers, where that takes most of the time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("survey.jobs.adjusting.probable_causes._diagnosis", lambda *_: None)
        yield


undiagnosed = pytest.fixture(_without_diagnosis, name="undiagnosed")
undiagnosed_module = pytest.fixture(_without_diagnosis, scope="module", name="undiagnosed_module")


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector: pytest.Collector) -> Generator[None, Any, Any]:
    """Every process begins to import elsewhere, so that each file's assertions are rewritten once and then read."""
    report = yield
    worker = getattr(collector.config, "workerinput", None)
    if worker and isinstance(collector, pytest.Directory) and report.passed:
        first = int(worker["workerid"][2:]) * len(report.result) // worker["workercount"]
        report.result = report.result[first:] + report.result[:first]
    return report


def pytest_collection_finish() -> None:
    """What was imported stays: no search for cycles looks through it again, as in the command itself."""
    gc.freeze()
    gc.set_threshold(20_000)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Whole jobs are slow. Side by side the longest files come first, so that no process ends with one."""
    for item in items:
        if item.path.is_relative_to(ACCEPTANCE):
            item.add_marker("slow")
    if hasattr(config, "workerinput"):
        seconds = measuring.kept()
        items.sort(key=lambda item: (-seconds.get(name := item.nodeid.partition("::")[0], 0.0), name))
