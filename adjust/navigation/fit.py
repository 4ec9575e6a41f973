"""Least-squares pose from identified spots, with the errors of beacons and calibration in its covariance.

The noise of an epoch's residuals is ``Sigma = R + M M'``: the spots' own and what the common errors eta of beacons and
calibration (see :class:`System`) do to them. The pose is the generalised least-squares one for it (Koch 1999, section
3.2), and its error is ``G noise + B eta``: B tells how the errors of all epochs hang together.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import dpotrf, dpotrs

from adjust.closed_forms.rigid import rotation_exp
from adjust.distributions import chi2
from adjust.model import FloatArray, IntArray
from adjust.navigation.pose_kernels import retracted, step_between
from adjust.navigation.system import Sightings, System, evaluate

MAX_ITERATIONS = 30
_SETTLED = 1e-4
_WEAK = 1e-9
_LOG_2PI = float(np.log(2.0 * np.pi))


@dataclass(frozen=True, eq=False)
class Prior:
    """Knowledge of the pose: its error is ``e + B eta`` with e of covariance cov (6, 6), all in its tangent.

    rows: (k,) the components that are known; of the others nothing is.
    """

    pose: FloatArray
    cov: FloatArray
    B: FloatArray
    rows: IntArray

    @property
    def total(self) -> FloatArray:
        """Covariance (6, 6) with the share of the common errors; meaningless outside ``rows``."""
        return np.asarray(self.cov + self.B @ self.B.T)


@dataclass(frozen=True, eq=False)
class PoseFit:
    """A pose (4, 4) from spots ``used`` (n,) of beacons ``beacon`` (n,) and perhaps a prior.

    G: (6, 2n) and G_prior (6, k): how noise of spots and prior moves the pose. B: (6, r). cov: (6, 6).
    chi_square: v' inv(Sigma) v. log_det: ln det Sigma. residual, Sigma, H: of spots, then prior rows.
    in_front: beacons in front. converged: the last step was small against its sigma.
    """

    pose: FloatArray
    used: IntArray
    beacon: IntArray
    cov: FloatArray
    G: FloatArray
    G_prior: FloatArray
    B: FloatArray
    chi_square: float
    redundancy: int
    log_det: float
    residual: FloatArray
    Sigma: FloatArray
    H: FloatArray
    M: FloatArray
    in_front: bool
    converged: bool


def cho_factor(matrix: FloatArray) -> FloatArray:
    """Lower Cholesky factor; raises LinAlgError. SciPy's own spends most of its time on checks of such small ones."""
    factor, info = dpotrf(matrix, lower=1)
    if info != 0:
        raise np.linalg.LinAlgError("not positive definite")
    return np.asarray(factor)


def cho_solve(factor: FloatArray, right: FloatArray) -> FloatArray:
    """Solve by the factor of :func:`cho_factor`; right (n,) or (n, k)."""
    return np.asarray(dpotrs(factor, right, lower=1)[0]).reshape(right.shape) if len(right) else right


@dataclass(frozen=True, eq=False)
class _Rows:
    residual: FloatArray
    H: FloatArray
    M: FloatArray
    R: FloatArray
    in_front: bool


def retract(pose: FloatArray, step: FloatArray) -> FloatArray:
    """``pose * Exp(step)``: rotation and translation are stepped apart, exact to first order at ``step = 0``."""
    return np.asarray(retracted(pose, step))


def local(a: FloatArray, b: FloatArray) -> FloatArray:
    """The step (6,) with ``retract(a, step) = b``."""
    return np.asarray(step_between(a, b))


def local_derivative(step: FloatArray) -> FloatArray:
    """Derivative (6, 6) of ``local(a, retract(b, d))`` by d at zero, where ``step = local(a, b)``."""
    w = step[:3]
    angle = float(np.linalg.norm(w))
    k = np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])
    # inverse of the right Jacobian of SO(3) (Chirikjian 2012, eq. 10.86)
    beta = 1.0 / 12.0 if angle < 1e-4 else 1.0 / angle**2 - (1.0 + np.cos(angle)) / (2.0 * angle * np.sin(angle))
    out = np.zeros((6, 6))
    out[:3, :3] = np.eye(3) + 0.5 * k + beta * (k @ k)
    out[3:, 3:] = rotation_exp(w)
    return out


def _rows(
    system: System, seen: Sightings, used: IntArray, beacon: IntArray, pose: FloatArray, prior: Prior | None
) -> _Rows:
    residual, H, M, in_front = evaluate(system, pose, seen.camera[used], beacon, seen.uv[used])
    n, k = 2 * len(used), 0 if prior is None else len(prior.rows)
    R = np.zeros((n + k, n + k))
    even = np.arange(0, n, 2)
    cov = seen.cov[used]
    R[even, even], R[even, even + 1] = cov[:, 0, 0], cov[:, 0, 1]
    R[even + 1, even], R[even + 1, even + 1] = cov[:, 1, 0], cov[:, 1, 1]
    if prior is not None:
        step = local(prior.pose, pose)
        residual = np.concatenate([residual, step[prior.rows]])
        H = np.concatenate([H, local_derivative(step)[prior.rows]])
        M = np.concatenate([M, -prior.B[prior.rows]])
        R[n:, n:] = prior.cov[np.ix_(prior.rows, prior.rows)]
    return _Rows(residual, H, M, R, in_front)


