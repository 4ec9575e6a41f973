"""The precision of a survey before it is measured: its adjustment without the observations' values."""

from dataclasses import replace
from itertools import pairwise

import numpy as np

from adjust.adjustment import AdjustOptions, assemble
from adjust.design.exact import exact
from adjust.graph.assembly import StartValues
from adjust.graph.building import GraphBuilder
from adjust.graph.rank import readable
from adjust.graph.solver import settled
from adjust.model.frozen import frozen
from adjust.model.names import grouped
from adjust.model.result import CAUTIOUS_SIGMAS, Adjustment, ParameterName
from adjust.model.survey import FloatArray, Survey
from adjust.precision.precision import precision_of
from adjust.statistics.weakness import inflated

_PART, _MOST = 0.25, 6  # of the largest share: what is named of a direction, and how many


@frozen
class WeakDirection:
    """A combination of unknowns that the design determines badly.

    factor: how many times its sigma is larger than if the other directions were known; parts: (unknown, component,
    share), the largest first, shares in sigmas.
    """

    factor: float
    parts: tuple[tuple[str, str, float], ...]

    def text(self) -> str:
        """For people: what moves together."""
        moving = ", ".join(f"{owner} {component} {share:+.2f}" for owner, component, share in self.parts)
        return f"{self.factor:.0f} times weaker than its parts alone: {moving}"


def expect(survey: Survey, start: StartValues) -> Adjustment:
    """Covariances and redundancy numbers of a survey whose unknowns have the values ``start``.

    The values of the observations in it do not matter. sigma0 is not known (nan), omega 0, no test is made. Raises
    IndeterminateError naming what observations and datum leave open.
    """
    ideal = exact(survey, start)
    graph = GraphBuilder(ideal, start.lenses).build(start)
    result = assemble(*settled(graph), AdjustOptions())
    kept = tuple(w for w in result.warnings if not w.startswith(("global test", CAUTIOUS_SIGMAS)))
    return replace(result, sigma0=float("nan"), global_test=None, omega=0.0, warnings=kept)


def shared_names(adjustment: Adjustment) -> tuple[ParameterName, ...]:
    """The unknowns that do not belong to one epoch alone."""
    return tuple(n for n in precision_of(adjustment).unknowns.by_name if not of_one_epoch(n))


def of_one_epoch(name: ParameterName) -> bool:
    """Whether an unknown exists at one epoch alone: table angles, a pose by hand."""
    return len(name) > 2


def component_names(adjustment: Adjustment, names: tuple[ParameterName, ...]) -> list[tuple[str, str]]:
    """(unknown as people say it, component) of every row of ``precision.joint(names)``."""
    by_name = precision_of(adjustment).unknowns.by_name
    return [(readable(by_name[n]), c) for n in names for c in by_name[n].components]


def weak_directions(adjustment: Adjustment, n: int = 5, least: float = 10.0) -> tuple[WeakDirection, ...]:
    """The weakest combinations of the unknowns that are common to several epochs, the weakest first.

    Eigenvectors of their covariance, each unknown scaled by the sigma it would have if all others were known; an
    eigenvalue is then an inflation of variance (Belsley, Kuh and Welsch 1980, chapter 3, for the columns of a design).
    """
    names = shared_names(adjustment)
    if not names:
        return ()
    Q = adjustment.precision.joint(names)
    s = np.sqrt(np.diag(Q))
    held = s <= 0.0
    s[held] = 1.0
    C = Q / np.outer(s, s)
    # the sigma of each unknown alone: 1 / N_ii, N the pseudo-inverse where a datum leaves the covariance singular
    alone = 1.0 / np.sqrt(np.maximum(np.diag(np.linalg.pinv(C, rcond=1e-13, hermitian=True)), 1.0))
    values, vectors = np.linalg.eigh(C / np.outer(alone, alone))
    labels = component_names(adjustment, names)
    moves = vectors[:, ::-1][:, :n] * alone[:, None]  # back to sigmas of the unknowns
    return tuple(
        WeakDirection(factor, tuple((*labels[i], float(shares[i])) for i in order[:_MOST]))
        for factor, shares, order in inflated(values[::-1][:n], moves, least, _PART)
    )


def group_redundancy(adjustment: Adjustment) -> dict[str, tuple[int, float, FloatArray]]:
    """By group: number of observations, redundancy, and its smallest, median and largest redundancy number."""
    images, blocks = adjustment.image_residuals, adjustment.survey.image_blocks
    rows = [slice(a, b) for a, b in pairwise(images.block_ptr.tolist())]
    numbers = grouped([
        *((b.group, images.redundancy[r][images.used[r]].ravel()) for b, r in zip(blocks, rows, strict=True)),
        *((o.group, o.redundancy) for o in adjustment.other_residuals if o.used),
    ])  # fmt: skip
    out = {}
    for group, parts in numbers.items():
        r = np.concatenate(parts)
        out[group] = (len(r), float(r.sum()), np.quantile(r, [0.0, 0.5, 1.0]) if len(r) else np.zeros(3))
    return out
