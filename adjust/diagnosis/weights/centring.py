"""Instruments and targets that do not stand over their points, and have no sigma for it: short sights miss most.

Variance components beside the readings' own, by restricted maximum likelihood (Patterson, Thompson 1971): an error of
sigma s (m) in each horizontal direction, of a target in each reading, of an instrument in all readings of its set-up.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse

from adjust.diagnosis.case import Case
from adjust.diagnosis.hypothesis import Hypothesis, Place
from adjust.model.names import grouped
from adjust.model.result import Adjustment
from adjust.model.rewriting import with_rows
from adjust.model.survey import FloatArray, Survey
from adjust.observations.terrestrial import equations as k
from adjust.observations.terrestrial.batch import TerrestrialBatch
from adjust.statistics.score import LinearScores, Part
from adjust.testing.distributions import chi2

_MOST = 1_500
"""Readings up to which this is looked for: every error is one of a joint system."""
_ALPHA = 1e-4
_SEEN = 0.05
"""Share of a set-up's error that the unknowns leave, below which its point moves with it and it does no harm."""
_SIZES = 1e-5 * np.geomspace(1.0, 3_000.0, 25)
"""m, of sigmas that are tried: 0.01 to 30 mm, two of each doubling; what the largest suits best is something else."""
_LESS_LIKELY = 10.0
"""Minus twice the log likelihood by which the sigma of one explains less than that of another, and is not tried."""
_LAST = 1.5
"""Evidence: as for sigmas, larger variances fit anything, so what else there is to try is tried first."""


@dataclass(frozen=True, eq=False)
class _Errors:
    """Of targets, or of instruments. what: which, for people. key: of ``survey.toml``. setups: whose instruments.

    parts: of each number of an error its rows and whitened derivatives. squares: of each error eigenvalues of B'B.
    """

    what: str
    key: str
    setups: frozenset[str]
    parts: tuple[Part, ...]
    squares: FloatArray


def missing_centring(case: Case) -> Iterator[Hypothesis]:
    """Sigmas of targets over points, of instruments over points, and of both, each as large as is likeliest."""
    survey, n = case.survey, len(case.survey.readings)
    if case.result is None or not n or len(case.result.survey.readings) != n or survey.reading_covariances:
        return
    if not case.few("centring errors", n, _MOST) or (linear := case.linear) is None:
        return
    batch = linear.system.precision.graph.terrestrial
    if batch is None:
        return
    batch.evaluate(linear.system.precision.solved.values)
    some = [e for e in (_of_targets(survey, linear, batch), _of_instruments(survey, linear, batch)) if e.parts]
    every = [(errors, *_likeliest(linear, errors)) for errors in (some[:1], some[1:], some)[: 2 * len(some) - 1]]
    least = min((cost for *_, cost in every), default=0.0)
    most = min(-float(chi2.isf(_ALPHA, 1)), least + _LESS_LIKELY, _with_factors(linear.result))
    for errors, size, cost in every:
        if cost < most and size < _SIZES[-1]:
            yield _hypothesis(survey, errors, size)


def _of_targets(survey: Survey, linear: LinearScores, batch: TerrestrialBatch) -> _Errors:
    """Where no sigma is given: in the one direction in which it changes the reading."""
    at, a = _first_row(survey, linear), batch.layout.arrays
    by = np.linalg.norm(np.hstack([batch.by_horizontal(k.TO, a.to), batch.by_horizontal(k.SECOND, a.second)]), axis=1)
    rows = np.flatnonzero(batch.used & (a.target_centring == 0.0) & (a.kind != k.HEIGHT))
    B = by[rows] / batch.sigma[rows]
    parts = [(np.array([at + i]), np.full((1, 1), b)) for i, b in zip(rows.tolist(), B.tolist(), strict=True)]
    return _Errors("targets", "sigma_target_centring_mm", frozenset(), tuple(parts), B**2)


