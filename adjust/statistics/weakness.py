"""What is badly determined, by name: correlations, unknowns that replace each other, the weakest deformation."""

from collections.abc import Sequence

import numpy as np

from adjust.model import FloatArray, IntArray
from adjust.result import Adjustment, ParameterName
from adjust.statistics.result import Correlation, PrincipalComponent, WeakDirection, WeakPart
from adjust.statistics.system import DENSE, LinearSystem, linear_system

_MOST = 200
_SHARE = 0.1


def covariance_columns(system: LinearSystem, columns: IntArray) -> FloatArray:
    """Columns (n, k) of the covariance matrix of all unknowns, a priori, in the survey's datum."""
    right = np.zeros((len(system.columns), len(columns)))
    right[columns, np.arange(len(columns))] = 1.0
    out = system.normal.solve(right)
    if system.motions.shape[1]:
        seen = system.datum @ system.motions
        out -= system.motions @ np.linalg.inv(seen.T @ seen) @ system.motions[columns].T
    return out


def chosen_columns(system: LinearSystem, names: Sequence[ParameterName] | None = None) -> IntArray:
    """Columns of these unknowns; without names of all, or in large surveys of those that are no single epoch's."""
    if names is not None:
        return system.columns.of(names)
    if len(system.columns) <= DENSE:
        return np.arange(len(system.columns))
    epochs = {b.epoch_id for b in system.precision.graph.survey.image_blocks}
    return system.columns.of([n for n in system.columns.at if not (len(n) == 3 and n[2] in epochs)])[:DENSE]


def correlations(
    adjustment: Adjustment, limit: float = 0.95, names: Sequence[ParameterName] | None = None,
    system: LinearSystem | None = None,
) -> tuple[Correlation, ...]:  # fmt: skip
    """Pairs of components whose correlation is at least ``limit`` in size, largest first, 200 at most."""
    system = system or linear_system(adjustment)
    index = chosen_columns(system, names)
    Q = covariance_columns(system, index)[index]
    d = np.sqrt(np.maximum(np.diag(Q), 1e-300))
    C = np.triu(Q / np.outer(d, d), 1)
    a, b = np.nonzero(np.abs(C) >= limit)
    order = np.argsort(-np.abs(C[a, b]), kind="stable")[:_MOST]
    c = system.columns
    found = ((index[i], index[j], float(C[i, j])) for i, j in zip(a[order].tolist(), b[order].tolist(), strict=True))
    return tuple(Correlation(c.names[i], c.components[i], c.names[j], c.components[j], x) for i, j, x in found)


def correlation_matrix(
    adjustment: Adjustment, names: Sequence[ParameterName], system: LinearSystem | None = None
) -> tuple[tuple[str, ...], FloatArray]:
    """Labels and correlation matrix (n, n) of the free components of these unknowns."""
    system = system or linear_system(adjustment)
    index = system.columns.of(names)
    Q = covariance_columns(system, index)[index]
    d = np.sqrt(np.maximum(np.diag(Q), 1e-300))
    labels = tuple(f"{' '.join(system.columns.names[i])} {system.columns.components[i]}" for i in index)
    return labels, np.asarray(Q / np.outer(d, d))


def weak_directions(
    adjustment: Adjustment, most: int = 5, least_inflation: float = 10.0, system: LinearSystem | None = None
) -> tuple[WeakDirection, ...]:
    """Directions in which unknowns err together, worst first.

    Every component is counted in the sigma it would have if it were the only unknown; the eigenvectors of the
    covariance so scaled with large eigenvalues are the directions in which the unknowns replace each other (Belsley,
    Kuh and Welsch 1980, chapter 3).
    """
    system = system or linear_system(adjustment)
    index = chosen_columns(system)
    used = system.used[system.row_of]
    alone = np.sqrt(np.maximum(np.asarray(system.A[used].multiply(system.A[used]).sum(axis=0)).ravel()[index], 1e-300))
    Q = covariance_columns(system, index)[index] * np.outer(alone, alone)
    values, vectors = np.linalg.eigh(0.5 * (Q + Q.T))
    out = []
    for value, vector in zip(values[::-1][:most], vectors.T[::-1][:most], strict=True):
        if value < least_inflation**2:
            break
        size = np.abs(vector) / np.abs(vector).max()
        amount = np.sqrt(value) * vector / alone * np.sign(vector[size.argmax()])
        order = [int(i) for i in np.argsort(-size, kind="stable") if size[i] > _SHARE]
        c = system.columns
        parts = tuple(WeakPart(c.names[index[i]], c.components[index[i]], c.units[index[i]], float(amount[i]))
                      for i in order)  # fmt: skip
        out.append(WeakDirection(float(np.sqrt(value)), parts))
    return tuple(out)


def principal_component(adjustment: Adjustment, system: LinearSystem | None = None) -> PrincipalComponent | None:
    """The weakest deformation of all points together: first eigenvector of their covariance (Niemeier 2008, 11.3).

    None without unknown points.
    """
    system = system or linear_system(adjustment)
    names = tuple(n for n in system.columns.at if n[0] == "point")[: DENSE // 3]
    if not names:
        return None
    index = system.columns.of(names)
    Q = covariance_columns(system, index)[index]
    values, vectors = np.linalg.eigh(0.5 * (Q + Q.T))
    largest = float(max(values[-1], 0.0))
    shifts, vector, at = np.zeros((len(names), 3)), vectors[:, -1] * np.sqrt(largest), 0
    for i, name in enumerate(names):
        free = system.columns.free[name]
        shifts[i, free] = vector[at : at + len(free)]
        at += len(free)
    return PrincipalComponent(float(np.sqrt(largest)), largest / float(np.trace(Q)), names, shifts)
