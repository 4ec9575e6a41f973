"""Covariances against the scatter of re-solved surveys with fresh noise: the sigmas have to be true.

For every class of unknowns d' inv(C) d, with d the estimate's tangent from the truth and C the joint covariance of the
class, is chi-square with as many degrees of freedom as the class has components, in every replica anew.
"""

import os
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import gtsam
import numpy as np
import pytest
from gtsam import Pose3
from scipy.stats import binom, chi2

from adjust.graph.assembly import AdjustmentGraph
from adjust.graph.building import GraphBuilder
from adjust.graph.solver import solve
from adjust.model.result import ParameterName
from adjust.model.survey import Datum, FloatArray, Survey
from adjust.precision.precision import Precision
from survey import simulate
from survey.simulate.scene import Truth
from tests.adjust import helpers as h
from tests.sizes import size

REPLICAS = size(150)
LEVEL = 1e-3  # of all tests of one survey together
SURVEYS: dict[str, Callable[[], tuple[Survey, Truth]]] = {
    "single_camera": lambda: simulate.single_camera(11),
    "stereo": lambda: simulate.stereo(12),
    "head_on_table": lambda: simulate.head_on_table(13, n_table_epochs=6, n_free_epochs=5),
    "beacons": lambda: simulate.beacons(14, n_table_epochs=5, n_free_epochs=4),
    "network": lambda: h.network(15, n_epochs=8, n_points=20),
    "free network": lambda: free_network(16),
}
CLASSES = {
    "single_camera": {"lens", "target poses"},
    "stereo": {"lens", "target poses", "camera on station"},
    "head_on_table": {"lens", "camera on station", "station per epoch", "table base", "table axes", "table angles"},
    "beacons": {
        "lens", "camera on station", "station per epoch", "table base", "table axes", "table angles", "points",
    },
    "network": {"lens", "camera on station", "station per epoch", "points"},
    "free network": {"lens", "camera on station", "station per epoch", "points"},
}  # fmt: skip
_KIND = {
    "lens": "lens",
    "station_from_camera": "camera on station",
    "world_from_table": "table base",
    "table_geometry": "table axes",
    "table_angles": "table angles",
    "world_from_station": "station per epoch",
    "carrier_from_target": "target poses",
    "point": "points",
}


def free_network(seed: int) -> tuple[Survey, Truth]:
    """Nothing known but two distances; inner constraints over all points."""
    survey, truth = h.network(seed, n_epochs=8, held=0)
    return replace(survey, datum=Datum("inner")), truth


@dataclass(frozen=True, eq=False)
class Scatter:
    """d (replicas, n) per unknown, and what belongs to it."""

    graph: AdjustmentGraph
    precision: Precision
    d: dict[ParameterName, FloatArray]
    omega: FloatArray
    redundancy: int

    def classes(self) -> dict[str, list[ParameterName]]:
        out: dict[str, list[ParameterName]] = defaultdict(list)
        for name in self.graph.unknowns.by_name:
            out[_KIND[name[0]]].append(name)
        return out


def deviation(graph: AdjustmentGraph, name: ParameterName, values: gtsam.Values, truth: Any) -> FloatArray:
    """Tangent (dim,) of the estimate at the truth."""
    unknown = graph.unknowns.by_name[name]
    if unknown.kind == "pose":
        return np.asarray(Pose3.Logmap(truth[name].between(values.atPose3(unknown.key))))
    if unknown.kind == "point":
        return np.asarray(values.atPoint3(unknown.key) - truth[name])
    x, full = values.atVector(unknown.key), truth[name]
    if name[0] == "table_angles":
        return np.asarray(x - full)
    names = graph.unknowns.vectors[name].names
    return np.asarray(x - [full[names.index(c)] for c in unknown.components])


