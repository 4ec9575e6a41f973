"""Single epochs that disagree with the rest: the angles that their images say, how else these may have come about."""

from dataclasses import replace

import numpy as np

from adjust.diagnosis.table.fit import TableFit, residuals
from adjust.diagnosis.table.views import TableViews
from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray, IntArray, Target
from adjust.spatial.averaging import wrapped
from adjust.spatial.rigid import inverse, rotation_exp, rotation_log, transform
from adjust.testing.distributions import chi2

_LIMIT = float(chi2.isf(1e-9, 6))


@frozen(eq=False)
class Reread:
    """Angles (k,) rad that the images of an epoch say, their sigmas, and whether they explain the images."""

    angles: FloatArray
    sigmas: FloatArray
    explains: bool


def outlying(fit: TableFit) -> IntArray:
    """Views that do not belong to the rest."""
    return np.flatnonzero(fit.chi2 > _LIMIT * fit.scale)


def displacement(views: TableViews, fit: TableFit, row: int) -> FloatArray:
    """(4, 4) ``place_from_seen``: how the outer thing of a view sits against where it belongs, in its own axes."""
    motions = views.motions(geometry=fit.geometry)
    table_from_seen = motions[views.epoch[row]] @ fit.mount_from_inner[views.inner[row]] @ views.poses[row]
    return np.asarray(inverse(fit.table_from_place[views.outer[row]]) @ table_from_seen)


def reread(views: TableViews, fit: TableFit, epoch: int) -> Reread:
    """The angles that bring the images of an epoch into line with those of all the others."""
    rows = np.flatnonzero(views.epoch == epoch)
    part = replace(views.only(rows), epoch=np.zeros(len(rows), dtype=np.int64))
    table_from_mount = np.array(
        [fit.table_from_place[p] @ inverse(fit.mount_from_inner[i] @ a)
         for p, i, a in zip(part.outer, part.inner, part.poses, strict=True)]
    )  # fmt: skip
    angles = _angles(views, table_from_mount[0][:3, :3])

    def misfit(a: FloatArray) -> tuple[FloatArray, FloatArray]:
        motions = part.motions(a[None], fit.geometry)
        return residuals(part, motions, fit.mount_from_inner, fit.table_from_place)[:2]

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


def reading_scatter(views: TableViews, fit: TableFit) -> FloatArray:
    """How well (k,) rad the images of a good epoch give its reading: robustly, from up to a dozen of them."""
    bad = set(views.epoch[outlying(fit)].tolist())
    good = [e for e in range(len(views.epoch_ids)) if e not in bad]
    good = good[:: max(1, len(good) // 12)]
    off = [np.abs(wrapped(reread(views, fit, e).angles - views.angles[e])) for e in good]
    return np.asarray(1.4826 * np.median(off, axis=0)) if off else np.zeros(views.angles.shape[1])


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


def meant_points(target: Target, place_from_seen: FloatArray) -> IntArray:
    """(n,) of each point of a target that appears displaced like that the one that stands there."""
    x = target.x_in_target
    return np.asarray(np.linalg.norm(transform(place_from_seen, x)[:, None] - x[None], axis=2).argmin(axis=1))


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
