"""All parts of a survey and all changes within it, tested together at one error probability.

Parts are groups, cameras, epochs, targets, tables, set-ups and instruments. The weighted squares of a part are a
quadratic form in normal residuals: with R_g its part of the redundancy matrix they have the mean tr R_g, its
redundancy, and the variance 2 tr R_g R_g (Koch 1999, 2.7). A fault that a large survey dilutes below the limit of the
global test stands out in its own part.
"""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from adjust.model.frozen import frozen
from adjust.model.names import numbered
from adjust.model.result import Adjustment
from adjust.model.survey import FloatArray, IntArray
from adjust.statistics.changes import ChangeSearch
from adjust.statistics.condensed import CondensedSystem
from adjust.statistics.result import Consistency, PartTest
from adjust.statistics.rows import groups_of_others
from adjust.statistics.system import LinearSystem
from adjust.testing.criteria import sidak
from adjust.testing.distributions import chi2, fisher
from adjust.testing.quadratic_forms import upper_tail, upper_tail_bound

_LEAST = 1e-3
"""Redundancy below which the squares of a part are rounding."""
_EXACT = 400
"""Rows up to which the eigenvalues of a part are found."""
_ESTIMATED = ("estimated", "unseparable")


def consistency(adjustment: Adjustment, condensed: CondensedSystem | None, alpha: float = 0.05) -> Consistency:
    """Test every part, and look for changes; ``alpha`` is the error probability of all of it together.

    condensed: the system of this adjustment; None for a large network of pairs, of which the groups are tested. Where
    the global test fails because residuals are too large, every part is tested against the rest: else wrong sigmas
    would make everything suspect. Groups whose variance was estimated from these residuals are not tested for it.
    """
    test = adjustment.global_test
    if test is None:
        return Consistency(alpha, alpha, 0, (), (), False, 0)
    relative = test.status == "failed"
    system = None if condensed is None else condensed.system
    if condensed is None:
        parts = parts_of_network(adjustment) if len(adjustment.groups) > 1 else ()
    else:
        parts = parts_of(adjustment, condensed.system, condensed.numbers)
    known = adjustment.variance_components
    fitted = {c.group for c in known.components if c.status in _ESTIMATED} if known is not None else set()
    parts = tuple(p for p in parts if not (p.kind == "group" and p.name in fitted))
    search = None
    if condensed is not None and len(condensed.e):
        search = ChangeSearch(adjustment, condensed)
    n_changes = search.n_tests if search is not None else 0
    n = len(parts) + n_changes
    level = sidak(alpha, n) if n else alpha
    return Consistency(
        alpha, level, n, tested_parts(adjustment, parts, level, relative, system),
        search.found(level, relative) if search is not None else (), relative, n_changes,
        search.left_out() if search is not None else (),
    )  # fmt: skip


@frozen(eq=False)
class Part:
    """A part: the observations (k,) of the condensed system that belong to it; none where only its sums are known.

    n_rows: their rows there.
    """

    kind: str
    name: str
    members: IntArray
    n: float
    redundancy: float
    omega: float
    n_rows: int = 0


def parts_of_network(adjustment: Adjustment) -> tuple[Part, ...]:
    """The groups of an adjustment, from their sums."""
    none = np.zeros(0, dtype=np.int64)
    return tuple(Part("group", g.group, none, g.n_observations, g.redundancy, g.omega) for g in adjustment.groups)


def parts_of(adjustment: Adjustment, system: LinearSystem, blocks: IntArray) -> tuple[Part, ...]:
    """All parts that are neither the whole nor without redundancy. blocks: the image block of each observation."""
    found, out = contributions(adjustment, system, blocks), list[Part]()
    counted, lengths = found[0] != 0.0, np.diff(system.ptr)
    total = int(np.count_nonzero(counted))
    for kind, names in _labels(adjustment, system, blocks).items():
        called, of = numbered((None, *names))
        of = of[1:]
        every = np.flatnonzero((of > 0) & counted)
        every = every[np.argsort(of[every], kind="stable")]
        if not len(every):
            continue
        first = np.flatnonzero(np.diff(of[every], prepend=0))
        sums = np.add.reduceat(found[:, every], first, axis=1).tolist()
        edges, n_rows = pairwise([*first.tolist(), len(every)]), np.add.reduceat(lengths[every], first).tolist()
        out += [
            Part(kind, str(called[i]), every[a:b], n, r, omega, rows)
            for i, (a, b), n, r, omega, rows in zip(of[every[first]].tolist(), edges, *sums, n_rows, strict=True)
            if r > _LEAST and b - a < total
        ]
    return tuple(out)


