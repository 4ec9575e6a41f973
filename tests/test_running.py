"""How the tests themselves run: when side by side, and how long statistical tests are."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from adjust.native.parallel import cores
from tests import conftest, sizes

TESTS = Path(__file__).parent


def _asked(*words: str, **said: Any) -> tuple[int | None, str]:
    """Number of processes and way of sharing after pytest was called with these paths and options."""
    unsaid: dict[str, Any] = {"numprocesses": None, "dist": "no", "tx": []}
    others = {"usepdb": False, "collectonly": False, "trace": False, "markexpr": ""}
    config: Any = SimpleNamespace(option=SimpleNamespace(**(unsaid | others | said)), args=words)
    conftest.pytest_cmdline_main(config)
    return config.option.numprocesses, config.option.dist


def test_folders_run_side_by_side_and_files_alone() -> None:
    assert _asked(str(TESTS)) == _asked(str(TESTS / "adjust"), str(TESTS / "survey")) == (cores() + 1, "loadfile")
    assert _asked(str(TESTS), markexpr="not slow") == (cores(), "loadfile")
    assert _asked(str(TESTS / "test_docs.py")) == _asked(f"{__file__}::test_a_tenth") == (None, "no")


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
