"""Covariances as people write them, sigmas and correlations, also of coordinates some of which were not observed."""

import numpy as np

from adjust.model.survey import FloatArray
from survey.folder.units import to_si
from survey.project.tables.reading import Table, first_row


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


def read_triples(table: Table, columns: tuple[str, ...]) -> tuple[FloatArray, FloatArray]:
    """Values (n, 3) m, nan where not observed, and covariances (n, 3, 3) m^2, inf on the diagonal there.

    columns: three of values, of sigmas and of correlations.
    """
    values, sigmas, rho = columns[:3], columns[3:6], columns[6:]
    found = to_si(np.stack([table.numbers(name) for name in values], axis=1), "mm")
    sigma = to_si(np.stack([table.positive(name) for name in sigmas], axis=1), "mm")
    known = ~np.isnan(found)
    wrong = known != ~np.isnan(sigma)
    if wrong.any():
        row, i = (int(x[0]) for x in np.nonzero(wrong))
        given, blank = (values[i], sigmas[i]) if known[row, i] else (sigmas[i], values[i])
        raise table.error(row, f"{blank}: is blank but {given} is not; fill in both, or none if it was not observed")
    if not known.any(axis=1).all():
        idle = first_row(~known.any(axis=1))
        raise table.error(idle, f"{','.join(values)}: all are blank; fill in what was observed")
    correlations = table_correlations(table, rho)
    cov = covariance_from_sigmas(np.where(known, sigma, 1.0), correlations)
    pairs = np.triu_indices(3, 1)
    surplus = (correlations != 0.0) & ~(known[:, pairs[0]] & known[:, pairs[1]])
    if surplus.any():
        row, i = (int(x[0]) for x in np.nonzero(surplus))
        raise table.error(row, f"{rho[i]}: correlates a coordinate that is blank; remove it")
    problem = covariance_problem(cov)
    if problem:
        raise table.error(problem[0], f"{problem[1]}; correct {','.join(rho)}")
    rows, axes = np.nonzero(~known)
    cov[rows, axes, axes] = np.inf
    return found, cov


def table_correlations(table: Table, columns: tuple[str, ...]) -> FloatArray:
    """Correlations (n, k), zero where blank."""
    rho = np.stack([table.numbers(name) for name in columns], axis=1)
    rho[np.isnan(rho)] = 0.0
    wrong = np.abs(rho) >= 1
    if wrong.any():
        row, i = (int(x[0]) for x in np.nonzero(wrong))
        raise table.error(row, f"{columns[i]}: found {rho[row, i]:g}; a correlation lies between -1 and 1")
    return rho


def joint_problem(cov: FloatArray) -> str | None:
    """Why the observed part of a joint covariance (n, n) is none, or None."""
    known = np.isfinite(np.diag(cov))
    if not np.isfinite(cov[~np.eye(len(cov), dtype=bool)]).all() or np.any(cov[np.ix_(known, ~known)]):
        return "a covariance stands beside a coordinate that is blank"
    problem = covariance_problem(cov[np.ix_(known, known)][None])
    return problem[1] if problem else None
