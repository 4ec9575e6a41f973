"""Whether an elimination knows the weakest motions of all: by them a random force moves the unknowns.

Eigenvalues of a corridor's normal matrix differ by the fourth power of its length, as those of a clamped beam. What it
squares away no redundancy number tells; the work of the force against the square of the rows does.
"""


import gtsam
import numpy as np

from adjust.graph.assembly import AdjustmentGraph
from adjust.graph.cliques import Cliques
from adjust.graph.datum import normal_diagonal, stacking, visible_keys
from adjust.graph.elimination import force_on, lost
from adjust.graph.rank import is_seen, rows_along
from adjust.model.frozen import frozen


@frozen
class Trial:
    """lost: share of its variance that the weakest motion loses. seen: whether observations tell of it for sure."""

    lost: float
    seen: bool = True


def tried(graph: AdjustmentGraph, linear: gtsam.GaussianFactorGraph, cliques: Cliques) -> Trial:
    """Of an undamped system and what it was eliminated to; a bundle's part is that of its image points themselves."""
    stack = stacking(graph, visible_keys(graph, linear))
    diagonal = normal_diagonal(linear, stack)
    force, rows = force_on(diagonal), cliques.rows_of(np.array([cliques.number[k] for k in stack.at], dtype=np.int64))
    x = np.zeros((int(cliques.first[-1]), 1))
    x[rows, 0] = force
    cliques.multiply(x)
    found = x[rows]
    if not np.isfinite(found).all():
        return Trial(np.inf, False)
    square = float(np.sum(rows_along(linear, stack, found, graph) ** 2))
    length = float(np.sqrt(square / np.sum(diagonal * found[:, 0] ** 2)))
    return Trial(lost(force, found[:, 0], square), is_seen(graph, stack, length))
