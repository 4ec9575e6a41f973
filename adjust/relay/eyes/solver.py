"""Eyes of one station from what each of them saw: Gauss-Helmert model of ``A X = Z B`` and ``A X = X B``.

Observed are poses ``world_from_eye`` (or motions of an eye between two epochs), all with covariance. Two eyes k, l of
one station at one epoch give a condition without station pose,

    Log(X_l^-1 X_k P_k^-1 W_k^-1 W_l P_l) = 0,   X = station_from_eye, W = room_from_world, P = world_from_eye;

for motions the worlds are the eyes themselves, W = X. Every observation gets its residual, and the conditions are
linearised at the adjusted observations (Koch 1999, section 3.9.2; Helmert 1872), so the minimum is that of the graph
with all true poses as unknowns.
"""

from dataclasses import dataclass

import numpy as np
import scipy.linalg
import scipy.sparse as sp

from adjust.graph.elimination import positive_definite_lu
from adjust.model.errors import NotConvergedError
from adjust.model.survey import BoolArray, FloatArray, IntArray
from adjust.spatial.rigid_motions import Motions, right_jacobian, right_jacobian_inverse

_MOST_STEPS, _STILL = 50, 1e-9


@dataclass(frozen=True, eq=False)
class EyeConditions:
    """m conditions between observed poses ``k_idx`` and ``l_idx`` (m,).

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


@dataclass(frozen=True, eq=False)
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


@dataclass(frozen=True, eq=False)
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


@dataclass(frozen=True, eq=False)
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
    row = np.arange(len(c))
    parts = by_eye_k, -J @ C.inverse().adjoint(), by_world_k, J @ Pl.inverse().adjoint()
    for idx, D in zip((c.eye_k, c.eye_l, c.world_k, c.world_l), parts, strict=True):
        for j in range(6):
            by[row, :, 6 * idx + j] += D[:, :, j]  # each row once, so nothing is lost
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
    """M = B Q B' of the conditions, factorised, with Q block diagonal or full."""

    def __init__(self, problem: EyeProblem, at: Linearised) -> None:
        m, n = len(at.f), len(problem.observed)
        order, ptr = ((at.by_k, problem.conditions.k_idx), (at.by_l, problem.conditions.l_idx)), np.arange(m + 1)
        B_k, B_l = (sp.bsr_array((np.ascontiguousarray(D), i, ptr), shape=(6 * m, 6 * n)) for D, i in order)
        self.B = (B_k + B_l).tocsr()
        if problem.cov.ndim == 3:
            Q = sp.bsr_array((np.ascontiguousarray(problem.cov), np.arange(n), np.arange(n + 1)), shape=(6 * n, 6 * n))
            self.QBt = (Q @ self.B.T).tocsc()
            self.solve = positive_definite_lu((self.B @ self.QBt).tocsc()).solve
        else:
            self.QBt = np.asarray(problem.cov @ self.B.T.toarray())
            root = scipy.linalg.cho_factor(np.asarray(self.B @ self.QBt))
            self.solve = lambda right: scipy.linalg.cho_solve(root, right)


class _Normals:
    """The normal equations N x = -right of the unknowns at a linearisation."""

    def __init__(self, problem: EyeProblem, U: Motions, scales: FloatArray, v: FloatArray) -> None:
        self.at = linearise(problem, U, scales, v)
        self.weights = Weights(problem, self.at)
        self.w = self.at.f.ravel() - self.weights.B @ v.ravel()
        self.MA = np.asarray(self.weights.solve(self.at.by))
        self.N, self.right = self.at.by.T @ self.MA, self.MA.T @ self.w


def solve_eyes(problem: EyeProblem) -> EyeSolution:
    """Least squares. Raises NotConvergedError; the caller has seen to it that everything is determined."""
    try:
        return _solved(problem)
    except (np.linalg.LinAlgError, RuntimeError) as error:  # a matrix that no factorisation takes
        raise NotConvergedError(
            f"the equations of the eyes cannot be solved ({error}): their poses do not belong together; check that the "
            "eyes are rigid on one station, the time offsets, and for wrong poses"
        ) from None


def _solved(problem: EyeProblem) -> EyeSolution:
    U, scales = problem.start, np.zeros(problem.n_scales)
    v = np.zeros((len(problem.observed), 6))
    n_free = 6 * int(problem.free.sum())
    for iteration in range(1, _MOST_STEPS + 1):
        normals = _Normals(problem, U, scales, v)
        weights, by = normals.weights, normals.at.by
        step = -scipy.linalg.cho_solve(scipy.linalg.cho_factor(normals.N), normals.right)
        v = np.asarray(-(weights.QBt @ weights.solve(normals.w + by @ step))).reshape(-1, 6)
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
    at, cov, w = normals.at, np.linalg.inv(normals.N), normals.w
    omega = float(w @ np.asarray(normals.weights.solve(w)))
    A, w = at.by.reshape(len(at.f), 6, -1), w.reshape(-1, 6)
    left = own_blocks(problem, at) - A @ cov @ np.swapaxes(A, -1, -2)
    test = np.einsum("mi,mij,mj->m", w, np.linalg.pinv(left, rcond=1e-9, hermitian=True), w)
    influence = np.asarray(-cov @ (normals.weights.B.T @ normals.MA).T)
    redundancy = 6 * len(at.f) - len(cov)
    return EyeSolution(problem, U, scales, cov, v, w, test, influence, omega, redundancy, iterations)
