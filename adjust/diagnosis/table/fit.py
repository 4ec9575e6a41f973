"""The two constant poses around a table's motion, from views that may partly be wrong.

Every view says ``inner_from_outer = inner_from_mount * mount_from_table(angles) * table_from_outer``.
"""


import numpy as np

from adjust.diagnosis.table.views import TableViews, given_geometry
from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray, IntArray
from adjust.spatial.averaging import mean_pose
from adjust.spatial.rigid import adjoint, inverse, rigid, rotation_exp, rotation_log
from adjust.start.closed_forms.hand_eye import relative_motions, solve_ax_xb, solve_ax_zb

_MEDIAN_6 = 5.348  # of chi-square with six degrees of freedom
_BOUND = 30.0  # weights fall beyond this many times the median
_LEVER_M = 1.0
_STEPS = 12
_GEOMETRY_SIGMAS = np.array([np.radians(1.0), 0.02])  # weak: only so that no direction is wholly open


@frozen(eq=False)
class TableFit:
    """mount_from_inner (c, 4, 4), table_from_place (p, 4, 4), chi2 (n,) of each view, and ``scale``.

    geometry: (2,) non-orthogonality (rad) and axis offset (m), found where the table has them free.
    scale: how many times larger than the noise of the points the variance of most views is (a lens not yet well known
    has its share); at least 1.
    """

    mount_from_inner: FloatArray
    table_from_place: FloatArray
    geometry: FloatArray
    chi2: FloatArray
    scale: float


