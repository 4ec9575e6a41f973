"""A target that stood in two places, and single epochs that disagree with the rest."""

from dataclasses import dataclass, replace

import numpy as np

from adjust.diagnosis.table.fit import Known, TableFit, fit_table, residuals
from adjust.diagnosis.table.views import TableViews
from adjust.model.survey import FloatArray, IntArray, Target
from adjust.spatial.rigid import inverse, rotation_exp, rotation_log, transform
from adjust.testing.distributions import chi2

LIMIT = float(chi2.isf(1e-9, 6))
_MOST_SPLITS = 40
_CAPPED = 100.0  # a view counts at most so many times the limit's share in comparing explanations
_LEAST = 2  # views of a second place
_VAGUE = 10.0  # a lens that is not yet well known gives no larger scale


@dataclass(frozen=True, eq=False)
class Places:
    """place (n,) of every view; the fit; and for a second place: its outer thing, or None."""

    place: IntArray
    fit: TableFit
    moved: int | None = None
    second: int = -1


@dataclass(frozen=True, eq=False)
class Reread:
    """Angles (k,) rad that the images of an epoch say, their sigmas, and whether they explain the images."""

    angles: FloatArray
    sigmas: FloatArray
    explains: bool


def cost(fit: TableFit, scale: float) -> float:
    """Sum of the views' squares, each bounded; ``scale`` the same for all that are compared."""
    return float(np.minimum(fit.chi2 / scale, _CAPPED).sum())


def outlying(fit: TableFit) -> IntArray:
    """Views that do not belong to the rest."""
    return np.flatnonzero(fit.chi2 > LIMIT * fit.scale)


def find_places(views: TableViews) -> Places | None:
    """Whether an outer thing stood in two places; None where nothing can be fitted."""
    known: Known = {}
    one = fit_table(views, views.outer, known=known)
    if one is None:
        return None
    if not len(outlying(one)) and one.scale < _VAGUE:
        return Places(views.outer, one)
    trials = [p for o in range(len(views.outer_ids)) for p in _splits(views, o)]
    fits = [(p, f) for p in trials if (f := fit_table(views, p, 6, known)) is not None]
    if not fits:
        return Places(views.outer, one)
    scale = min([one.scale, *(f.scale for _, f in fits)])
    place, fit = min(fits, key=lambda item: cost(item[1], scale))
    second = len(views.outer_ids)
    moved = int(views.outer[place == second][0])
    for _ in range(4):
        new = _reassigned(views, place, fit, moved, second)
        if new is None or np.array_equal(new, place):
            break
        again = fit_table(views, new)
        if again is None or cost(again, scale) > cost(fit, scale):
            break
        place, fit = new, again
    fit = fit_table(views, place) or fit
    gain = cost(one, scale) - cost(fit, scale)
    # a place of its own for one view explains any view: two must agree
    told = _agree(views, place, fit, moved, second) and _torn(one, place, moved, second, scale)
    if gain < 3.0 * LIMIT or not told:
        return Places(views.outer, one)
    return Places(place, fit, moved, second)


def _torn(one: TableFit, place: IntArray, moved: int, second: int, scale: float) -> bool:
    """Whether a single place is untenable for the views of one of the two, each by itself.

    Small errors of the lenses, summed over many views, are always explained a little better by a second place.
    """
    return any(float(np.median(one.chi2[place == p])) > LIMIT * scale for p in (moved, second))


