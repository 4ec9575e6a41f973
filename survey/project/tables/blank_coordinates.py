"""Three coordinates with sigmas and correlations, some of them blank because they were not observed."""

import numpy as np

from adjust.model.survey import FloatArray
from survey.folder.units import to_si
from survey.project.tables.covariance import covariance_from_sigmas, covariance_problem
from survey.project.tables.reading import Table, first_row


def read_triples(
    table: Table, values: tuple[str, ...], sigmas: tuple[str, ...], rho: tuple[str, ...]
) -> tuple[FloatArray, FloatArray]:
    """Values (n, 3) m, nan where not observed, and covariances (n, 3, 3) m^2, inf on the diagonal there."""
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
    rho = np.nan_to_num(np.stack([table.numbers(name) for name in columns], axis=1))
    wrong = (np.abs(rho) >= 1).any(axis=1)
    if wrong.any():
        raise table.error(first_row(wrong), f"{','.join(columns)}: a correlation lies between -1 and 1")
    return rho


def joint_problem(cov: FloatArray) -> str | None:
    """Why the observed part of a joint covariance (n, n) is none, or None."""
    known = np.isfinite(np.diag(cov))
    if not np.isfinite(cov[~np.eye(len(cov), dtype=bool)]).all() or np.any(cov[np.ix_(known, ~known)]):
        return "a covariance stands beside a coordinate that is blank"
    problem = covariance_problem(cov[np.ix_(known, known)][None])
    return problem[1] if problem else None
