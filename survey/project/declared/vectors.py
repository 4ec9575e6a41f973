"""Named scalars of ``survey.toml`` with their units: ``{ free = [...], slope_1 = 0.1, sigma = { slope_1 = 0.01 } }``.

Used for instruments, the vertical, beams and surfaces.
"""

from collections.abc import Mapping

import numpy as np

from adjust.model.errors import SurveyError
from adjust.model.survey import FloatArray, VectorParameter, VectorPrior
from survey.folder.units import from_si
from survey.project.declared.node import Node

Units = Mapping[str, str]
"""The unit of every parameter; "1" where its key has none."""


def vector_keys(units: Units) -> tuple[str, ...]:
    """All keys that ``read_vector`` reads."""
    return ("free", "sigma", *(key_of(name, units) for name in units))


def key_of(name: str, units: Units) -> str:
    """The key of a parameter: its name with the unit."""
    return name if units[name] == "1" else f"{name}_{units[name]}"


def read_vector(
    node: Node, units: Units, free: tuple[str, ...], missing: float | FloatArray = 0.0,
    chosen: tuple[str, ...] | None = None, priors: Node | None = None,
) -> VectorParameter:  # fmt: skip
    """The parameters of a table; ``free`` where it does not say, ``missing`` for what has no value.

    chosen: those that are free, where the caller has read that. priors: the table of sigmas, where it is not ``sigma``.
    """
    names, keys = tuple(units), {key_of(name, units): name for name in units}
    chosen = node.references("free", names, "parameter", free) if chosen is None else chosen
    values = np.full(len(names), missing)
    for i, key in enumerate(keys):
        if node.has(key):
            values[i] = node.si(key)
    table, given = node.table("sigma") if priors is None else priors, dict(zip(names, values.tolist(), strict=True))
    table.allow(*keys)
    for key in table.values:
        if keys[key] not in chosen:
            raise table.error(f"{keys[key]} has a sigma but is not free; add it to free", key)
        if np.isnan(given[keys[key]]):
            raise table.error(f"{keys[key]} has a sigma but no value; add {key}", key)
    known = {name: table.si(key, positive=True) for key, name in keys.items() if key in table.values}
    if not known:
        return VectorParameter(names, values, chosen)
    mean, sigmas = np.array([given[name] for name in known]), np.array(list(known.values()))
    return VectorParameter(names, values, chosen, VectorPrior(tuple(known), mean, np.diag(sigmas**2)))


def vector_to_toml(vector: VectorParameter, units: Units, where: str) -> dict[str, object]:
    """The keys that ``read_vector`` reads."""
    _check(vector, where)
    result: dict[str, object] = {"free": vector.free}
    for name, value in zip(vector.names, vector.values, strict=True):
        if not np.isnan(value):
            result[key_of(name, units)] = float(from_si(value, units[name]))
    if vector.prior is not None:
        sigmas = zip(vector.prior.names, np.sqrt(np.diagonal(vector.prior.cov)), strict=True)
        result["sigma"] = {key_of(name, units): float(from_si(s, units[name])) for name, s in sigmas}
    return result


def _check(vector: VectorParameter, where: str) -> None:
    """Raise for what the format has no words for."""
    prior = vector.prior
    if vector.ties:
        raise SurveyError(f"{where}: ties cannot be written to a project; hold the parameter instead")
    if prior is None:
        return
    if np.count_nonzero(prior.cov) > len(prior.names):
        raise SurveyError(f"{where}: a prior with correlations cannot be written to a project; give sigmas")
    start = [vector.values[vector.names.index(name)] for name in prior.names]
    if not np.array_equal(start, prior.mean):
        raise SurveyError(
            f"{where}: the prior's mean differs from the start value, which cannot be written to a project"
        )