def _agree(views: TableViews, place: IntArray, fit: TableFit, moved: int, second: int) -> bool:
    """Whether most views of the second place fit there, and do not fit the first one."""
    there = place == second
    at_first = _squares(views, np.where(there, moved, place), fit)
    limit = LIMIT * fit.scale
    good = (fit.chi2 < limit) & (at_first > limit)
    return int(good[there].sum()) >= max(_LEAST, (int(there.sum()) + 1) // 2)


def _squares(views: TableViews, place: IntArray, fit: TableFit) -> FloatArray:
    """(n,) of the views at other places of the same fit."""
    motions = views.motions(geometry=fit.geometry)
    r, info, _ = residuals(views, motions, fit.mount_from_inner, fit.table_from_place, place)
    return np.asarray(np.einsum("ni,nij,nj->n", r, info, r))


def _splits(views: TableViews, outer: int) -> list[IntArray]:
    """Trial assignments: from some epoch on, or to one inner thing, an outer thing is elsewhere."""
    mine = views.outer == outer
    epochs = np.unique(views.epoch[mine])
    second, out = len(views.outer_ids), []
    cuts = epochs[1:]
    for cut in cuts[:: max(1, len(cuts) // _MOST_SPLITS)]:
        out.append(np.where(mine & (views.epoch >= cut), second, views.outer))
    for i in range(len(views.inner_ids) if len(views.inner_ids) > 1 else 0):
        out.append(np.where(mine & (views.inner == i), second, views.outer))
    return [p for p in out if (p == second).any() and (p[mine] == outer).any()]


def _reassigned(views: TableViews, place: IntArray, fit: TableFit, moved: int, second: int) -> IntArray | None:
    """Every epoch of the moved thing at the place that suits its views better."""
    mine = views.outer == moved
    squares = [_squares(views, np.where(mine, p, place), fit) for p in (moved, second)]
    new = place.copy()
    for e in np.unique(views.epoch[mine]):
        rows = mine & (views.epoch == e)
        new[rows] = moved if squares[0][rows].sum() <= squares[1][rows].sum() else second
    mine_first = (new == moved).any()
    return new if mine_first and (new == second).any() else None


def displacement(views: TableViews, found: Places, row: int) -> FloatArray:
    """(4, 4) ``place_from_seen``: how the outer thing of a view sits against where it belongs, in its own axes."""
    fit = found.fit
    motions = views.motions(geometry=fit.geometry)
    table_from_seen = motions[views.epoch[row]] @ fit.mount_from_inner[views.inner[row]] @ views.poses[row]
    return np.asarray(inverse(fit.table_from_place[found.place[row]]) @ table_from_seen)


def reread(views: TableViews, found: Places, epoch: int) -> Reread:
    """The angles that bring the images of an epoch into line with those of all the others."""
    rows = np.flatnonzero(views.epoch == epoch)
    part = replace(views.only(rows), epoch=np.zeros(len(rows), dtype=np.int64))
    place, fit = found.place[rows], found.fit
    table_from_mount = np.array(
        [fit.table_from_place[p] @ inverse(fit.mount_from_inner[i] @ a)
         for p, i, a in zip(place, part.inner, part.poses, strict=True)]
    )  # fmt: skip
    angles = _angles(views, table_from_mount[0][:3, :3])

    def misfit(a: FloatArray) -> tuple[FloatArray, FloatArray]:
        motions = part.motions(a[None], fit.geometry)
        return residuals(part, motions, fit.mount_from_inner, fit.table_from_place, place)[:2]

    step = 1e-6
    for _ in range(6):
        r, info = misfit(angles)
        J = np.stack([(misfit(angles + step * d)[0] - r) / step for d in np.eye(len(angles))], axis=2)
        N = np.einsum("nia,nij,njb->ab", J, info, J)
        angles = angles - np.linalg.solve(N, np.einsum("nia,nij,nj->a", J, info, r))
    r, info = misfit(angles)
    left = float(np.einsum("ni,nij,nj->", r, info, r)) / fit.scale
    sigmas = np.sqrt(np.diag(np.linalg.inv(N)) * fit.scale)
    return Reread(angles, sigmas, left < float(chi2.isf(1e-9, 6 * len(rows) - len(angles))))


def reading_scatter(views: TableViews, found: Places) -> FloatArray:
    """How well (k,) rad the images of a good epoch give its reading: robustly, from up to a dozen of them."""
    bad = set(views.epoch[outlying(found.fit)].tolist())
    good = [e for e in range(len(views.epoch_ids)) if e not in bad]
    good = good[:: max(1, len(good) // 12)]
    off = [np.abs(wrapped(reread(views, found, e).angles - views.angles[e])) for e in good]
    return np.asarray(1.4826 * np.median(off, axis=0)) if off else np.zeros(views.angles.shape[1])


def wrapped(angle: FloatArray) -> FloatArray:
    """Angles (...,) rad as the nearest turn, from minus half a turn to half a turn."""
    return np.asarray((angle + np.pi) % (2.0 * np.pi) - np.pi)


def _angles(views: TableViews, R: FloatArray) -> FloatArray:
    """Angles (k,) rad with R1(a1) R2(a2) nearest to R, geometry and zeros of the table left aside."""
    axes = ["xyz".index(a) for a in views.table.axes]
    zeros = views.table.geometry.by_name
    p = axes[0]
    if len(axes) == 1:
        u, v = (p + 1) % 3, (p + 2) % 3
        return np.array([np.arctan2(R[v, u] - R[u, v], R[u, u] + R[v, v]) - zeros.get("zero_1", 0.0)])
    q = axes[1]
    third = 3 - p - q
    # R e_q = R1 e_q, and e_p' R = e_p' R2
    a1 = np.arctan2(R[third, q], R[q, q]) * (1.0 if (p + 1) % 3 == q else -1.0)
    a2 = np.arctan2(R[p, third], R[p, p]) * (1.0 if (q + 1) % 3 == third else -1.0)
    return np.array([a1 - zeros.get("zero_1", 0.0), a2 - zeros.get("zero_2", 0.0)])


def renumbered(target: Target, place_from_seen: FloatArray, tolerance_m: float) -> str:
    """How the target's points may have been numbered wrongly to appear displaced like that; empty where not so."""
    x = target.x_in_target
    centred = x - x.mean(axis=0)
    _, s, vt = np.linalg.svd(centred, full_matrices=False)
    if len(x) < 4 or s[2] > 1e-3 * s[1]:
        return ""
    moved = transform(place_from_seen, x)
    nearest = np.linalg.norm(moved[:, None] - x[None], axis=2).min(axis=1)
    pitch = float(np.partition(np.linalg.norm(x[:, None] - x[None], axis=2), 1, axis=1)[:, 1].min())
    fitting = nearest < min(0.2 * pitch, 5.0 * tolerance_m + 0.02 * pitch)
    angle = float(np.linalg.norm(rotation_log(place_from_seen[:3, :3])))
    for turn in (np.pi, np.pi / 2):
        R = rotation_exp(vt[2] * turn)
        maps = np.linalg.norm((centred @ R.T)[:, None] - centred[None], axis=2).min(axis=1) < 1e-3 * pitch
        if maps.all() and fitting.all() and abs(angle - turn) < 0.1:
            opposite = "at the opposite corner" if turn == np.pi else "at the next corner"
            return (f"its points are numbered from the wrong corner ({opposite}: the pattern turned by "
                    f"{np.degrees(turn):.0f} deg)")  # fmt: skip
    shift = place_from_seen[:3, 3]
    if angle < 0.02 and 0.5 * pitch < float(np.linalg.norm(shift)) and 2 * int(fitting.sum()) >= len(x):
        return f"its points are numbered one or more rows or columns off (shift {1e3 * np.linalg.norm(shift):.1f} mm)"
    return ""
