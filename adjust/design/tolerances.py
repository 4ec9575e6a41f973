"""From required precision back to tolerances: how large each group of observations may be.

With the weights fixed, the covariance of the unknowns is a sum over the groups g of observations,

    Q = sum_g C_g,   C_g = Q N_g Q,   N_g = A_g' P_g A_g,

and making the sigmas of a group f_g times larger multiplies its C_g by f_g^2 (Koch 1999, section 3.2.4, propagation
through the estimator). Where the adjustment is told the new sigmas it weighs anew and does better, never worse.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from adjust.design.selection import Component
from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.result import Adjustment
from adjust.model.survey import FloatArray
from adjust.statistics.system import linear_system
from adjust.statistics.weakness import covariance_columns


@frozen(eq=False)
class Budget:
    """Where the variance of wanted components comes from: ``variances`` (g, p) of every group, which add up."""

    groups: tuple[str, ...]
    wanted: tuple[Component, ...]
    variances: FloatArray

    @property
    def sigmas(self) -> FloatArray:
        """(p,) of all groups together."""
        return np.asarray(np.sqrt(self.variances.sum(axis=0)))


@frozen(eq=False)
class Tolerance:
    """How much larger (or smaller) the sigmas of a group may be: factors on the planned ones.

    alone: while the other groups stay as planned; nan where those alone are too much already. together: where every
    group may use up an equal share of the required variance. limiting: the component that decides ``alone``.
    """

    group: str
    alone: float
    together: float
    limiting: str


def budget(expected: Adjustment, wanted: Sequence[Component]) -> Budget:
    """The variance of the wanted components by group of observations, of what :func:`expect` says of a survey.

    Raises SurveyError in a free datum, and for a component that is held.
    """
    if expected.datum_defect:
        raise SurveyError("a budget by groups needs a given datum; hold something instead of inner constraints")
    system = linear_system(expected)
    at = {(n, c): i for i, (n, c) in enumerate(zip(system.columns.names, system.columns.components, strict=True))}
    held = [c for c in wanted if (c.name, c.component) not in at]
    if held:
        raise SurveyError(f"{held[0].text} is held and has no variance; require the precision of something else")
    used = system.used[system.row_of]
    Q = covariance_columns(system, np.array([at[c.name, c.component] for c in wanted], dtype=np.int64))
    variances = np.zeros((len(system.group_names), len(wanted)))
    np.add.at(variances, system.group[system.row_of[used]], np.asarray(system.A[used] @ Q) ** 2)
    there = np.unique(system.group[system.used])
    return Budget(tuple(system.group_names[g] for g in there), tuple(wanted), variances[there])


def tolerances(found: Budget, required: Mapping[int, float]) -> tuple[Tolerance, ...]:
    """Tolerances of every group; ``required``: sigma (rad, m, px) by index of a wanted component.

    Raises SurveyError where nothing is required.
    """
    if not required:
        raise SurveyError("no precision is required of anything; name it under [required] in plan.toml")
    index = np.array(list(required))
    limit = np.array(list(required.values())) ** 2
    own, total = found.variances[:, index], found.variances[:, index].sum(axis=0)
    out = []
    for g, group in enumerate(found.groups):
        with np.errstate(divide="ignore", invalid="ignore"):
            alone = np.where(own[g] > 0, (limit - (total - own[g])) / own[g], np.inf)
            equal = np.where(own[g] > 0, limit / (len(found.groups) * own[g]), np.inf)
        worst = int(np.argmin(alone))
        least = float(alone[worst])
        out.append(Tolerance(group, float(np.sqrt(least)) if least > 0 else float("nan"),
                             float(np.sqrt(equal.min())), found.wanted[int(index[worst])].text))  # fmt: skip
    return tuple(out)
