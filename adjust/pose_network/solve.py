"""Least squares over a pose network: its stations and pairs as the one graph, solved as every survey is."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from gtsam import Pose3, Rot3

from adjust.graph.assembly import AdjustmentGraph, StartValues
from adjust.graph.building import GraphBuilder
from adjust.graph.datum import inner_datum
from adjust.graph.solver import Solved, SolveOptions, solve
from adjust.model.errors import IndeterminateError, NotConvergedError
from adjust.model.frozen import frozen
from adjust.model.result import ParameterName
from adjust.model.survey import FloatArray
from adjust.pose_network.network import PoseNetwork, check_determined, survey_of
from adjust.pose_network.start import find_network_start

Progress = Callable[[int, float], None]


@frozen
class NetworkOptions:
    """How a network is solved.

    max_step: convergence, what is left to go in sigmas. patience: steps that may fail to lower the weighted square sum
    before damping begins. settled, covariances: as of every survey.
    """

    max_step: float = 1e-6
    max_iterations: int = 100
    patience: int = 8
    settled: float = 0.0
    covariances: bool = True


DEFAULTS = NetworkOptions()


@frozen(eq=False)
class Minimum:
    """Where least squares ended: poses (N, 3, 3), (N, 3) of all stations, and the graph with its solution."""

    rotations: FloatArray
    translations: FloatArray
    graph: AdjustmentGraph
    solved: Solved


def minimize(
    network: PoseNetwork, start: tuple[FloatArray, FloatArray] | None = None,
    options: NetworkOptions = DEFAULTS, progress: Progress | None = None,
) -> Minimum:  # fmt: skip
    """Least squares over the pairs in use, from a start (N, 3, 3), (N, 3) or from nothing.

    A free network stays where its first datum station starts; its covariances have the inner datum. Raises
    IndeterminateError naming the stations that float, NotConvergedError.
    """
    check_determined(network)
    R, t = find_network_start(network) if start is None else (start[0].copy(), start[1].copy())
    held = network.held
    R[held], t[held] = network.station_rotations[held], np.nan_to_num(network.station_translations[held])
    survey = survey_of(network)
    builder = GraphBuilder(survey, {}, network.arrays)
    given = {s.station_id: s.world_from_station for s in survey.stations}
    names: list[ParameterName] = [("world_from_station", s) for s in network.station_ids]
    # in this order they are eliminated where nothing else tells, and listed
    slots = np.array([builder.unknowns.slot(name, given[name[1]]) for name in names], dtype=np.int64)
    builder.simple = np.arange(network.n_pairs), slots[network.a_idx], slots[network.b_idx]
    at = np.zeros_like(t) if network.rotation_only else t
    graph = builder.build(StartValues({}, {n: Pose3(Rot3(a), b) for n, a, b in zip(names, R, at, strict=True)}, {}))
    try:
        solved = solve(graph, solve_options(options), progress)
    except NotConvergedError as error:
        raise NotConvergedError(
            f"{str(error).splitlines()[0].split(';')[0].replace('adjustment', 'network')}; look for wrong pairs, or "
            "let the program look for them (reject_pairs)", error.stopped
        ) from error
    except IndeterminateError as error:  # what the pairs join was seen before
        raise IndeterminateError(
            "the pairs do not determine the stations; look for pairs with absurd covariances", error.parameters
        ) from error
    if network.anchor is not None:
        solved = _anchored(graph, solved, names[network.anchor], Pose3(Rot3(R[network.anchor]), at[network.anchor]))
    _take(R, t, network, graph, solved)
    return Minimum(R, t, graph, solved)


def solve_options(options: NetworkOptions) -> SolveOptions:
    """The same for the one solver; what the pairs join was seen before."""
    return SolveOptions(options.max_step, options.max_iterations, 1e-5, options.patience, True, options.settled,
                        options.covariances)  # fmt: skip


def _anchored(graph: AdjustmentGraph, solved: Solved, anchor: ParameterName, place: Pose3) -> Solved:
    """The free network moved as a whole so that its anchor is where it was; its pairs do not see that."""
    values = solved.values
    motion = place.compose(values.atPose3(graph.unknowns.by_name[anchor].key).inverse())
    moved = type(values)()
    for key in values.keys():  # noqa: SIM118  # no mapping, but GTSAM's values
        moved.insert(key, motion.compose(values.atPose3(key)))
    return replace(solved, values=moved, datum=inner_datum(graph, graph.prepare(moved, jacobians=True)))


def _take(R: FloatArray, t: FloatArray, network: PoseNetwork, graph: AdjustmentGraph, solved: Solved) -> None:
    """The solution into the arrays, by station; what is held or in no pair stays."""
    graph.state.load(solved.values)
    slots = graph.unknowns.slot_of
    index = {i: slots[name] for i, s in enumerate(network.station_ids)
             if (name := ("world_from_station", s)) in slots and not network.is_held[i]}  # fmt: skip
    rows = list(index)
    R[rows] = graph.state.slot_R[list(index.values())]
    if not network.rotation_only:
        t[rows] = graph.state.slot_t[list(index.values())]
