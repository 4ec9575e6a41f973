"""Eyes of one station from what each of them saw: Gauss-Helmert model of ``A X = Z B`` and ``A X = X B``.

Observed are poses ``world_from_eye`` (or motions of an eye between two epochs), all with covariance. Two eyes k, l of
one station at one epoch give a condition without station pose,

    Log(X_l^-1 X_k P_k^-1 W_k^-1 W_l P_l) = 0,   X = station_from_eye, W = room_from_world, P = world_from_eye;

for motions the worlds are the eyes themselves, W = X. Every observation gets its residual, and the conditions are
linearised at the adjusted observations (Koch 1999, section 3.9.2; Helmert 1872), so the minimum is that of the graph
with all true poses as unknowns.
"""


import numpy as np
import scipy.linalg

from adjust.model.errors import NotConvergedError
from adjust.model.frozen import frozen
from adjust.model.survey import BoolArray, FloatArray, IntArray
from adjust.spatial.rigid_motions import Motions, right_jacobian, right_jacobian_inverse

_MOST_STEPS, _STILL = 50, 1e-9


@frozen(eq=False)
class EyeConditions:
    """m conditions between observed poses ``k_idx`` and ``l_idx`` (m,).

    Those of one ``k_idx`` stand together, each with an ``l_idx`` of its own that is nowhere a ``k_idx``: a star.
    eye_k, eye_l, world_k, world_l: (m,) which unknown each takes; of motions the worlds are the eyes.
    scale_k, scale_l: (m,) which unknown scale of lengths each takes, -1 for none.
    """

    k_idx: IntArray
    l_idx: IntArray
    eye_k: IntArray
    eye_l: IntArray
    world_k: IntArray
    world_l: IntArray
    scale_k: IntArray
    scale_l: IntArray

    def __len__(self) -> int:
        return len(self.k_idx)

    def __getitem__(self, mask: BoolArray) -> "EyeConditions":
        return EyeConditions(*(getattr(self, name)[mask] for name in self.__dataclass_fields__))


@frozen(eq=False)
class EyeProblem:
    """observed: (n,) poses or motions. cov: (n, 6, 6), or the joint one (6n, 6n). free: which of the unknowns (u,) are.

    n_scales: unknown scales of lengths, as exponents.
    """

    observed: Motions
    cov: FloatArray
    conditions: EyeConditions
    start: Motions
    free: BoolArray
    n_scales: int = 0


@frozen(eq=False)
class EyeSolution:
    """unknowns: (u,). scales: exponents. cov: (6f + s,) squared, of the free unknowns in order and then the scales.

    residuals: (n, 6) of the observations, adjusted minus observed in their tangents. misclosure: (m, 6) after it,
    test: (m,) of it, chi-square with 6 degrees of freedom.
    influence: (6f + s, 6n) derivative of the unknowns by the observations. omega: v'Pv.
    """

    problem: EyeProblem
    unknowns: Motions
    scales: FloatArray
    cov: FloatArray
    residuals: FloatArray
    misclosure: FloatArray
    test: FloatArray
    influence: FloatArray
    omega: float
    redundancy: int
    iterations: int

    def rows(self, idx: int) -> IntArray:
        """Rows of an unknown in ``cov``; empty where it is held."""
        free = self.problem.free
        return 6 * np.count_nonzero(free[:idx]) + np.arange(6 if free[idx] else 0, dtype=np.int64)


@frozen(eq=False)
class Linearised:
    """f (m, 6) and its derivatives: by_k, by_l (m, 6, 6) observations, by (6m, 6f + s) unknowns, dense."""

    f: FloatArray
    by_k: FloatArray
    by_l: FloatArray
    by: FloatArray


