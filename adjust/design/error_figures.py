"""Figures 4 to 6 of the three-camera head's paper: Monte Carlo beside analytic propagation, each with its own error.

The RMS of N simulated errors is itself uncertain: ``se = std(e^2) / (2 rms sqrt(N))``, about 0.8 % of it for 10,000
normal errors and more where near beacons count for much. The control variate (Rubinstein 1981, section 4.3)

    mean(e^2) - mean(l^2) + E l^2,    l the first-order error of the very same draw, E l^2 known in closed form,

has the same expectation and leaves only what the first order does not explain, so that the same 10,000 trials tell the
RMS far better. Without a nearest depth E l^2 is infinite, and no number of trials settles: then the comparison is with
the first order over the very same draws, and ``effective`` says how many of the trials carry the sum.
"""

from collections.abc import Sequence

import numpy as np

from adjust.design.error_analysis import (
    ERROR_KINDS,
    BeaconField,
    ErrorKind,
    expected_slope,
    pixel_errors,
    second_order,
    u_jacobian,
)
from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray

# what the paper's figures span, m and rad
SIZES: dict[ErrorKind, FloatArray] = {
    "beacon position": np.linspace(0.2e-3, 2e-3, 10),
    "camera position": np.linspace(0.2e-3, 2e-3, 10),
    "camera attitude": np.radians(np.linspace(0.05, 0.5, 10)),
}


@frozen(eq=False)
class ErrorFigure:
    """RMS error of u over the size of one kind of error; arrays (k,).

    sigmas: m or rad of each of three components. rms, rms_se: of the plain simulation, px. controlled, controlled_se:
    with the control variate (nan without a nearest depth). same_draws: first order over the same beacons and errors.
    analytic: first and second order over all beacons there may be; slope: its first order, px per m or rad.
    slope_monte_carlo, slope_se: of a line through the origin by all points. effective: how many of the trials carry
    the first-order sum.
    """

    kind: ErrorKind
    field: BeaconField
    n_trials: int
    sigmas: FloatArray
    rms: FloatArray
    rms_se: FloatArray
    controlled: FloatArray
    controlled_se: FloatArray
    same_draws: FloatArray
    analytic: FloatArray
    slope: float
    slope_monte_carlo: float
    slope_se: float
    effective: FloatArray

    @property
    def deviation(self) -> FloatArray:
        """(k,) relative: controlled Monte Carlo from the analytic RMS; without one, the plain from its own draws."""
        if np.isfinite(self.slope):
            return np.asarray(self.controlled / self.analytic - 1.0)
        return np.asarray(self.rms / self.same_draws - 1.0)


def error_figure(kind: ErrorKind, field: BeaconField, n_trials: int = 10_000, seed: int = 0) -> ErrorFigure:
    """Simulate one figure: ``n_trials`` new beacons and normal errors for every point."""
    sizes = SIZES[kind]
    rng = np.random.default_rng([seed, ERROR_KINDS.index(kind)])
    k, finite = len(sizes), bool(np.isfinite(expected_slope(kind, field)))
    exact, linear, carried = np.empty((k, n_trials)), np.empty((k, n_trials)), np.empty((k, n_trials))
    for i, sigma in enumerate(sizes):
        x, errors = field.sample(n_trials, rng), sigma * rng.standard_normal((n_trials, 3))
        J = u_jacobian(kind, x, field.alpha_px)
        exact[i] = pixel_errors(kind, x, errors, field.alpha_px)[:, 0] ** 2
        linear[i], carried[i] = np.sum(J * errors, axis=1) ** 2, np.sum(J * J, axis=1)
    rms, rms_se = _root(exact.mean(axis=1), exact.std(axis=1), n_trials)
    slope = expected_slope(kind, field)
    nothing = np.full(k, np.nan)
    controlled, controlled_se = nothing, nothing
    if finite:
        left = exact - linear
        controlled, controlled_se = _root(left.mean(axis=1) + (slope * sizes) ** 2, left.std(axis=1), n_trials)
    per_sigma = exact / sizes[:, None] ** 2
    pooled, pooled_se = _root(np.asarray(per_sigma.mean()), np.asarray(per_sigma.std()), per_sigma.size)
    return ErrorFigure(
        kind, field, n_trials, sizes, rms, rms_se, controlled, controlled_se, np.sqrt(linear.mean(axis=1)),
        second_order(kind, field, sizes), slope, float(pooled), float(pooled_se),
        carried.sum(axis=1) ** 2 / np.sum(carried**2, axis=1),
    )  # fmt: skip


def error_figures(
    fields: Sequence[BeaconField], n_trials: int = 10_000, seed: int = 0
) -> tuple[tuple[ErrorFigure, ...], ...]:
    """All three figures for each of the fields."""
    return tuple(tuple(error_figure(k, f, n_trials, seed) for k in ERROR_KINDS) for f in fields)


def _root(mean_square: FloatArray, spread: FloatArray, n: int) -> tuple[FloatArray, FloatArray]:
    """RMS and its standard error from the mean and the standard deviation of squares of n draws."""
    rms = np.sqrt(mean_square)
    return rms, np.asarray(spread / (2.0 * rms * np.sqrt(n)))
