"""The whole way: survey -> start -> graph -> solution -> precision."""

from collections.abc import Callable, Sequence
from dataclasses import field, replace
from typing import TYPE_CHECKING

import numpy as np

from adjust.frames.lens_times import whole_images
from adjust.frames.runs import within_motion
from adjust.frames.tables import check_harmonics
from adjust.frames.unknowns import POSE_COMPONENTS, POSE_UNITS
from adjust.graph.assembly import AdjustmentGraph, StartValues
from adjust.graph.building import GraphBuilder
from adjust.graph.elimination import EXACT
from adjust.graph.solver import Solved, SolveOptions, settled, solve
from adjust.lenses.models import MODELS, camera_constants, monotone_radius_px, principal_point_px
from adjust.model.errors import NotConvergedError, listed
from adjust.model.frozen import frozen
from adjust.model.observations import ImageBlock, ImageBlocks
from adjust.model.result import Adjustment, Estimate, ParameterName
from adjust.model.survey import BoolArray, Survey
from adjust.native.parallel import Beside
from adjust.native.point_tests import farthest_points
from adjust.observations.terrestrial.statistics import joined_residuals, reading_residuals
from adjust.precision.precision import Precision, global_test, group_summaries, other_residuals, precision_of
from adjust.start import Start, find_start
from adjust.start.choice import Begun, adjusted_from_own_start
from adjust.start.given import GivenStarts, given_starts, moved_onto
from adjust.start.robust import limit, screen

if TYPE_CHECKING:
    from adjust.pose_network import PoseNetwork


@frozen
class AdjustOptions:
    """What is decided on the way.

    alpha: level of the global test. reject_blocks: images that contradict all others take no part, and are listed.
    reject_points: the same for gross errors among the image points.
    """

    alpha: float = 0.05
    reject_blocks: bool = True
    reject_points: bool = False
    solve: SolveOptions = field(default_factory=SolveOptions)


def adjust(
    survey: Survey,
    start: StartValues | None = None,
    options: AdjustOptions = AdjustOptions(),
    progress: Callable[[int, float], None] | None = None,
) -> Adjustment:
    """Adjust a survey: start values (found where not given), least squares, precision.

    Stations that measured pairs tie together are started and stepped as a network, whatever else is observed between
    them. progress: called with (iteration, v'Pv). Raises SurveyError, IndeterminateError, NotConvergedError.
    """
    check_harmonics(survey)
    survey = within_motion(survey)
    network = _network(survey)
    if network is not None:
        return _adjusted_network(network, survey, start, options, progress)
    if start is not None:
        return _adjusted(Begun(survey, start), survey, options, progress)
    return adjusted_from_own_start(
        survey,
        lambda trial, starts: _trusted(trial, starts, options),
        lambda begun: _adjusted(begun, survey, options, progress),
    )


def _network(survey: Survey) -> "PoseNetwork | None":
    if not survey.pairs:
        return None
    from adjust.pose_network.from_survey import network_of_pairs  # here: a survey without pairs starts without it

    return network_of_pairs(survey)


def _adjusted_network(
    network: "PoseNetwork", given: Survey, start: StartValues | None, options: AdjustOptions,
    progress: Callable[[int, float], None] | None,
) -> Adjustment:  # fmt: skip
    """From the start where it has all stations, else from averaged rotations; from pairs that agree where that fails.

    What nothing measures is held meanwhile: the positions of a network of rotations.
    """
    from adjust.pose_network.agreement import agreeing_start  # here: as above
    from adjust.pose_network.solve import NetworkOptions, minimize

    names: list[ParameterName] = [("world_from_station", s) for s in network.station_ids]
    poses = [start.poses[n] for n in names if n in start.poses] if start is not None else []
    begin, how = None, NetworkOptions(settled=options.solve.settled)
    if len(poses) == len(names):
        begin = np.array([p.rotation().matrix() for p in poses]), np.array([p.translation() for p in poses])
    try:
        found = minimize(network, begin, how, progress)
    except NotConvergedError:
        found = minimize(network, agreeing_start(network), how, progress)
    return replace(assemble(found.graph, found.solved, options, given=given), survey=given)


