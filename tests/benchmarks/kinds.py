"""Kinds of cases: how they are loaded, and who competes on them."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Protocol

from tests.benchmarks import bundle, competitors, finding, growth, pose_graphs, terrestrial, trials
from tests.benchmarks.data import Calibration
from tests.benchmarks.outcome import Competitor


class Case(Protocol):
    """What a worker can load again."""

    def save(self, path: Path) -> None:
        """Write it."""


KINDS: Mapping[str, tuple[Any, Mapping[str, Callable[[Any], Competitor]]]] = {
    "calibration": (Calibration, competitors.CALIBRATION),
    "bundle": (bundle.Bundle, bundle.BUNDLE),
    "pose graph": (pose_graphs.PoseGraph, pose_graphs.GRAPHS),
    "terrestrial": (terrestrial.Terrestrial, terrestrial.TERRESTRIAL),
    "trials": (trials.Trials, trials.TRIALS),
    "pictures": (finding.Pictures, finding.FINDING),
    "stations": (growth.Stations, growth.STATIONS),
}


def kind_of(case: Case) -> str:
    """The kind of a case."""
    return next(name for name, (made, _) in KINDS.items() if isinstance(case, made))


def make(kind: str, name: str, path: Path) -> Competitor:
    """The competitor on the case of that file."""
    made, named = KINDS[kind]
    return named[name](made.load(path))
