"""Why two epochs are not congruent, other than that something moved: names, units, scale, handedness, datum.

Each cause is tried: the second epoch as it would be without it, compared once more with the first. What concerns the
observations of one epoch (images, time, targets, weights) is diagnosed where that epoch is adjusted.
"""

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations

import numpy as np
from gtsam import Pose3

from adjust.diagnosis.units.conventions import LENGTH_RATIOS
from adjust.epochs.congruence import Common, CongruenceOptions, common, compare
from adjust.epochs.congruence_result import Congruence
from adjust.epochs.states import Epoch, aligned, moved, origin
from adjust.model.errors import SurveyError, listed
from adjust.model.frozen import frozen
from adjust.model.result import Adjustment
from adjust.model.survey import FloatArray
from adjust.spatial.rigid import align, rotation_log, transform

_WRONG, _FITS = 1e-4, 1e-3
"""p of the test of all below which something is looked for, and above which a change explains it."""
_NEAR, _EXACT = 0.2, 0.02
"""Of two names that changed places: their miss, over their distance; of a ratio of units: how far off it may be."""
_MOST_PAIRS = 8
_MOST_IN_PAIRS, _PAIRS = 1_000, 500_000
"""Names of which all distances are compared, and how many drawn ones of more names."""
_RIGID, _SCALE = np.eye(7)[:, :6], np.eye(7)[:, 6:]


@frozen(eq=False)
class Between:
    """One cause. ids: whom it concerns. p: of the test of all with the change; statistic: F then, ``before`` without.

    parameters: how many numbers were chosen to fit.
    """

    name: str
    cause: str
    change: str
    ids: tuple[str, ...]
    parameters: int
    before: float = 1.0
    statistic: float = 1.0
    p: float = 1.0


_Trial = tuple[Between, Epoch, FloatArray]
"""A cause, the second epoch as it would be without it, and what moves freely between the two (7, k)."""


def causes_between(
    first: Adjustment, second: Adjustment, found: Congruence, options: CongruenceOptions
) -> tuple[Between, ...]:
    """What explains that two epochs are not congruent, the simplest first; empty where only motions do, or nothing.

    found: their congruence with these options.
    """
    if found.before.passed or found.before.p > _WRONG:
        return ()
    both, out = common(first, second, options), []
    if not all(np.isfinite(origin(v)).all() for s in (both.before, both.after) for v in s.values):
        return ()  # rotations alone have neither places nor scale
    whole = replace(options, search=False, reference=None)
    for make in (_exchanged, _scaled, _mirrored, _elsewhere):
        for cause, after, directions in make(both, found):
            try:
                after = aligned(both.before, after, directions, range(len(both.names)))
                test = compare(replace(both, after=after, directions=directions), whole).before
            except SurveyError:  # a motion more than the common points can carry
                continue
            if test.p > _FITS:
                out.append(replace(cause, before=found.before.statistic, statistic=test.statistic, p=test.p))
    return tuple(sorted(out, key=lambda b: (b.parameters, b.statistic)))


def _places(both: Common) -> tuple[FloatArray, FloatArray]:
    """(n, 3) m before and after."""
    before, after = (np.array([origin(v) for v in s.values]) for s in (both.before, both.after))
    return before, after


def _exchanged(both: Common, found: Congruence) -> Iterator[_Trial]:
    """Two of what moved, each to where the other was."""
    kinds = {n: isinstance(v, Pose3) for n, v in zip(both.names, both.before.values, strict=True)}
    shifts = {m.name: m.displacement for m in found.motions if m.significant}
    largest = sorted(shifts, key=lambda n: -float(np.linalg.norm(shifts[n])))[:_MOST_PAIRS]
    for a, b in combinations(largest, 2):
        apart = origin(both.before.value(b)) - origin(both.before.value(a))
        miss = max(float(np.linalg.norm(x)) for x in (shifts[a] - apart, shifts[b] + apart))
        if kinds[a] == kinds[b] and miss < _NEAR * float(np.linalg.norm(apart)):
            other = {a: b, b: a}
            order = [other.get(n, n) for n in both.names]
            after = replace(both.after.part(order), names=both.names)
            yield Between(
                "names exchanged", f"{a[1]} and {b[1]} are called by each other's names in {found.epochs[1]}",
                f"exchange them in the tables of {found.epochs[1]}", (a[1], b[1]), 1,
            ), after, both.directions  # fmt: skip