def _adjusted(
    begun: Begun, given: Survey, options: AdjustOptions, progress: Callable[[int, float], None] | None
) -> Adjustment:
    survey, notes = begun.survey, begun.notes
    graph = GraphBuilder(survey, begun.start.lenses).build(begun.start)
    graph, solved = settled(graph, options.solve, progress)
    if options.reject_points:
        screened = screen(graph, solved, options.solve)
        survey = with_used(survey, screened.used)
        notes = rejections(survey, given) + notes
        return replace(assemble(graph, screened.solved, options, notes, screened.precision, given), survey=survey)
    return assemble(graph, solved, options, notes, given=given)


def with_used(survey: Survey, used: BoolArray) -> Survey:
    """The survey with these image points (N,) in use."""
    points, blocks = survey.image_points, list(survey.image_blocks)
    changed = np.flatnonzero(used != points.used)
    for b in np.unique(np.searchsorted(points.ptr, changed, side="right") - 1).tolist():
        blocks[b] = replace(blocks[b], used=used[points.ptr[b] : points.ptr[b + 1]])
    return replace(survey, image_blocks=ImageBlocks(blocks, replace(points, used=used))) if len(changed) else survey


def rejections(survey: Survey, given: Survey) -> tuple[str, ...]:
    """Image points that are not used, though they were in the survey as it was given, by block."""
    out, targets = [], {t.target_id: t.point_ids for t in survey.targets}
    before = _unused_before(given)
    points = tuple(p.point_id for p in survey.points)
    for block in survey.image_blocks:
        if block.used is None or block.n_used in (0, len(block.uv)):
            continue
        ids = targets[block.target_id] if block.target_id else points
        old = before.get(block.place, frozenset())
        names = [ids[int(i)] for i in block.point_idx[~block.used] if int(i) not in old]
        if names:
            out.append(f"{_said(block)}: left out as gross errors: {listed(names, 8)}")
    return tuple(out)


def _said(block: ImageBlock) -> str:
    return f"camera {block.camera_id} at epoch {block.epoch_id}, target {block.target_id or 'points'}"


def _unused_before(given: Survey) -> dict[tuple[str, str, str | None, str], frozenset[int]]:
    """Positions of the points of each block that its owner does not use."""
    return {b.place: frozenset(b.point_idx[~b.used].tolist()) for b in given.image_blocks if b.used is not None}


def _trusted(survey: Survey, given: GivenStarts, options: AdjustOptions) -> Begun:
    """Start values; what the search refused gets a second chance with the lenses that the rest determines."""
    found = _found(survey, given)
    if not found.excluded_blocks or not options.reject_blocks:
        return Begun(survey, found, (), _misfit_px(found))
    kept = _without(survey, found.excluded_blocks)
    graph = GraphBuilder(kept, found.lenses).build(found)
    values = solve(graph, options.solve).values
    lenses = {c.camera_id: graph.unknowns.vectors[("lens", c.camera_id)].full(values) for c in survey.cameras}
    cameras = tuple(replace(c, lens=replace(c.lens, values=lenses[c.camera_id])) for c in survey.cameras)
    again = _found(replace(survey, cameras=cameras), given)
    return Begun(_without(survey, again.excluded_blocks), again, again.reasons, _misfit_px(again))


def _found(survey: Survey, given: GivenStarts) -> Start:
    """Start values; of a free network where the given ones were, though they may have been left aside."""
    found = find_start(survey)
    moved = survey.datum.kind == "inner" and not given_starts(survey) and given
    return moved_onto(found, given, survey) if moved else found


def _misfit_px(found: Start) -> float:
    """Median misfit of the images that take part, px; zero where there are none."""
    rms = np.delete(found.block_rms_px, found.excluded_blocks)
    return float(np.median(rms[~np.isnan(rms)])) if not np.isnan(rms).all() else 0.0