@pytest.fixture(scope="module", params=list(SURVEYS))
def scatter(request: pytest.FixtureRequest) -> tuple[str, Scatter]:
    survey, truth = SURVEYS[request.param]()
    start = h.start_at(truth)
    found: dict[ParameterName, list[FloatArray]] = defaultdict(list)
    omega = []
    for replica in range(REPLICAS):
        graph = GraphBuilder(simulate.resample(survey, truth, 1000 + replica), start.lenses).build(start)
        done = solve(graph)
        omega.append(done.omega)
        for name in graph.unknowns.by_name:
            found[name].append(deviation(graph, name, done.values, truth))
    precision = Precision(graph, done)
    used = sum(2 * len(b.uv) for b in survey.image_blocks) + sum(len(i.observed) for i in graph.others)
    defect = done.datum.defect if done.datum else 0
    redundancy = used - sum(u.dim for u in graph.unknowns.by_name.values()) + defect
    return request.param, Scatter(
        graph, precision, {n: np.array(d) for n, d in found.items()}, np.array(omega), redundancy
    )


def statistics(s: Scatter, names: list[ParameterName]) -> tuple[FloatArray, int, float, int]:
    """d' inv(C) d of the class (replicas,), its freedoms, the share of single unknowns inside their 95 % region, of how
    many."""
    inside, trials = 0, 0
    for name in names:
        C = h.covariance_of(s.precision, name)
        T = np.einsum("ri,ij,rj->r", s.d[name], np.linalg.pinv(C, rcond=1e-12, hermitian=True), s.d[name])
        inside += int(np.sum(chi2.ppf(0.95, len(C)) >= T))
        trials += len(T)
    d = np.hstack([s.d[n] for n in names])
    C = joint(s, names)
    w, V = np.linalg.eigh(C / np.sqrt(np.outer(np.diag(C), np.diag(C))))
    kept = w > 1e-9 * w[-1]  # a free network's points have no covariance along the datum's own motions
    z = (d / np.sqrt(np.diag(C))) @ V[:, kept]
    rank = int(kept.sum())
    return np.asarray((z**2 / w[kept]).sum(axis=1)), rank, inside / trials, trials


def joint(s: Scatter, names: list[ParameterName]) -> FloatArray:
    """Joint covariance of a class; where a bundle hides some of it, by the dense inverse (which the bundle equals)."""
    hidden = set(s.precision.hidden)
    by_name = s.graph.unknowns.by_name
    if not any(by_name[n].key in hidden for n in names):
        return s.precision.joint(names)
    full = h.dense(s.graph, {c.camera_id: _lens(s, c.camera_id) for c in s.graph.survey.cameras},
                   s.precision.solved.values)  # fmt: skip
    Q = full.inverse(h.inner_rows(s.graph, full, s.precision.solved))
    index = np.concatenate([np.arange(full.place[n].start, full.place[n].stop) for n in names])
    return np.asarray(Q[np.ix_(index, index)])


def _lens(s: Scatter, camera_id: str) -> FloatArray:
    return s.graph.unknowns.vectors["lens", camera_id].full(s.precision.solved.values)


def test_scatter_of_every_class_is_what_its_covariance_says(scatter: tuple[str, Scatter]) -> None:
    name, s = scatter
    classes = s.classes()
    assert set(classes) == CLASSES[name]
    level = LEVEL / len(classes)
    report, wrong = [], []
    for kind, names in classes.items():
        T, k, share, trials = statistics(s, names)
        low, high = chi2.ppf([level / 2, 1 - level / 2], REPLICAS * k) / (REPLICAS * k)
        mean = T.mean() / k
        # components of one replica are correlated: no more than the replicas count for certain
        few = binom.ppf([level / 2, 1 - level / 2], REPLICAS, 0.95) / REPLICAS
        band = (0.93, 0.97) if trials >= max(10 * REPLICAS, 1500) else (min(0.93, few[0]), max(0.97, few[1]))
        report.append(
            f"{name:14s} {kind:18s} n={k:4d} mean/n={mean:.4f} [{low:.4f}, {high:.4f}] "
            f"covered={100 * share:.2f} % [{100 * band[0]:.1f}, {100 * band[1]:.1f}] of {trials}"
        )
        if not (low <= mean <= high and band[0] <= share <= band[1]):
            wrong.append(report[-1])
    if os.environ.get("LABSURVEY_SHOW"):
        print("\n" + "\n".join(report))
    assert not wrong, "\n".join(wrong)


def test_omega_has_the_expectation_of_its_redundancy(scatter: tuple[str, Scatter]) -> None:
    _, s = scatter
    low, high = chi2.ppf([LEVEL / 2, 1 - LEVEL / 2], REPLICAS * s.redundancy) / REPLICAS
    assert low <= s.omega.mean() <= high
