"""Monte Carlo of complete networks of n cameras, all pairs measured, as in table 1 of the relay-station paper.

True rotations: the Euler angles (zyx) of the pairs 1-2, 2-3, ... are uniform, x and z over the full turn, y over a
quarter turn to both sides. Noise: on the three Euler angles of every measured pair, or isotropic in the tangent. The
error of a pair is the Euler angles of ``true^-1 adjusted``, which are small rotations about its axes, and not the
difference of angles. Every trial is adjusted with the pairs' covariances and with equal weights.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from adjust.model.errors import SurveyError
from adjust.model.survey import BoolArray, FloatArray, IntArray
from adjust.spatial.rigid import rotation_exp
from adjust.spatial.rotation_forms import euler_from_matrix, euler_jacobian, matrix_from_euler
from tests.adjust.relay_trials import adjust_trials

Noise = Literal["euler", "tangent"]

_LIMIT = 1e-9  # rad, last step; what is left is a thousandth of it, and near gimbal lock rounding is not much less
_MOST = 30


@dataclass(frozen=True)
class MonteCarloOptions:
    """n_cameras: all measured with each other. sigma: rad, of every angle. chunk: trials at a time."""

    n_cameras: int = 4
    n_trials: int = 100_000
    sigma: float = float(np.radians(5.0 / 60.0))
    noise: Noise = "euler"
    seed: int = 0
    chunk: int = 10_000


@dataclass(frozen=True, eq=False)
class Errors:
    """Errors of the pairs over all trials: mean_abs and deviation of the absolute values (E, 3) rad, about x, y, z.

    rms: root mean square of all tangent components, rad. omega: mean v'Pv.
    """

    mean_abs: FloatArray
    deviation: FloatArray
    rms: float
    omega: float


@dataclass(frozen=True, eq=False)
class MonteCarlo:
    """Errors before the adjustment, after it with covariances, and after it with equal weights.

    a_idx, b_idx: (E,) cameras of the pairs. unsettled: trials that did not converge with covariances or equal weights.
    """

    a_idx: IntArray
    b_idx: IntArray
    before: Errors
    weighted: Errors
    equal: Errors
    unsettled: int

    @property
    def chain(self) -> IntArray:
        """Positions of the pairs 1-2, 2-3, ..., as in the table."""
        return np.flatnonzero(self.b_idx == self.a_idx + 1)


@dataclass(frozen=True, eq=False)
class Batch:
    """Adjusted pairs (T, E, 3, 3), v'Pv (T,), iterations (T,), settled (T,)."""

    b_from_a: FloatArray
    omega: FloatArray
    iterations: IntArray

    @property
    def settled(self) -> BoolArray:
        """Whether each trial converged."""
        return np.asarray(self.iterations <= _MOST)


def adjust_batch(b_from_a: FloatArray, information: FloatArray, n_cameras: int) -> Batch:
    """Adjust T complete networks: measured (T, E, 3, 3) in the order (0, 1), (0, 2), ..., (1, 2), ...

    information: inverse covariances (T, E, 3, 3), in the tangents on the right. The estimator is that of
    :mod:`tests.adjust.relay_parametric`, of all networks at once.
    """
    return Batch(*adjust_trials(b_from_a, information, n_cameras, _LIMIT, _MOST))


def simulate_complete(options: MonteCarloOptions = MonteCarloOptions()) -> MonteCarlo:
    """Simulate and adjust. Raises SurveyError for fewer than three cameras or less than one trial."""
    n = options.n_cameras
    if n < 3 or options.n_trials < 1:
        raise SurveyError(f"{n} cameras in {options.n_trials} trials adjust nothing; take three cameras and one trial")
    rng = np.random.default_rng(options.seed)
    a, b = (index.astype(np.int64) for index in np.triu_indices(n, 1))
    sums = [_Sums(len(a)) for _ in range(3)]
    unsettled = 0
    for first in range(0, options.n_trials, options.chunk):
        trials = min(options.chunk, options.n_trials - first)
        true = _true_rotations(rng, trials, n, a, b)
        measured, information = _measure(rng, true, options)
        weighted = adjust_batch(measured, information, n)
        equal = adjust_batch(measured, np.broadcast_to(np.eye(3) / options.sigma**2, true.shape), n)
        settled = weighted.settled & equal.settled
        unsettled += int(np.sum(~settled))
        kept = slice(None) if settled.all() else settled
        sums[0].add(true[kept], measured[kept], np.zeros(int(settled.sum())))
        sums[1].add(true[kept], weighted.b_from_a[kept], weighted.omega[kept])
        sums[2].add(true[kept], equal.b_from_a[kept], equal.omega[kept])
    return MonteCarlo(a, b, sums[0].errors(), sums[1].errors(), sums[2].errors(), unsettled)


class _Sums:
    """Running sums of the errors."""

    def __init__(self, n_pairs: int) -> None:
        self.n, self.squares, self.omega = 0, 0.0, 0.0
        self.absolute, self.absolute_squares = np.zeros((n_pairs, 3)), np.zeros((n_pairs, 3))

    def add(self, true: FloatArray, found: FloatArray, omega: FloatArray) -> None:
        difference = np.swapaxes(true, -1, -2) @ found
        angles = np.abs(euler_from_matrix(difference))
        self.n += len(true)
        self.absolute += angles.sum(axis=0)
        self.absolute_squares += (angles**2).sum(axis=0)
        antisymmetric = difference - np.swapaxes(difference, -1, -2)
        sine = np.sqrt((antisymmetric**2).sum(axis=(-1, -2)) / 8.0)
        turn = np.arctan2(sine, 0.5 * (np.trace(difference, axis1=-2, axis2=-1) - 1.0))
        self.squares += float((turn**2).sum())
        self.omega += float(omega.sum())

    def errors(self) -> Errors:
        mean = self.absolute / self.n
        variance = np.maximum(self.absolute_squares / self.n - mean**2, 0.0)
        return Errors(mean, np.sqrt(variance), float(np.sqrt(self.squares / (self.n * mean.size))), self.omega / self.n)


def _true_rotations(rng: np.random.Generator, trials: int, n: int, a: IntArray, b: IntArray) -> FloatArray:
    """``b_from_a`` (T, E, 3, 3) of all pairs."""
    half = np.array([np.pi, np.pi / 2, np.pi])
    chain = matrix_from_euler(rng.uniform(-half, half, (trials, n - 1, 3)))
    from_first = np.broadcast_to(np.eye(3), (trials, n, 3, 3)).copy()
    for k in range(1, n):
        from_first[:, k] = chain[:, k - 1] @ from_first[:, k - 1]
    return np.asarray(from_first[:, b] @ np.swapaxes(from_first[:, a], -1, -2))


def _measure(rng: np.random.Generator, true: FloatArray, options: MonteCarloOptions) -> tuple[FloatArray, FloatArray]:
    """Measured rotations and their information, as it follows from the measured angles."""
    noise = rng.normal(0.0, options.sigma, true.shape[:-1])
    if options.noise == "tangent":
        return true @ rotation_exp(noise), np.broadcast_to(np.eye(3) / options.sigma**2, true.shape)
    angles = euler_from_matrix(true) + noise
    inverse = np.linalg.inv(euler_jacobian(angles))
    return matrix_from_euler(angles), np.swapaxes(inverse, -1, -2) @ inverse / options.sigma**2