def _of_instruments(survey: Survey, linear: LinearScores, batch: TerrestrialBatch) -> _Errors:
    """Of set-ups without a sigma whose point does not simply move with the instrument."""
    by = batch.by_horizontal(k.AT, batch.layout.arrays.at) / batch.sigma[:, None]
    without = {s.setup_id for s in survey.setups if s.centring_sigma == 0.0}
    mine = ((r.setup_id, i) for i, r in enumerate(survey.readings) if r.setup_id in without and batch.used[i])
    seen, parts, squares = list[str](), list[Part](), list[FloatArray]()
    for setup_id, rows in grouped(mine).items():
        own = [(_first_row(survey, linear) + np.array(rows), by[rows, axis, None]) for axis in (0, 1)]
        BB = by[rows].T @ by[rows]
        if np.trace(linear.apart(own)[1]) > _SEEN * np.trace(BB):
            seen.append(setup_id)
            parts += own
            squares.append(np.asarray(np.linalg.eigvalsh(BB), dtype=np.float64))
    return _Errors("instruments", "sigma_centring_mm", frozenset(seen), tuple(parts), np.concatenate([*squares, []]))


def _first_row(survey: Survey, linear: LinearScores) -> int:
    """Of the readings, one row each, the last ones of a linear system."""
    return int(linear.system.ptr[-1 - len(survey.readings)])


def _likeliest(linear: LinearScores, errors: Sequence[_Errors]) -> tuple[float, float]:
    """That of ``_SIZES``, and minus twice the logarithm of its restricted likelihood over that of none.

    With ``b = B'e`` and M, what the unknowns leave of B'B, v'Pv falls by ``b' inv(M + I / s^2) b`` where the errors
    have variances s^2; ``log det (I + s^2 M)`` counts against it.
    """
    parts = [part for e in errors for part in e.parts]
    b, M = linear.apart(parts)
    values, axes = np.linalg.eigh(M + _in_common(parts))
    along, left = (axes.T @ b) ** 2, _SIZES[:, None] ** 2 * np.maximum(values, 0.0)
    costs = (np.log1p(left) - _SIZES[:, None] ** 2 * along / (1.0 + left)).sum(axis=1)
    best = int(np.argmin(costs))
    return float(_SIZES[best]), float(costs[best])


def _with_factors(result: Adjustment) -> float:
    """As :func:`_likeliest`, with sigmas of every group of readings times a factor instead: where that says more."""
    groups = {r.group for r in result.survey.readings}
    tested = [g for g in result.groups if g.group in groups and g.omega > g.redundancy > 0.0]
    return sum(g.redundancy * float(np.log(g.omega / g.redundancy) + 1.0) - g.omega for g in tested)


def _in_common(parts: Sequence[Part]) -> FloatArray:
    """B'B (p, p) of parts that have rows in common, zero of each with itself."""
    rows, B = (np.concatenate(x) for x in zip(*((r, J[:, 0]) for r, J in parts), strict=True))
    columns = sparse.csc_matrix((B, rows, np.cumsum([0, *(len(r) for r, _ in parts)])))
    BB: FloatArray = (columns.T @ columns).toarray()
    np.fill_diagonal(BB, 0.0)
    return BB


def _hypothesis(survey: Survey, errors: Sequence[_Errors], size: float) -> Hypothesis:
    changed, penalty = survey, 0.0
    for e in errors:
        penalty += float(np.log1p(size**2 * e.squares).sum())
        if e.setups:
            setups = (replace(s, centring_sigma=size) if s.setup_id in e.setups else s for s in survey.setups)
            changed = replace(changed, setups=tuple(setups))
        else:
            without = {i: r for i, r in enumerate(survey.readings) if r.target_centring_sigma == 0.0}
            changed = with_rows(changed, "readings", {
                i: replace(r, target_centring_sigma=size) for i, r in without.items()})  # fmt: skip
    what, keys = " and ".join(e.what for e in errors), ", ".join(e.key for e in errors)
    return Hypothesis(
        "centring", f"the {what} do not stand over their points, by {1e3 * size:.2g} mm in each direction, and no "
        "sigma says so: short sights miss the most", f"give {keys} (here {1e3 * size:.2g})",
        Place("reading", tuple(dict.fromkeys(r.kind for r in survey.readings)), "sigma"), changed, (), _LAST,
        1, len(_SIZES), penalty=penalty, of_variances=True,
    )  # fmt: skip