def fit_pose(
    system: System, seen: Sightings, used: IntArray, beacon: IntArray, start: FloatArray, prior: Prior | None = None
) -> PoseFit | None:
    """The pose from these spots (n,) and beacons (n,), by Gauss-Newton from ``start`` (4, 4).

    None where the observations leave a direction open, or the iteration does not settle.
    """
    if 2 * len(used) + (0 if prior is None else len(prior.rows)) < 6:
        return None
    pose, rows = start, _rows(system, seen, used, beacon, start, prior)
    converged = False
    for _ in range(MAX_ITERATIONS):
        solved = _step(rows)
        if solved is None:
            return None
        step, _, factor = solved
        size = float(np.sqrt(max(float(step @ (rows.H.T @ cho_solve(factor, rows.H @ step))), 0.0)))
        length = float(np.linalg.norm(step[:3]))
        step = step * min(1.0, 0.5 / max(length, 0.5))
        pose, rows, moved = _shortened(system, seen, used, beacon, prior, pose, rows, step, factor)
        if size < _SETTLED or not moved:
            converged = size < 1e-2
            break
    return _finished(pose, rows, used, beacon, converged) if converged else None


def _step(rows: _Rows) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    try:
        factor = cho_factor(rows.R + rows.M @ rows.M.T)
        PH = cho_solve(factor, rows.H)
        normal = rows.H.T @ PH
        scale = 1.0 / np.sqrt(np.diag(normal))
        values, vectors = np.linalg.eigh(normal * np.outer(scale, scale))
    except (np.linalg.LinAlgError, ValueError):
        return None
    if not np.isfinite(values).all() or values[0] < _WEAK:
        return None
    C = (vectors / values) @ vectors.T * np.outer(scale, scale)
    return -C @ (PH.T @ rows.residual), C, factor


def _shortened(
    system: System, seen: Sightings, used: IntArray, beacon: IntArray, prior: Prior | None, pose: FloatArray,
    rows: _Rows, step: FloatArray, factor: FloatArray,
) -> tuple[FloatArray, _Rows, bool]:  # fmt: skip
    """The step, halved until it lowers the weighted squares; the last is whether there was such a step."""
    before = float(rows.residual @ cho_solve(factor, rows.residual))
    for _ in range(6):
        trial = retract(pose, step)
        new = _rows(system, seen, used, beacon, trial, prior)
        after = float(new.residual @ cho_solve(factor, new.residual))
        if after <= before * (1.0 + 1e-9) + 1e-9 and (new.in_front or not rows.in_front):
            return trial, new, True
        step = 0.5 * step
    return pose, rows, False


def _finished(pose: FloatArray, rows: _Rows, used: IntArray, beacon: IntArray, converged: bool) -> PoseFit | None:
    solved = _step(rows)
    if solved is None:
        return None
    _, C, factor = solved
    gain = -C @ cho_solve(factor, rows.H).T
    n = 2 * len(used)
    Sigma = rows.R + rows.M @ rows.M.T
    chi_square = float(rows.residual @ cho_solve(factor, rows.residual))
    log_det = 2.0 * float(np.log(np.diag(factor)).sum())
    return PoseFit(
        pose, used, beacon, C, gain[:, :n], gain[:, n:], gain @ rows.M, chi_square, len(rows.residual) - 6, log_det,
        rows.residual, Sigma, rows.H, rows.M, rows.in_front, converged,
    )  # fmt: skip


def log_evidence(fit: PoseFit) -> float:
    """-2 ln of the integral of the likelihood over the pose (Laplace's approximation), flat where nothing is known."""
    n = len(fit.residual)
    log_cov = float(np.linalg.slogdet(fit.cov)[1])
    return fit.chi_square + fit.log_det + n * _LOG_2PI - (log_cov + 6.0 * _LOG_2PI)


def spot_tests(fit: PoseFit) -> FloatArray:
    """Test value (n,) of each spot, chi-square with 2 degrees of freedom; nan where nothing checks the spot.

    Source: Foerstner and Wrobel 2016, Photogrammetric Computer Vision, section 4.6.4 (groups of observations).
    """
    P = np.linalg.inv(fit.Sigma)
    Qvv = fit.Sigma - fit.H @ fit.cov @ fit.H.T
    Pv, PQP = P @ fit.residual, P @ Qvv @ P
    out = np.full(len(fit.used), np.nan)
    for i in range(len(fit.used)):
        part = slice(2 * i, 2 * i + 2)
        block = PQP[part, part]
        # redundancy of a spot in units of its own weight; below, a gross error has no trace
        if np.linalg.eigvalsh(block)[0] > 1e-6 * P[part, part].max():
            out[i] = float(Pv[part] @ np.linalg.solve(block, Pv[part]))
    return out


def fit_without_outliers(
    system: System, seen: Sightings, used: IntArray, beacon: IntArray, start: FloatArray, prior: Prior | None,
    alpha: float,
) -> tuple[PoseFit | None, tuple[int, ...]]:  # fmt: skip
    """The fit after spots that fail the test (family-wise level alpha) were taken out, worst first; and which."""
    rejected: list[int] = []
    fit = fit_pose(system, seen, used, beacon, start, prior)
    while fit is not None and fit.redundancy > 0:
        values = spot_tests(fit)
        if np.isnan(values).all():
            break
        worst = int(np.nanargmax(values))
        if values[worst] < chi2.isf(alpha / len(values), 2):
            break
        keep = np.arange(len(used)) != worst
        again = fit_pose(system, seen, used[keep], beacon[keep], fit.pose, prior)
        if again is None:
            break
        rejected.append(int(used[worst]))
        used, beacon, fit = used[keep], beacon[keep], again
    return fit, tuple(rejected)