def linearise(problem: EyeProblem, U: Motions, scales: FloatArray, v: FloatArray) -> Linearised:
    """The conditions at unknowns ``U`` and observations moved by ``v`` (n, 6)."""
    c = problem.conditions
    moved = problem.observed.retract(v)
    Pk, Pl = (moved[i].rescaled(_factor(s, scales)) for i, s in ((c.k_idx, c.scale_k), (c.l_idx, c.scale_l)))
    back = Pk.inverse() @ U[c.world_k].inverse() @ U[c.world_l] @ Pl
    C = U[c.eye_l].inverse() @ U[c.eye_k] @ back
    f = C.log()
    J = right_jacobian_inverse(f)
    by_eye_k = J @ back.inverse().adjoint()
    by_world_k = -J @ (U[c.world_k].inverse() @ U[c.world_l] @ Pl).inverse().adjoint()
    by_pose_k, by_pose_l = -by_eye_k, J
    by = np.zeros((len(c), 6, 6 * len(U) + problem.n_scales))
    by_unknown, row = by[:, :, : 6 * len(U)].reshape(len(c), 6, len(U), 6), np.arange(len(c))
    parts = by_eye_k, -J @ C.inverse().adjoint(), by_world_k, J @ Pl.inverse().adjoint()
    for idx, D in zip((c.eye_k, c.eye_l, c.world_k, c.world_l), parts, strict=True):
        by_unknown[row, :, idx] += D  # each row once, so nothing is lost
    for idx, pose, D in ((c.scale_k, Pk, by_pose_k), (c.scale_l, Pl, by_pose_l)):
        has = idx >= 0
        if has.any():
            by[row[has], :, 6 * len(U) + idx[has]] += (D[has] @ _stretch(pose[has])[..., None])[..., 0]
    keep = np.concatenate([np.repeat(problem.free, 6), np.ones(problem.n_scales, dtype=np.bool_)])
    by_v = right_jacobian(v)
    return Linearised(
        f,
        by_pose_k @ _unscaled(c.scale_k, scales) @ by_v[c.k_idx],
        by_pose_l @ _unscaled(c.scale_l, scales) @ by_v[c.l_idx],
        by[:, :, keep].reshape(6 * len(c), -1),
    )


def _factor(idx: IntArray, scales: FloatArray) -> FloatArray:
    return np.asarray(np.exp(np.append(scales, 0.0)[idx]))  # -1 takes the zero at the end


def _unscaled(idx: IntArray, scales: FloatArray) -> FloatArray:
    """How the tangent of a pose changes where its lengths are scaled, (m, 6, 6)."""
    out = np.zeros((len(idx), 6, 6))
    out[:, range(3), range(3)] = 1.0
    out[:, range(3, 6), range(3, 6)] = _factor(idx, scales)[:, None]
    return out


def _stretch(pose: Motions) -> FloatArray:
    """Derivative (m, 6) of a pose in its tangent by the exponent of its lengths."""
    turned = (np.swapaxes(pose.rotation, -1, -2) @ pose.shifts[..., None])[..., 0]
    return np.concatenate([np.zeros_like(turned), turned], axis=1)


def own_blocks(problem: EyeProblem, at: Linearised) -> FloatArray:
    """Covariances (m, 6, 6) of the conditions by themselves; the two observations of one are of different eyes."""
    c, Q, n = problem.conditions, problem.cov, len(problem.observed)
    Q_k, Q_l = (Q[i] if Q.ndim == 3 else Q.reshape(n, 6, n, 6)[i, :, i, :] for i in (c.k_idx, c.l_idx))
    return np.asarray(at.by_k @ Q_k @ np.swapaxes(at.by_k, -1, -2) + at.by_l @ Q_l @ np.swapaxes(at.by_l, -1, -2))


class Weights:
    """M = B Q B' of the conditions, whose inverse is R' R, with Q block diagonal or full.

    stars: of conditions that share errors, (g, c) g times equally many, and their R (g, 6c, 6c).
    """

    def __init__(self, problem: EyeProblem, at: Linearised) -> None:
        self.at, self.conditions, self.Q, self.n = at, problem.conditions, problem.cov, len(problem.observed)
        m, k = len(at.f), self.conditions.k_idx
        self.first = np.flatnonzero(np.append(True, k[1:] != k[:-1]))[: len(k)]
        if self.Q.ndim == 3:
            many = np.diff(np.append(self.first, m))
            stars = [self.first[many == c][:, None] + np.arange(c) for c in np.unique(many).tolist()]
            self.stars = [(rows, self._root(rows)) for rows in stars]
        else:
            Bt = self.back(np.eye(6 * m)).reshape(-1, 6 * m)
            L = np.linalg.cholesky(Bt.T @ self.Q @ Bt)
            R = scipy.linalg.solve_triangular(L, np.eye(6 * m), lower=True)
            self.stars = [(np.arange(m)[None], R[None])]

    def _root(self, rows: IntArray) -> FloatArray:
        """Of stars (g, c)."""
        g, c = rows.shape
        B_k, B_l = self.at.by_k[rows].reshape(g, 6 * c, 6), self.at.by_l[rows]
        M = B_k @ self.Q[self.conditions.k_idx[rows[:, 0]]] @ np.swapaxes(B_k, -1, -2)
        own, each = B_l @ self.Q[self.conditions.l_idx[rows]] @ np.swapaxes(B_l, -1, -2), np.arange(c)
        M.reshape(g, c, 6, c, 6)[:, each, :, each] += np.swapaxes(own, 0, 1)
        return np.asarray(np.linalg.inv(np.linalg.cholesky(M)))

    def solve(self, right: FloatArray) -> FloatArray:
        """M^-1 of columns (6m, r)."""
        out, parts = np.empty_like(right), right.reshape(len(self.at.f), 6, -1)
        for rows, R in self.stars:
            y = np.swapaxes(R, -1, -2) @ (R @ parts[rows].reshape(len(rows), R.shape[1], -1))
            out.reshape(parts.shape)[rows] = y.reshape(*rows.shape, 6, -1)
        return out

    def across(self, v: FloatArray) -> FloatArray:
        """B v (6m,) of observations moved by v (n, 6)."""
        c = self.conditions
        of_k, of_l = (D @ v[i][..., None] for D, i in ((self.at.by_k, c.k_idx), (self.at.by_l, c.l_idx)))
        return np.asarray((of_k + of_l).ravel())

    def back(self, y: FloatArray) -> FloatArray:
        """B' y (n, 6, r) of columns (6m, r)."""
        c, parts = self.conditions, y.reshape(len(self.at.f), 6, -1)
        out = np.zeros((self.n, 6, parts.shape[2]))
        out[c.k_idx[self.first]] = np.add.reduceat(np.swapaxes(self.at.by_k, -1, -2) @ parts, self.first)
        out[c.l_idx] = np.swapaxes(self.at.by_l, -1, -2) @ parts
        return out

    def residuals(self, y: FloatArray) -> FloatArray:
        """Q B' y (n, 6, r) of columns (6m, r)."""
        B_y = self.back(y)
        joint = self.Q.ndim == 2
        return np.asarray((self.Q @ B_y.reshape(6 * self.n, -1)).reshape(B_y.shape) if joint else self.Q @ B_y)


