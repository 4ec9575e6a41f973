"""Instruments and targets that do not stand over their points, and have no sigma for it: short sights miss most.

Variance components beside the readings' own, by restricted maximum likelihood: an error of sigma s (m) in each
horizontal direction, of a target in each reading, of an instrument in all readings of its set-up.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from adjust.diagnosis.case import Case
from adjust.diagnosis.hypothesis import Hypothesis, Place
from adjust.diagnosis.weights.likeliest import likeliest_size
from adjust.model.frozen import frozen
from adjust.model.names import grouped
from adjust.model.result import Adjustment
from adjust.model.rewriting import with_rows
from adjust.model.survey import FloatArray, IntArray, Survey
from adjust.observations.terrestrial import equations as k
from adjust.observations.terrestrial.batch import TerrestrialBatch
from adjust.testing.distributions import chi2

_MOST = 1_500
"""Readings up to which this is looked for: every error is one of a joint system."""
_ALPHA = 1e-4
_SEEN = 0.05
"""Share of a set-up's error that the unknowns leave, below which its point moves with it and it does no harm."""
_SIZES = tuple((1e-5 * np.geomspace(1.0, 3_000.0, 25)).tolist())
"""m, of sigmas that are tried: 0.01 to 30 mm, two of each doubling; what the largest suits best is something else."""
_LESS_LIKELY = 10.0
"""Minus twice the log likelihood by which the sigma of one explains less than that of another, and is not tried."""
_LAST = 1.5
"""Evidence: as for sigmas, larger variances fit anything, so what else there is to try is tried first."""


@frozen(eq=False)
class _Error:
    """Of a target in one reading, or of the instrument of a set-up: rows (r,) and their whitened derivatives (r, c)."""

    rows: IntArray
    B: FloatArray
    setup_id: str = ""

    @property
    def squares(self) -> FloatArray:
        """Eigenvalues (c,) of B'B."""
        return np.asarray(np.linalg.eigvalsh(self.B.T @ self.B), dtype=np.float64)


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
    first = int(linear.system.ptr[-1 - n])  # of the readings, one row each, the last ones
    errors = [*_of_targets(batch, first), *_of_instruments(survey, batch, first)]
    if not errors:
        return
    b, M = linear.apart([(e.rows, column[:, None]) for e in errors for column in e.B.T])
    at = np.split(np.arange(len(b)), np.cumsum([e.B.shape[1] for e in errors])[:-1])
    shown = [(e, own) for e, own in zip(errors, at, strict=True) if _shows(e, M[own, own])]
    targets, instruments = ([one for one in shown if bool(one[0].setup_id) == of] for of in (False, True))
    sets = [one for one in (targets, instruments) if one]
    every = [(some, *likeliest_size(b[own := np.concatenate([of for _, of in some])], M[np.ix_(own, own)], _SIZES))
             for some in (*sets, *([shown] if len(sets) > 1 else []))]  # fmt: skip
    least = min((cost for *_, cost in every), default=0.0)
    most = min(-float(chi2.isf(_ALPHA, 1)), least + _LESS_LIKELY, _with_factors(linear.result))
    for some, size, cost in every:
        if cost < most and size < _SIZES[-1]:
            yield _hypothesis(survey, [e for e, _ in some], size)


def _of_targets(batch: TerrestrialBatch, first: int) -> Iterator[_Error]:
    """Where no sigma is given: in the one direction in which it changes the reading. first: row of all readings."""
    a = batch.layout.arrays
    by = np.linalg.norm(np.hstack([batch.by_horizontal(k.TO, a.to), batch.by_horizontal(k.SECOND, a.second)]), axis=1)
    for i in np.flatnonzero(batch.used & (a.target_centring == 0.0) & (a.kind != k.HEIGHT)).tolist():
        yield _Error(np.array([first + i]), np.full((1, 1), by[i] / batch.sigma[i]))


def _of_instruments(survey: Survey, batch: TerrestrialBatch, first: int) -> Iterator[_Error]:
    """Of set-ups without a sigma, in both directions."""
    by = batch.by_horizontal(k.AT, batch.layout.arrays.at) / batch.sigma[:, None]
    without = {s.setup_id for s in survey.setups if s.centring_sigma == 0.0}
    mine = ((r.setup_id, i) for i, r in enumerate(survey.readings) if r.setup_id in without and batch.used[i])
    for setup_id, rows in grouped(mine).items():
        yield _Error(first + np.array(rows), by[rows], setup_id)


def _shows(error: _Error, left: FloatArray) -> bool:
    """Whether its point does not simply move with an instrument. left: what the unknowns leave of its squares (c,)."""
    return not error.setup_id or bool(left.sum() > _SEEN * (error.B**2).sum())


def _with_factors(result: Adjustment) -> float:
    """As :func:`likeliest_size`, with the sigmas of every group of readings times a factor: where that says more."""
    groups = {r.group for r in result.survey.readings}
    tested = [g for g in result.groups if g.group in groups and g.omega > g.redundancy > 0.0]
    return sum(g.redundancy * float(np.log(g.omega / g.redundancy) + 1.0) - g.omega for g in tested)


def _hypothesis(survey: Survey, errors: Sequence[_Error], size: float) -> Hypothesis:
    setups, changed, names = {e.setup_id for e in errors} - {""}, survey, list[tuple[str, str]]()
    if any(not e.setup_id for e in errors):
        names.append(("targets", "sigma_target_centring_mm"))
        changed = with_rows(changed, "readings", {i: replace(r, target_centring_sigma=size)
                            for i, r in enumerate(survey.readings) if r.target_centring_sigma == 0.0})  # fmt: skip
    if setups:
        names.append(("instruments", "sigma_centring_mm"))
        moved = (replace(s, centring_sigma=size) if s.setup_id in setups else s for s in survey.setups)
        changed = replace(changed, setups=tuple(moved))
    what, keys = " and ".join(w for w, _ in names), ", ".join(key for _, key in names)
    return Hypothesis(
        "centring", f"the {what} do not stand over their points, by {1e3 * size:.2g} mm in each direction, and no "
        "sigma says so: short sights miss the most", f"give {keys} (here {1e3 * size:.2g})",
        Place("reading", tuple(dict.fromkeys(r.kind for r in survey.readings)), "sigma"), changed, (), _LAST, 1,
        len(_SIZES), penalty=sum(float(np.log1p(size**2 * e.squares).sum()) for e in errors), of_variances=True,
    )  # fmt: skip
