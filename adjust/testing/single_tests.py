"""Tests and reliability of many observations with k components each, at once.

Whitened residuals g and cofactors K: with ``R = I - A Q A'`` (whitened) K = R and g = e for an observation that is used
(Baarda 1968); K = inv(I + A Q A'), g = K e for one that is only predicted. Then T = g' K^+ g is chi-square with
rank(K) degrees of freedom, ``K^+ g`` the estimated gross error and K the normal matrix of a bias (Foerstner 1983;
Teunissen 2006). All in sigmas of the observation; the other two functions turn to its components.
"""


import numpy as np

from adjust.model.frozen import frozen
from adjust.model.survey import BoolArray, FloatArray, IntArray
from adjust.testing.distributions import chi2, fisher, student

CONTROLLED = 1e-6
"""Share of an error that must show in the residuals to be told from rounding."""


@frozen(eq=False)
class Whitened:
    """n observations of k components: g (n, k), K (n, k, k), eigenvalues (n, k) ascending, vectors (n, k, k), used."""

    g: FloatArray
    K: FloatArray
    values: FloatArray
    vectors: FloatArray
    used: BoolArray

    @property
    def controlled(self) -> BoolArray:
        """Directions (n, k) in which an error shows."""
        return np.asarray(self.values > CONTROLLED)

    @property
    def freedom(self) -> IntArray:
        """Controlled directions (n,)."""
        return np.asarray(self.controlled.sum(axis=1))

    @property
    def along(self) -> FloatArray:
        """Components (n, k) of g along the eigenvectors, 0 where uncontrolled."""
        return np.where(self.controlled, np.einsum("nij,ni->nj", self.vectors, self.g), 0.0)

    def over_values(self, x: FloatArray) -> FloatArray:
        """Rows (n, k) divided by the eigenvalues, 0 where uncontrolled."""
        return np.asarray(np.divide(x, self.values, out=np.zeros_like(x), where=self.controlled))

    @property
    def statistic(self) -> FloatArray:
        """T (n,)."""
        return np.asarray((self.along * self.over_values(self.along)).sum(axis=1))

    @property
    def error(self) -> FloatArray:
        """Estimated gross error (n, k), observed minus true."""
        return np.asarray(-np.einsum("nij,nj->ni", self.vectors, self.over_values(self.along)))

    def weakest(self) -> tuple[FloatArray, FloatArray]:
        """The smallest eigenvalue (n,) of a controlled direction, inf where there is none, and the direction (n, k)."""
        values = np.where(self.controlled, self.values, np.inf)
        at = values.argmin(axis=1)
        rows = np.arange(len(at))
        direction = self.vectors[rows, :, at]
        # a direction has no sign: the largest component is positive
        largest = np.abs(direction).argmax(axis=1)
        return values[rows, at], direction * np.sign(direction[rows, largest])[:, None]


def whitened(e: FloatArray, M: FloatArray, used: BoolArray) -> Whitened:
    """From whitened residuals e (n, k) and the whitened covariance M = A Q A' (n, k, k) of what is adjusted."""
    k, out = e.shape[1], np.flatnonzero(~used)
    if k == 2:
        values, vectors = eigen2(M)
    else:
        values, vectors = np.linalg.eigh(M)
        values, vectors = values[:, ::-1], vectors[:, :, ::-1]  # ascending in K, which falls with M
    with np.errstate(divide="ignore"):
        of_K = np.where(used[:, None], 1.0 - values, 1.0 / (1.0 + np.maximum(values, 0.0)))
    K, g = np.eye(k) - M, e.copy()
    K[out] = (vectors[out] * of_K[out, None, :]) @ np.swapaxes(vectors[out], 1, 2)
    g[out] = np.einsum("nij,nj->ni", K[out], e[out])
    return Whitened(g, K, of_K, vectors, used)


def eigen2(M: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Eigenvalues (n, 2), the larger first, and vectors (n, 2, 2) of symmetric 2 x 2 matrices, in closed form."""
    a, b, c = M[:, 0, 0], M[:, 0, 1], M[:, 1, 1]
    mean, half = 0.5 * (a + c), np.hypot(0.5 * (a - c), b)
    angle = 0.5 * np.arctan2(2.0 * b, a - c)
    cos, sin = np.cos(angle), np.sin(angle)
    vectors = np.stack([np.stack([cos, -sin], axis=1), np.stack([sin, cos], axis=1)], axis=1)
    return np.stack([mean + half, mean - half], axis=1), vectors


def component_tests(x: Whitened, W: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Baarda's w of every component: -(W'g)_i / sqrt((W'KW)_ii), W (n, k, k) the square root information; (n, k).

    And the variance of its numerator, the information of a bias in the component alone (n, k).
    """
    numerator = np.einsum("nij,ni->nj", W, x.g)
    information = np.einsum("nij,nij->nj", W, x.K @ W)
    own = np.einsum("nij,nij->nj", W, W)
    seen = information > CONTROLLED * own
    w = np.where(seen, -numerator / np.sqrt(np.where(seen, information, 1.0)), np.nan)
    return w, np.where(seen, information, 0.0)


def p_prior(statistic: FloatArray, freedom: IntArray) -> FloatArray:
    """Of chi-square; nan where nothing is controlled."""
    return np.asarray(np.where(freedom > 0, chi2.sf(statistic, np.maximum(freedom, 1)), np.nan))


def p_posterior(
    statistic: FloatArray, freedom: IntArray, used: BoolArray, omega: float, redundancy: int
) -> FloatArray:
    """With sigma0 from the same adjustment, without the observation in question (Pope 1976; Koch 1999, 4.3).

    F = (T / q) / ((omega - T) / (f - q)) for what is used, (T / q) / (omega / f) for what is not. For one component
    the first is the tau-test.
    """
    q = np.maximum(freedom, 1)
    rest = np.where(used, omega - statistic, omega)
    left = np.where(used, redundancy - q, redundancy).astype(float)
    possible = (freedom > 0) & (left > 0.0) & (rest > 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        F = np.where(possible, statistic / q / np.where(possible, rest / np.maximum(left, 1.0), 1.0), np.nan)
    return np.asarray(fisher.sf(F, q, np.maximum(left, 1.0)))


def p_tau(tau: FloatArray, used: BoolArray, redundancy: int) -> FloatArray:
    """Two-sided, of Pope's tau (n, k): ``sqrt(f - 1) tau / sqrt(f - tau^2)`` is Student's t with f - 1 freedoms.

    What is not used has Student's t with f freedoms itself.
    """
    f = redundancy
    if f < 2:
        return np.full_like(tau, np.nan)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.sqrt(f - 1.0) * np.abs(tau) / np.sqrt(np.maximum(f - tau**2, 0.0))
    mine = used[:, None]
    return np.asarray(np.where(mine, 2.0 * student.sf(t, f - 1), 2.0 * student.sf(np.abs(tau), f)))