class _Normals:
    """The normal equations N x = -right of the unknowns at a linearisation."""

    def __init__(self, problem: EyeProblem, U: Motions, scales: FloatArray, v: FloatArray) -> None:
        self.at = linearise(problem, U, scales, v)
        self.weights = Weights(problem, self.at)
        self.w = self.at.f.ravel() - self.weights.across(v)
        self.MA = self.weights.solve(self.at.by)
        self.N, self.right = self.at.by.T @ self.MA, self.MA.T @ self.w


def solve_eyes(problem: EyeProblem, before: EyeSolution | None = None) -> EyeSolution:
    """Least squares. Raises NotConvergedError; the caller has seen to it that everything is determined.

    before: of the same unknowns and observations, where to begin instead of at the start.
    """
    try:
        return _solved(problem, before)
    except (np.linalg.LinAlgError, RuntimeError) as error:  # a matrix that no factorisation takes
        raise NotConvergedError(
            f"the equations of the eyes cannot be solved ({error}): their poses do not belong together; check that the "
            "eyes are rigid on one station, the time offsets, and for wrong poses"
        ) from None


def _solved(problem: EyeProblem, before: EyeSolution | None) -> EyeSolution:
    U, scales, v = problem.start, np.zeros(problem.n_scales), np.zeros((len(problem.observed), 6))
    if before is not None:
        U, scales, v = before.unknowns, before.scales, before.residuals
    n_free = 6 * int(problem.free.sum())
    for iteration in range(1, _MOST_STEPS + 1):
        normals = _Normals(problem, U, scales, v)
        weights, by = normals.weights, normals.at.by
        step = -scipy.linalg.cho_solve(scipy.linalg.cho_factor(normals.N), normals.right)
        v = np.asarray(-weights.residuals(weights.solve(normals.w + by @ step))[..., 0])
        delta = np.zeros((len(U), 6))
        delta[problem.free] = step[:n_free].reshape(-1, 6)
        U, scales = U.retract(delta), scales + step[n_free:]
        moved = float(np.sqrt(step @ normals.N @ step))
        if moved < _STILL or (iteration > 8 and moved < 1e-6):
            return _finish(problem, U, scales, v, iteration)
    raise NotConvergedError(
        f"the eyes did not settle in {_MOST_STEPS} steps (last step {moved:.2g} sigma); look for wrong "
        "poses or epochs"
    )


def _finish(problem: EyeProblem, U: Motions, scales: FloatArray, v: FloatArray, iterations: int) -> EyeSolution:
    normals = _Normals(problem, U, scales, v)
    at, cov, w = normals.at, np.asarray(np.linalg.inv(normals.N)), normals.w
    omega = float(w @ normals.weights.solve(w))
    A, w = at.by.reshape(len(at.f), 6, -1), w.reshape(-1, 6)
    left = own_blocks(problem, at) - A @ cov @ np.swapaxes(A, -1, -2)
    test = np.einsum("mi,mij,mj->m", w, np.linalg.pinv(left, rcond=1e-9, hermitian=True), w)
    influence = np.asarray(-cov @ normals.weights.back(normals.MA).reshape(-1, len(cov)).T)
    redundancy = 6 * len(at.f) - len(cov)
    return EyeSolution(problem, U, scales, cov, v, w, test, influence, omega, redundancy, iterations)
