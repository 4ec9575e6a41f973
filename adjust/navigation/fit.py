"""Least-squares pose from identified spots, with the errors of beacons and calibration in its covariance.

The noise of an epoch's residuals is ``Sigma = R + M M'``: the spots' own and what the common errors eta of beacons and
calibration (see :class:`~adjust.navigation.system.System`) do to them. The pose is the generalised least-squares one
for it (Koch 1999, section 3.2), and its error is ``gain noise + B eta``: B tells how the errors of all epochs hang
together.
"""


import numpy as np

from adjust.model.frozen import frozen
from adjust.model.survey import BoolArray, FloatArray, IntArray
from adjust.native.navigation import DONE, PoseArrays, PriorArrays, SpotArrays, gauss_newton
from adjust.navigation.system import Sightings
from adjust.spatial.rigid import inverse, rotation_exp, rotation_log
from adjust.spatial.rigid_motions import right_jacobian_inverse
from adjust.testing.gross_errors import Search, State, Verdicts, one_group

_NO_B: FloatArray = np.zeros((0, 0))
_NO_ROWS: IntArray = np.zeros(0, dtype=np.int64)
_LOG_2PI = float(np.log(2.0 * np.pi))


@frozen(eq=False)
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


@frozen(eq=False)
class PoseFit:
    """A pose (4, 4) from spots ``used`` (n,) of beacons ``beacon`` (n,) and perhaps a prior.

    residual, H, M: of spots, then prior rows, with R the covariance of their own errors; gain: (6, 2n + k) how these
    move the pose. cov: (6, 6). chi_square: v' inv(Sigma) v. log_det: ln det Sigma. log_det_cov: ln det cov.
    in_front: all beacons lie in front of their cameras.
    """

    used: IntArray
    beacon: IntArray
    pose: FloatArray
    residual: FloatArray
    H: FloatArray
    M: FloatArray
    cov: FloatArray
    gain: FloatArray
    R: FloatArray
    in_front: bool
    chi_square: float
    log_det: float
    log_det_cov: float

    @property
    def redundancy(self) -> int:
        """Observations and what is known beforehand, minus six."""
        return len(self.residual) - 6

    @property
    def B(self) -> FloatArray:
        """(6, r) by the errors common to all epochs."""
        return self.gain @ self.M

    @property
    def own_cov(self) -> FloatArray:
        """Covariance (6, 6) without these errors: of the spots and of the prior's own error."""
        return np.asarray(self.gain @ self.R @ self.gain.T)

    @property
    def posterior(self) -> Prior:
        """What it tells of the pose."""
        return Prior(self.pose, self.own_cov, self.B, np.arange(6))


def local(a: FloatArray, b: FloatArray) -> FloatArray:
    """The step (..., 6) with ``b = a * (Exp(step[:3]), step[3:])``: rotation and translation are stepped apart."""
    step = inverse(a) @ b
    return np.concatenate([rotation_log(step[..., :3, :3]), step[..., :3, 3]], axis=-1)


def local_derivative(step: FloatArray) -> FloatArray:
    """Derivative (6, 6) of ``local(a, b * d)`` by the step d at zero, where ``step = local(a, b)``."""
    out = np.zeros((6, 6))
    out[:3, :3], out[3:, 3:] = right_jacobian_inverse(step[:3]), rotation_exp(step[:3])
    return out


def fit_pose(
    seen: Sightings, used: IntArray, beacon: IntArray, start: FloatArray, prior: Prior | None = None
) -> PoseFit | None:
    """The pose from these spots (n,) and beacons (n,), by Gauss-Newton from ``start`` (4, 4).

    None where the observations leave a direction open, or the iteration does not settle.
    """
    known, cov = PriorArrays(np.ascontiguousarray(start), _NO_B, _NO_ROWS), _NO_B
    if prior is not None:
        known = PriorArrays(np.ascontiguousarray(prior.pose), np.ascontiguousarray(prior.B), prior.rows)
        cov = prior.cov[np.ix_(prior.rows, prior.rows)]
    n, system = 2 * len(used), seen.system.arrays
    m = n + len(cov)
    if m < 6:
        return None
    R = np.zeros((m, m))
    R[:n, :n], R[n:, n:] = seen.noise(used), cov
    out = PoseArrays(np.empty((4, 4)), np.empty(m), np.empty((m, 6)), np.empty((m, system.F.shape[1])),
                     np.empty((6, 6)), np.empty((6, m)))  # fmt: skip
    spots = SpotArrays(seen.camera[used], beacon, seen.uv[used])
    found = gauss_newton(system, np.ascontiguousarray(start), spots, R, known, out)
    return PoseFit(used, beacon, *out, R, *found[1:]) if found[0] == DONE else None


def log_evidence(fit: PoseFit) -> float:
    """-2 ln of the integral of the likelihood over the pose (Laplace's approximation), flat where nothing is known."""
    n = len(fit.residual)
    return fit.chi_square + fit.log_det + n * _LOG_2PI - (fit.log_det_cov + 6.0 * _LOG_2PI)


def spot_tests(fit: PoseFit) -> FloatArray:
    """Test value (n,) of each spot, chi-square with 2 degrees of freedom; nan where nothing checks the spot.

    Source: Foerstner and Wrobel 2016, Photogrammetric Computer Vision, section 4.6.4 (groups of observations).
    """
    Sigma = fit.R + fit.M @ fit.M.T
    P, Qvv = np.linalg.inv(Sigma), Sigma - fit.H @ fit.cov @ fit.H.T
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
    seen: Sightings, used: IntArray, beacon: IntArray, start: FloatArray, prior: Prior | None, alpha: float
) -> tuple[PoseFit | None, tuple[int, ...]]:
    """The fit after spots that fail the test (family-wise level alpha) were taken out, worst first; and which.

    None is taken out where the residuals of all are together far smaller than their sigmas say.
    """

    def solve(kept: BoolArray, before: State[PoseFit] | None) -> tuple[PoseFit, Verdicts] | None:
        at = start if before is None else before.solution.pose
        fit = fit_pose(seen, used[kept], beacon[kept], at, prior)
        if fit is None:
            return None
        values = np.full(len(used), np.nan)
        values[kept] = spot_tests(fit) if fit.redundancy > 0 else np.nan
        return fit, one_group(values, np.where(np.isnan(values), 0, 2), kept)

    search = Search(solve, alpha, many=np.inf)
    first = search.state(np.ones(len(used), dtype=np.bool_))
    if first is None or first.tests.cautious[0]:
        return (None if first is None else first.solution), ()
    last = search.settled(first)
    return last.solution, tuple(used[~last.tests.used].tolist())
