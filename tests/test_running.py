"""How the tests themselves run: when side by side, and how long statistical tests are."""

import os
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock, patch

import pytest

from adjust.native.parallel import cores
from tests import conftest, measuring, sizes

TESTS = Path(__file__).parent


def _asked(*words: str, kept: bool = True, **said: Any) -> tuple[int | None, str]:
    """Number of processes and way of sharing after pytest was called so; the environment is kept as it was."""
    unsaid: dict[str, Any] = {"numprocesses": None, "dist": "no", "tx": []}
    others = {"usepdb": False, "collectonly": False, "trace": False, "markexpr": ""}
    config: Any = SimpleNamespace(option=SimpleNamespace(**(unsaid | others | said)), args=words)
    with patch.dict(os.environ) if kept else nullcontext():
        conftest.pytest_cmdline_main(config)
    return config.option.numprocesses, config.option.dist


def test_folders_run_side_by_side_and_files_alone() -> None:
    assert _asked(str(TESTS)) == _asked(str(TESTS / "adjust"), str(TESTS / "survey")) == (cores() + 1, "loadfile")
    assert _asked(str(TESTS), markexpr="not slow") == (cores(), "loadfile")
    assert _asked(str(TESTS / "test_docs.py")) == _asked(f"{__file__}::test_a_tenth") == (None, "no")


def test_side_by_side_each_computes_with_one_thread_unless_it_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("LABSURVEY_THREADS", raising=False)
    with patch.dict(os.environ):
        _asked(str(TESTS / "test_docs.py"), kept=False)
        assert "LABSURVEY_THREADS" not in os.environ
        _asked(str(TESTS), kept=False)
        assert os.environ["LABSURVEY_THREADS"] == "1"
        os.environ["LABSURVEY_THREADS"] = "4"
        _asked(str(TESTS), kept=False)
        assert os.environ["LABSURVEY_THREADS"] == "4"


@pytest.mark.parametrize(
    "said",
    [{"numprocesses": 0}, {"numprocesses": 5}, {"dist": "load"}, {"usepdb": True}, {"trace": True}, {"tx": ["popen"]}],
)
def test_what_is_said_holds(said: dict[str, Any]) -> None:
    assert _asked(str(TESTS), **said) == (said.get("numprocesses"), said.get("dist", "no"))


def test_statistical_tests_are_a_tenth_unless_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sizes, "whole", False)
    assert [sizes.size(200), sizes.size(5), sizes.size(20, 6)] == [20, 1, 6]
    monkeypatch.setattr(sizes, "whole", True)
    assert [sizes.size(200), sizes.size(5), sizes.size(20, 6)] == [200, 5, 20]


def _items(*names: str) -> list[Any]:
    return [SimpleNamespace(nodeid=name, path=TESTS.parent / name.partition("::")[0]) for name in names]


def test_the_longest_files_come_first_side_by_side(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(measuring, "kept", lambda: {"tests/b.py": 3.0, "tests/c.py": 20.0})
    names = ["tests/d.py::x", "tests/b.py::y", "tests/b.py::x", "tests/a.py::x", "tests/c.py::x"]
    together: Any = SimpleNamespace(workerinput={})
    conftest.pytest_collection_modifyitems(together, items := _items(*names))
    assert [item.nodeid for item in items] == [names[i] for i in (4, 1, 2, 3, 0)]
    alone: Any = SimpleNamespace()
    conftest.pytest_collection_modifyitems(alone, items := _items(*names))
    assert [item.nodeid for item in items] == names


def test_every_process_begins_to_import_elsewhere() -> None:
    def order(number: int) -> list[str]:
        worker = {"workerid": f"gw{number}", "workercount": 3}
        collector = Mock(spec=pytest.Dir, config=SimpleNamespace(workerinput=worker))
        asked = conftest.pytest_make_collect_report(collector)
        next(asked)
        with pytest.raises(StopIteration) as done:
            asked.send(SimpleNamespace(passed=True, result=list("abcdef")))
        return list(done.value.value.result)

    assert ["".join(order(number)) for number in range(3)] == ["abcdef", "cdefab", "efabcd"]


def test_wrong_marks_are_listed_and_seconds_of_files_kept(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(measuring, "KEPT", tmp_path / "seconds.json")
    looker, lines = measuring.Measuring(), list[str]()
    for name, computed, taken, is_slow in (
        ("tests/a.py::long", 0.5, 0.6, False), ("tests/a.py::waits", 0.1, 1.4, False),
        ("tests/b.py::short", 0.2, 0.3, True), ("tests/b.py::right", 0.5, 0.9, True),
        ("tests/b.py::fast", 0.1, 0.1, False), ("tests/acceptance/c.py::x", 0.0, 0.0, True),
    ):  # fmt: skip
        report = SimpleNamespace(nodeid=name, computed_s=computed, duration=taken, is_slow=is_slow)
        looker.pytest_runtest_logreport(report)
    looker.pytest_terminal_summary(SimpleNamespace(write_line=lines.append))
    assert [line.split(": ")[:2] for line in lines[1:]] == [
        ["not marked slow", "tests/a.py::long"], ["not marked slow", "tests/a.py::waits"],
        ["marked slow", "tests/b.py::short"],
    ]  # fmt: skip
    assert measuring.kept() == {"tests/a.py": 2.0, "tests/b.py": 1.3}