def residuals(
    views: TableViews, motions: FloatArray, X: FloatArray, Z: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Residuals (n, 6) rad and m in the mount, their information (n, 6, 6), and mount_from_table (n, 4, 4)."""
    mount_from_table = inverse(motions)[views.epoch]
    seen = X[views.inner] @ views.poses
    error = seen @ inverse(mount_from_table @ Z[views.outer])
    A = adjoint(X[views.inner])
    r = np.concatenate([rotation_log(error[:, :3, :3]), error[:, :3, 3]], axis=1)
    return r, _inverse(A @ views.cov @ A.swapaxes(1, 2)), mount_from_table


def fit_table(views: TableViews) -> TableFit | None:
    """Robust least squares. None where nothing starts.

    Gauss-Newton with Geman-McClure weights whose scale follows the median.
    """
    geometry = given_geometry(views.table)
    begun = _start(views, views.motions(geometry=geometry))
    if begun is None:
        return None
    X, Z = begun
    groups = _groups(views, len(X), len(Z))
    by_geometry = (views.by_geometry() * _free_geometry(views))[views.epoch]
    for step in range(_STEPS + 1):
        r, info, mount_from_table = residuals(views, views.motions(geometry=geometry), X, Z)
        if not np.isfinite(r).all():
            return None
        chi2 = np.einsum("ni,nij,nj->n", r, info, r)
        scale = max(1.0, float(np.median(chi2)) / _MEDIAN_6)
        if step < _STEPS:
            weights = (1.0 / (1.0 + chi2 / (_BOUND * _MEDIAN_6 * scale))) ** 2
            own = np.broadcast_to(np.eye(6), info.shape)
            J = np.concatenate([own, -adjoint(mount_from_table), by_geometry], axis=2)
            X, Z, geometry = _improved(views, groups, X, Z, geometry, r, J, info * weights[:, None, None])
    return TableFit(X, Z, geometry, chi2, scale)


def _groups(views: TableViews, n_inner: int, n_places: int) -> list[tuple[IntArray, IntArray]]:
    """Views (m,) of one inner thing and one place each, and the unknowns (14,) of the two and of the geometry."""
    pair = views.inner * n_places + views.outer
    out, step, n = [], np.arange(6), 6 * (n_inner + n_places)
    for one in np.unique(pair).tolist():
        inner, outer = divmod(one, n_places)
        at = np.concatenate([6 * inner + step, 6 * (n_inner + outer) + step, [n, n + 1]])
        out.append((np.flatnonzero(pair == one), at))
    return out


def _inverse(cov: FloatArray) -> FloatArray:
    """Inverse of covariances (n, 6, 6) whose rows differ much in size."""
    d = 1.0 / np.sqrt(np.einsum("nii->ni", cov))
    outer = d[:, :, None] * d[:, None, :]
    return np.asarray(np.linalg.inv(cov * outer + 1e-12 * np.eye(6)) * outer)


def _improved(
    views: TableViews, groups: list[tuple[IntArray, IntArray]], X: FloatArray, Z: FloatArray, geometry: FloatArray,
    r: FloatArray, J: FloatArray, W: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:  # fmt: skip
    """One step of Gauss-Newton; J: (n, 6, 14) derivatives by the unknowns of each view, W: (n, 6, 6) weights."""
    n = 6 * (len(X) + len(Z))
    N, b = np.zeros((n + 2, n + 2)), np.zeros(n + 2)
    WJ, k = W @ J, J.shape[2]
    for rows, at in groups:
        weighted = WJ[rows].reshape(-1, k).T
        N[at[:, None], at] += weighted @ J[rows].reshape(-1, k)
        b[at] -= weighted @ r[rows].ravel()
    weak = 1.0 / _GEOMETRY_SIGMAS**2
    N[[n, n + 1], [n, n + 1]] += weak
    b[n:] -= weak * (geometry - given_geometry(views.table))
    d = np.sqrt(np.maximum(np.diag(N), 1e-300))
    delta = np.linalg.lstsq(N / np.outer(d, d), b / d, rcond=1e-12)[0] / d
    small = delta[:n].reshape(-1, 6)
    moved = rigid(rotation_exp(small[:, :3]), small[:, 3:])
    return moved[: len(X)] @ X, moved[len(X) :] @ Z, geometry + delta[n:] * _free_geometry(views)


def _free_geometry(views: TableViews) -> FloatArray:
    free = views.table.geometry.free
    return np.array([float("non_orthogonality" in free), float("axis_offset" in free)])


def _start(views: TableViews, motions: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    """Closed form for the group of views with most turns, then one constant pose after the other."""
    n_places = len(views.outer_ids)
    X: dict[int, FloatArray] = {}
    Z: dict[int, FloatArray] = {}
    groups = sorted(set(zip(views.inner.tolist(), views.outer.tolist(), strict=True)))
    rows = {g: np.flatnonzero((views.inner == g[0]) & (views.outer == g[1])) for g in groups}
    M = motions[views.epoch]
    for g in sorted(groups, key=lambda g: -len(rows[g])):
        found = _closed_form(M[rows[g]], views.poses[rows[g]])
        if found is not None:
            X[g[0]], Z[g[1]] = found
            break
    else:
        return None
    while True:
        open_ones = [g for g in groups if (g[0] in X) != (g[1] in Z)]
        if not open_ones:
            break
        i, p = max(open_ones, key=lambda g: len(rows[g]))
        use = rows[i, p]
        if i in X:
            Z[p] = _mean(M[use] @ X[i] @ views.poses[use])
        else:
            X[i] = _mean(inverse(M[use]) @ Z[p] @ inverse(views.poses[use]))
    if len(X) < len(views.inner_ids) or len(Z) < n_places:
        return None
    return np.array([X[i] for i in range(len(X))]), np.array([Z[p] for p in range(n_places)])


def _mean(offers: FloatArray) -> FloatArray:
    return mean_pose(offers, _LEVER_M)[0]


def _closed_form(motions: FloatArray, poses: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    try:
        Z, X, _ = solve_ax_zb(inverse(motions), poses)
        return X, Z
    except (SurveyError, np.linalg.LinAlgError):
        pass
    if len(poses) < 2:
        return None
    try:  # one axis: a consistent solution
        a, b = relative_motions(inverse(motions), poses)
        Z, _ = solve_ax_xb(a, b, True)
    except (SurveyError, np.linalg.LinAlgError):
        return None
    return _mean(inverse(motions) @ Z @ inverse(poses)), Z
