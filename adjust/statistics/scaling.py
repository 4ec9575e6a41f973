"""A survey with the variances of its groups multiplied by factors; priors keep theirs."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from adjust.model.rewriting import Fields
from adjust.model.survey import FloatArray, Survey

_WITH_COVARIANCE = (
    "image_blocks", "table_readings", "pairs", "coordinates", "coordinate_differences", "alignments", "laser_spots",
)  # fmt: skip
_WITH_SIGMA = ("distances", "levels", "on_surfaces")


def scaled_survey(survey: Survey, factors: Mapping[str, float]) -> Survey:
    """The survey with every covariance of group g multiplied by ``factors[g]`` (1 where there is none).

    Readings of several groups that share a covariance get the root of the product of their factors.
    """

    def root(group: str) -> float:
        return float(np.sqrt(factors.get(group, 1.0)))

    def with_cov(item: Any) -> Any:  # of every kind, by the name of its field
        factor = root(item.group) ** 2
        return item if factor == 1.0 else replace(item, cov=factor * item.cov)

    def with_sigma(item: Any) -> Any:  # as above
        factor = root(item.group)
        return item if factor == 1.0 else replace(item, sigma=factor * item.sigma)

    changed: Fields = {f: tuple(with_cov(x) for x in getattr(survey, f)) for f in _WITH_COVARIANCE}
    changed |= {f: tuple(with_sigma(x) for x in getattr(survey, f)) for f in _WITH_SIGMA}
    readings = tuple(
        r if root(r.group) == 1.0 else replace(r, sigma=root(r.group) * r.sigma,
                                               target_centring_sigma=root(r.group) * r.target_centring_sigma)
        for r in survey.readings
    )  # fmt: skip
    group_of = {r.reading_id: r.group for r in survey.readings}
    joint = tuple(
        replace(c, cov=_scaled(c.cov, np.array([root(group_of.get(i, "")) for i in c.reading_ids])))
        for c in survey.reading_covariances
    )
    return replace(survey, readings=readings, reading_covariances=joint, **changed)


def _scaled(cov: FloatArray, roots: FloatArray) -> FloatArray:
    return np.asarray(cov * np.outer(roots, roots))