def _without(survey: Survey, excluded: Sequence[int]) -> Survey:
    """Blocks that are not trusted: predicted and tested where the others determine their poses, else left out."""
    refused = set(excluded)
    builder = GraphBuilder(survey, {c.camera_id: np.zeros(len(MODELS[c.lens.model].names)) for c in survey.cameras})
    frames, unknowns = builder.frames, builder.unknowns
    chains = [{key for link in frames.of_image(b) for key in unknowns.link_keys(link.slot)}
              for b in survey.image_blocks]  # fmt: skip
    known = {key for i, keys in enumerate(chains) if i not in refused for key in keys}
    known |= {u.key for name, u in unknowns.by_name.items() if name[0] == "table_angles"}  # they are always read
    blocks = []
    for i, block in enumerate(survey.image_blocks):
        if i not in refused:
            blocks.append(block)
        elif chains[i] <= known:
            blocks.append(replace(block, used=np.zeros(len(block.uv), dtype=np.bool_)))
    return replace(survey, image_blocks=tuple(blocks))


def assemble(
    graph: AdjustmentGraph,
    solved: Solved,
    options: AdjustOptions,
    notes: tuple[str, ...] = (),
    precision: Precision | None = None,
    given: Survey | None = None,
) -> Adjustment:
    """Everything a report needs, from the solution; ``precision`` where it is known already.

    given: the survey of its owner; what that does not use needs no warning.
    """
    precision = precision or Precision(graph, solved)
    others = other_residuals(precision)
    readings = None
    if graph.terrestrial is not None:
        readings = reading_residuals(graph.terrestrial, precision.tree, solved.values)
    every = others if readings is None else joined_residuals(others, graph.survey, readings)
    with Beside() as made:
        summed = made.of(lambda: group_summaries(precision, others, readings))
        unknowns, groups = estimates(precision), summed()
    n_observations = sum(g.n_observations for g in groups)
    n_unknowns = graph.unknowns.n_unknowns
    defect = solved.datum.defect if solved.datum else 0
    redundancy = n_observations - n_unknowns + defect
    omega = sum(g.omega for g in groups)
    test = global_test(omega, redundancy, options.alpha)
    result = Adjustment(
        graph.survey, unknowns, precision.image_residuals, every, groups, n_observations, n_unknowns, defect,
        redundancy, omega, float(np.sqrt(omega / redundancy)) if redundancy > 0 else float("nan"), test,
        solved.iterations, solved.max_step, True, (), precision, readings,
    )  # fmt: skip
    return replace(result, warnings=warnings(graph, result, given) + notes)


def estimates(precision: Precision) -> dict[ParameterName, Estimate]:
    """Every parameter, free or held, with its covariance."""
    graph, values = precision.graph, precision.solved.values
    u, out, found = graph.unknowns, dict[ParameterName, Estimate](), precision.every_cov()
    for name, slot in u.slot_of.items():
        if name[0] == "table_motion":
            continue
        key = u.slot_key[slot]
        pose = u.slot_pose[slot] if key is None else values.atPose3(key)
        cov = np.zeros((6, 6)) if key is None else found[key]
        status = u.status(key, u.parameters[name].treatment, 6)
        out[name] = Estimate(name, pose, POSE_COMPONENTS, POSE_UNITS, cov, status)
    for name, vector in u.vectors.items():
        cov = np.zeros((len(vector.names),) * 2)
        if vector.borrowed:
            cov = precision.whole([name], [len(vector.names)])
        elif vector.key is not None:
            cov = vector.matrix @ found[vector.key] @ vector.matrix.T
        out[name] = Estimate(name, vector.full(values), vector.names, vector.units, cov, vector.status)
    for point in graph.survey.points:
        name = ("point", point.point_id)
        treatment = point.x_in_world.treatment
        free = u.by_name.get(name)
        x = u.held_points[point.point_id] if free is None else np.asarray(values.atPoint3(free.key))
        cov = np.zeros((3, 3)) if free is None else found[free.key]
        status = u.status(free.key if free else None, treatment, 3)
        out[name] = Estimate(name, x, ("x", "y", "z"), ("m",) * 3, cov, status)
    for name, unknown in u.by_name.items():
        if name[0] == "table_angles":
            x, free_all = np.asarray(values.atVector(unknown.key)), ("free",) * unknown.dim
            out[name] = Estimate(name, x, unknown.components, unknown.units, found[unknown.key], free_all)
    return out


