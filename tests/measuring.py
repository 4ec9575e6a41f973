"""``pytest --measure``: what tests take, kept for the order of the next run, and which marks ``slow`` are wrong."""

import json
import os
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

TESTS = Path(__file__).parent
KEPT = TESTS / "seconds.json"  # of whole files, the longest first
SLOW_S, WAIT_S = 0.35, 1.0  # of computing, of waiting


def kept() -> dict[str, float]:
    """Seconds of every file of tests that takes more than one, from the last run that was measured."""
    return dict(json.loads(KEPT.read_text(encoding="utf-8")))


class Measuring:
    """A plugin of the process that looks on, and of each that works."""

    def __init__(self) -> None:
        self.before = 0.0
        self.files: Counter[str] = Counter()
        self.tests: dict[str, tuple[float, float, bool]] = {}

    def pytest_collection_finish(self) -> None:
        self.before = _computed_s()

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_runtest_makereport(self, item: pytest.Item) -> Any:
        report = yield
        now = _computed_s()
        report.computed_s, self.before = now - self.before, now
        report.is_slow = item.get_closest_marker("slow") is not None
        return report

    def pytest_runtest_logreport(self, report: Any) -> None:
        if hasattr(report, "computed_s"):  # of the process that worked
            self.files[report.nodeid.partition("::")[0]] += report.duration
            computed, taken, _ = self.tests.get(report.nodeid, (0.0, 0.0, False))
            self.tests[report.nodeid] = computed + report.computed_s, taken + report.duration, report.is_slow

    def pytest_terminal_summary(self, terminalreporter: Any) -> None:
        seconds = {name: round(s, 1) for name, s in self.files.most_common() if s > 1.0}
        KEPT.write_text(json.dumps(seconds, indent=0) + "\n", encoding="utf-8")
        computed = sum(computed for computed, _, _ in self.tests.values())
        terminalreporter.write_line(f"{computed:.0f} s of computing; {KEPT} is written")
        for test, (computed, taken, is_slow) in sorted(self.tests.items()):
            takes_long = computed > SLOW_S or taken - computed > WAIT_S
            if takes_long != is_slow and "/acceptance/" not in test:
                word = "not marked slow" if takes_long else "marked slow"
                terminalreporter.write_line(f"{word}: {test}: {computed:.2f} s of computing, {taken:.2f} s in all")


def _computed_s() -> float:
    """Of this process and the processes that it has seen the end of."""
    return sum(os.times()[:4])
