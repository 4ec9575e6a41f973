"""Covariances as people write them, sigmas and correlations, and whether a matrix can be one."""

import numpy as np

from adjust.model import FloatArray


def covariance_from_sigmas(sigmas: FloatArray, rho: FloatArray | None = None) -> FloatArray:
    """Covariances (n, k, k) from ``sigmas`` (n, k) and correlations ``rho`` (n, k(k-1)/2), upper triangle by rows."""
    n, k = sigmas.shape
    out = np.zeros((n, k, k))
    pairs = {pair: place for place, pair in enumerate(zip(*np.triu_indices(k, 1), strict=True))}
    for i, j in np.ndindex(k, k):
        if i == j:
            out[:, i, i] = sigmas[:, i] * sigmas[:, i]
        elif rho is not None:
            out[:, i, j] = rho[:, pairs[min(i, j), max(i, j)]] * sigmas[:, i] * sigmas[:, j]
    return out


def sigmas_and_correlations(cov: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The inverse: ``sigmas`` (n, k) and the upper triangle (n, k(k-1)/2) of the correlations of ``cov`` (n, k, k)."""
    sigmas = np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
    rows, columns = np.triu_indices(cov.shape[1], 1)
    return sigmas, np.asarray(cov[:, rows, columns] / (sigmas[:, rows] * sigmas[:, columns]))


def covariance_problem(cov: FloatArray) -> tuple[int, str] | None:
    """Position and reason of the first of ``cov`` (n, k, k) that is no covariance, or None.

    A covariance is symmetric (to 1e-9 of its sigmas), with positive diagonal, and positive definite.
    """
    if not len(cov):
        return None
    diagonal = np.diagonal(cov, axis1=1, axis2=2)
    bad = ~np.isfinite(cov).all(axis=(1, 2)) | (diagonal <= 0).any(axis=1)
    if bad.any():
        return int(bad.argmax()), "the covariance has a variance that is not positive"
    sigmas = np.sqrt(diagonal)
    correlation = cov / (sigmas[:, :, None] * sigmas[:, None, :])
    bad = np.abs(correlation - correlation.transpose(0, 2, 1)).max(axis=(1, 2)) > 1e-9
    if bad.any():
        return int(bad.argmax()), "the covariance is not symmetric"
    bad = np.linalg.eigvalsh(correlation)[:, 0] <= 1e-12
    if bad.any():
        return int(bad.argmax()), "the covariance is not positive definite"
    return None