def contributions(adjustment: Adjustment, system: LinearSystem, blocks: IntArray) -> FloatArray:
    """Of every observation of a condensed system (3, M): components in use, redundancy, weighted square sum."""
    arrays, readings, k = adjustment.other_arrays, adjustment.reading_residuals, len(blocks)
    out = np.zeros((3, len(system.used)))
    if k:
        sums = system.precision.image_sums
        shares = sums / np.maximum(np.bincount(blocks, minlength=len(sums)), 1)[:, None]  # each part its share
        out[:, :k] = shares[blocks].T
    out[:2, k:] = arrays.n_components, np.bincount(arrays.observation, arrays.redundancies, len(arrays.used))
    np.add.at(out[2], system.row_of, np.where(system.row_of >= k, system.e**2, 0.0))
    if readings is not None:
        out[2, len(out[2]) - len(readings.used) :] = readings.weighted_square
    return np.where(system.used, out, 0.0)


def _labels(adjustment: Adjustment, system: LinearSystem, blocks: IntArray) -> dict[str, list[str | None]]:
    """Of every kind of part the one that each observation belongs to, or None."""
    survey, graph = adjustment.survey, system.precision.graph
    images, readings = [survey.image_blocks[i] for i in blocks.tolist()], survey.readings
    instrument = {s.setup_id: s.instrument_id for s in survey.setups}
    none: tuple[str | None, ...] = (None, None)
    axes = graph.of_others(lambda o: o.ids if o.kind == "table" else none, lambda _: none)
    no_image, no_other, no_reading = ([None] * len(x) for x in (images, axes, readings))
    return {
        "group": [*(b.group for b in images), *groups_of_others(graph)],
        "camera": [*(b.camera_id for b in images), *no_other, *no_reading],
        "epoch": [*(b.epoch_id for b in images), *(ids[1] for ids in axes), *no_reading],
        "target": [*(b.target_id for b in images), *no_other, *no_reading],
        "table": [*no_image, *(ids[0] for ids in axes), *no_reading],
        "set-up": [*no_image, *no_other, *(r.setup_id or None for r in readings)],
        "instrument": [*no_image, *no_other, *(instrument.get(r.setup_id) or None for r in readings)],
    }


def tested_parts(
    adjustment: Adjustment, parts: Sequence[Part], level: float, relative: bool, system: LinearSystem | None
) -> tuple[PartTest, ...]:
    """Every part at this level of one test, smallest p first.

    relative: against all others (F), where the survey as a whole does not fit its sigmas.
    """
    if not parts:
        return ()
    n, r, omega = (np.array([getattr(part, x) for part in parts]) for x in ("n", "redundancy", "omega"))
    found = _p_relative(adjustment, r, omega) if relative else upper_tail_bound(omega, r)
    if system is not None and not relative:
        for i in _undecided(parts, (n, r, omega, found), level):
            rows = _rows(system, parts[i])
            found[i] = min(found[i], upper_tail(omega[i], eigenvalues(system, rows, round(n[i]))))
    out = [
        PartTest(part.kind, part.name, round(part.n), part.redundancy, part.omega, part.omega / part.redundancy, p,
                 p < level) for part, p in zip(parts, found.tolist(), strict=True)
    ]  # fmt: skip
    return tuple(sorted(out, key=lambda x: (x.p, -x.factor, x.kind, x.name)))


def _p_relative(adjustment: Adjustment, r: FloatArray, omega: FloatArray) -> FloatArray:
    """Of the factor of parts (k,) over that of the rest."""
    left, rest = adjustment.redundancy - r, adjustment.omega - omega
    some = (left >= 1.0) & (rest > 0.0)
    factor = np.where(some, rest, 1.0) / np.where(some, left, 1.0)
    return np.where(some, fisher.sf(omega / r / factor, r, np.where(some, left, 1.0)), 1.0)


def _undecided(parts: Sequence[Part], known: tuple[FloatArray, ...], level: float) -> list[int]:
    """Of which parts the bound of the probability and what could be better do not say the same."""
    (n, r, omega, bound), n_rows = known, np.array([part.n_rows for part in parts])
    k = np.maximum(np.minimum(n_rows, n), 1.0)
    lost = n - r  # degrees of freedom that the unknowns take; evenly, the variance is least
    scale = np.maximum(n - k + k * (1.0 - lost / k) ** 2, 1e-12) / r
    best = chi2.sf(omega / scale, r / scale)
    return np.flatnonzero((bound >= level) & (n_rows > 0) & (best <= level) & (n_rows <= _EXACT)).tolist()


def _rows(system: LinearSystem, part: Part) -> IntArray:
    return np.concatenate([np.arange(system.ptr[o], system.ptr[o + 1]) for o in part.members.tolist()])


def eigenvalues(system: LinearSystem, rows: IntArray, n: int) -> FloatArray:
    """Eigenvalues (n,) of I - A Q A' of the n components that stand in these rows (condensed: in fewer)."""
    influence = system.among(system.A[rows])
    taken = np.sort(np.linalg.eigvalsh(0.5 * (influence + influence.T)))[::-1][:n]
    return np.concatenate([np.clip(1.0 - taken, 0.0, 1.0), np.ones(n - len(taken))])