def _scaled(both: Common, found: Congruence) -> Iterator[_Trial]:
    """One scale of all lengths: a unit, or what gives the scale."""
    if len(both.names) < 3:
        return
    x, y = _places(both)
    many = len(x) > _MOST_IN_PAIRS
    i, j = np.random.default_rng(0).integers(len(x), size=(2, _PAIRS)) if many else np.triu_indices(len(x), 1)
    was, now = (np.linalg.norm(p[i] - p[j], axis=1) for p in (x, y))
    good = (was > 0.0) & (now > 0.0)
    ratio = float(np.median(was[good] / now[good])) if good.any() else 1.0
    after = moved(both.after, np.array([0.0, 0, 0, 0, 0, 0, np.log(ratio)]))
    unit = next((said for said, r in LENGTH_RATIOS.items() if abs(ratio / r - 1.0) < _EXACT), None)
    epoch = found.epochs[1]
    if unit:
        cause = Between("unit of lengths", f"all lengths of {epoch} {unit}", f"correct the unit in {epoch}", (), 1)
    else:
        longer = f"{1e6 * (1.0 / ratio - 1.0):+.1f} ppm longer than those of {found.epochs[0]}"
        cause = Between("scale", f"all lengths of {epoch} are {longer}", "compare what gives the scale in both: board "
                        "or scale bar, its temperature, the distance meter", (), 2)  # fmt: skip
    yield cause, after, _with(both.directions, _SCALE)


def _mirrored(both: Common, found: Congruence) -> Iterator[_Trial]:
    """The second epoch left-handed: one axis the other way round, or two exchanged. Of points alone."""
    if any(isinstance(v, Pose3) for v in both.before.values) or len(both.names) < 4:
        return
    S = np.diag([1.0, 1.0, -1.0])
    flipped = both.after.mapped(tuple(S @ origin(v) for v in both.after.values), S, 1.0)
    x, y = _places(replace(both, after=flipped))
    epoch = found.epochs[1]
    cause = Between("mirrored", f"{epoch} is the mirror image of {found.epochs[0]}: one of the two is left-handed",
                    f"exchange x and y, or turn one axis round, in the given coordinates of {epoch}; or correct its "
                    "sense of bearings", (), 2)  # fmt: skip
    yield cause, _moved_by(flipped, align(x, y)), _with(both.directions, _RIGID)


def _elsewhere(both: Common, found: Congruence) -> Iterator[_Trial]:
    """All of it moved and turned as one: not what stands there, but what holds it."""
    if both.directions.shape[1] >= 6 or len(both.names) < 3:
        return
    x, y = _places(both)
    move = align(x, y)
    shift = float(np.linalg.norm(transform(move, y) - y, axis=1).max())
    turn = float(np.degrees(np.linalg.norm(rotation_log(move[:3, :3]))))
    names = listed([n[1] for n in both.names], 4)
    cause = Between(
        "another datum", f"all of {found.epochs[1]} ({names}) moved as one, by up to {1e3 * shift:.4g} mm and "
        f"{turn:.3g} deg: its datum is another, not its parts", "hold the same things at the same values in both "
        "epochs, or compare with inner constraints ([datum] kind = \"inner\")", (), 3,
    )  # fmt: skip
    yield cause, _moved_by(both.after, move), _with(both.directions, _RIGID)


def _moved_by(state: Epoch, move: FloatArray) -> Epoch:
    """By a rigid motion (4, 4)."""
    return moved(state, np.concatenate([move[:3, 3], rotation_log(move[:3, :3]), [0.0]]))


def _with(directions: FloatArray, more: FloatArray) -> FloatArray:
    """An orthonormal basis (7, k) of both."""
    u, s, _ = np.linalg.svd(np.column_stack([directions, more]), full_matrices=False)
    return np.asarray(u[:, s > 1e-9])