def warnings(graph: AdjustmentGraph, result: Adjustment, given: Survey | None = None) -> tuple[str, ...]:
    """What its owner should know first."""
    out = []
    total = float(sum(g.redundancy for g in result.groups))
    if abs(total - result.redundancy) > 1e-4 * max(1.0, result.redundancy):
        out.append(
            f"the redundancy numbers add up to {total:.4f} instead of {result.redundancy}: the survey is so weak that "
            "its covariances lose digits"
        )
    lost = result.precision.solved.lost if isinstance(result.precision, Precision) else 0.0
    if lost > EXACT:
        out.append(
            f"the survey is so long or weak that its normal equations lose digits: {lost / 2:.1g} of its largest "
            "sigmas is rounding"
        )
    test = result.global_test
    if test is not None and not test.passed:
        out.append(test.warning(result.sigma0))
    if graph.pairs is not None and (far := precision_of(result).pairs.too_far).any():
        out.append(
            f"{far.sum()} of {len(far)} pairs are not tested: so many pairs from what holds the datum, rounding hides "
            "what the others say of them; hold or observe stations nearer to them, or divide the network"
        )
    out += _image_warnings(graph, result, given) + _lens_warnings(graph, result)
    return tuple(out)


def _image_warnings(graph: AdjustmentGraph, result: Adjustment, given: Survey | None) -> list[str]:
    out, images, blocks = [], result.image_residuals, graph.survey.image_blocks
    bound = limit(len(images.test)) * max(1.0, result.sigma0**2)
    before = {} if given is None else _unused_before(given)
    ptr, used = images.block_ptr, np.diff(np.append(0, np.cumsum(images.used))[images.block_ptr])
    with np.errstate(invalid="ignore"):
        failing = np.flatnonzero(images.used & (images.test > bound))
    bad = np.bincount(np.searchsorted(ptr, failing, side="right") - 1, minlength=len(blocks))
    for i in np.flatnonzero((used == 0) | (bad > 0)).tolist():
        block = blocks[i]
        if bad[i]:
            out.append(f"{_said(block)}: {bad[i]} of {used[i]} image points do not fit (probable gross errors)")
        elif len(before.get(block.place, ())) < len(block.uv):  # else as its owner wants it
            out.append(f"{_said(block)}: not used")
    return out


def _lens_warnings(graph: AdjustmentGraph, result: Adjustment) -> list[str]:
    out, survey = [], whole_images(graph.survey)
    lenses = {c.camera_id: np.asarray(result.estimates["lens", c.camera_id].value) for c in survey.cameras}
    centres = {c.camera_id: principal_point_px(MODELS[c.lens.model], lenses[c.camera_id], camera_constants(c))
               for c in survey.cameras}  # fmt: skip
    of_block = np.array([centres[b.camera_id] for b in survey.image_blocks]).reshape(-1, 2)
    farthest = farthest_points(survey.image_points.ptr, survey.image_points.uv, of_block).tolist()
    for camera in survey.cameras:
        radius = monotone_radius_px(MODELS[camera.lens.model], lenses[camera.camera_id], camera_constants(camera))
        seen = max((r for b, r in zip(survey.image_blocks, farthest, strict=True) if b.camera_id == camera.camera_id),
                   default=0.0)  # fmt: skip
        if seen > radius:
            out.append(
                f"camera {camera.camera_id}: its distortion folds back at {radius:.0f} px from the principal point, "
                f"inside the observed {seen:.0f} px; free fewer coefficients or cover the image better"
            )
    return out
