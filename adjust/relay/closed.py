"""Pairs with every loop closed: eyes without a place of their own get one, mounts their play, and the conditions hold.

An eye is a camera or marker block of which nothing is known but pairs: no image shows it, its pose on what carries it
is free, and it does not keep one pose through several epochs on a body that moves. Its loops close in the same graph as
cameras and readings once it is a frame of its own: a station named after it. A survey of nothing but pairs between
stations is solved in the condition form (Chao et al. 2011; :mod:`adjust.relay.conditions`), any other one by the poses
of all frames, whose loops close by themselves: the same numbers and covariances.

A mount's play is one more motion at end a of its pair. With the pair's covariance C and that of the play S both act as
one with C + S, in the condition form as in the parametric one; of the residual v the play's share is S (C + S)^-1 v.
"""

from collections import Counter
from collections.abc import Iterator, Sequence, Set
from copy import copy
from dataclasses import fields, is_dataclass, replace

import numpy as np
from gtsam import Pose3, Rot3

from adjust.model.errors import SurveyError
from adjust.model.observations import Closure, FrameRef, Pair
from adjust.model.result import Adjustment, ObservationResidual
from adjust.model.survey import FloatArray, PoseParameter, Station, Survey
from adjust.observations.pair_arrays import whitening
from adjust.pose_network.cycles import connected_parts
from adjust.precision.precision import Precision, adjusted_motion, global_test
from adjust.relay.network import network_from_pairs
from adjust.relay.result import AdjustedPairs

_OBSERVED = (
    "image_blocks", "distances", "coordinates", "readings", "coordinate_differences", "levels", "alignments",
    "laser_spots", "on_surfaces", "setups", "beams",
)  # fmt: skip
_AGREEMENT = 1e-4
"""Sigmas by which the two forms may differ; rounding reaches 1e-8."""


def closed(survey: Survey, closures: Sequence[Closure] = ()) -> Survey:
    """The survey with all loops of its pairs to be closed. Raises SurveyError for a closure that is no loop."""
    survey = _with_stations_for_eyes(survey)
    return replace(survey, pairs=_with_play(survey, closures), pair_form="closed", closures=tuple(closures))


# -- eyes --------------------------------------------------------------------------------------------------------------


def _with_stations_for_eyes(survey: Survey) -> Survey:
    names = _eye_names(survey)
    if not names:
        return survey
    eyes = {(ref.kind, ref.frame_id) for ref in names}
    carriers = {c.station_id for c in survey.cameras if ("camera", c.camera_id) in eyes}
    carriers |= {t.station_id for t in survey.targets if t.station_id and ("target", t.target_id) in eyes}
    cameras = tuple(c for c in survey.cameras if ("camera", c.camera_id) not in eyes)
    targets = tuple(t for t in survey.targets if ("target", t.target_id) not in eyes)
    seen = {(f.kind, f.frame_id) for f in _frames_of(survey)}
    needed = {c.station_id for c in cameras} | {t.station_id for t in targets}
    needed |= {ref.frame_id for p in survey.pairs for ref in (p.a, p.b) if ref.kind == "station"}
    kept = tuple(s for s in survey.stations if s.station_id not in carriers or s.station_id in needed
                 or ("station", s.station_id) in seen)  # fmt: skip
    pairs = tuple(replace(p, a=_renamed(p.a, names, survey), b=_renamed(p.b, names, survey)) for p in survey.pairs)
    loose = set(names.values()) | _loose_stations(replace(survey, cameras=cameras, targets=targets), seen)
    held = set() if survey.datum.kind == "inner" else _one_of_each_part(pairs, set(names.values()), loose)
    own = dict.fromkeys(names.values())
    stations = tuple(Station(i, world_from_station=PoseParameter(Pose3(), "held") if i in held else PoseParameter())
                     for i in own)  # fmt: skip
    return replace(survey, cameras=cameras, targets=targets, stations=(*kept, *stations), pairs=pairs)


def _eye_names(survey: Survey) -> dict[FrameRef, str]:
    """The station that each eye becomes: none, where that would lose what is said of its pose, or that it is rigid."""
    seen = {(f.kind, f.frame_id) for f in _frames_of(survey)}
    out: dict[FrameRef, str] = {}
    tied, epochs = set[tuple[str, str]](), dict[tuple[str, str], set[str | None]]()
    for ref in (r for p in survey.pairs for r in (p.a, p.b) if r.kind in ("camera", "target")):
        eye, pose = (ref.kind, ref.frame_id), _pose_of(ref, survey)
        if pose.treatment != "free" or pose.held or eye in seen:
            tied.add(eye)
        at = _of_epoch(ref, survey)
        out[at] = f"{ref.kind} {ref.frame_id}" + (f" {at.epoch_id}" if at.epoch_id else "")
        if not (ref.kind == "target" and survey.targets_by_id[ref.frame_id].motion == "epoch"):
            epochs.setdefault(eye, set()).add(at.epoch_id)
    tied |= {eye for eye, of in epochs.items() if len(of) > 1}  # one pose on a body that moves
    return {ref: name for ref, name in out.items() if (ref.kind, ref.frame_id) not in tied}


def _pose_of(ref: FrameRef, survey: Survey) -> PoseParameter:
    """Of a camera or target, on what carries it."""
    if ref.kind == "camera":
        return survey.cameras_by_id[ref.frame_id].station_from_camera
    target = survey.targets_by_id[ref.frame_id]
    return target.epochs.get(ref.epoch_id or "", target.carrier_from_target)


def _of_epoch(ref: FrameRef, survey: Survey) -> FrameRef:
    """The frame without its epoch, where it does not move between epochs."""
    still = {s.station_id for s in survey.stations if s.motion == "fixed"}
    if ref.kind == "camera":
        carrier = survey.cameras_by_id[ref.frame_id].station_id
        return replace(ref, epoch_id=None) if carrier in still else ref
    target = survey.targets_by_id[ref.frame_id]
    fixed = target.motion != "epoch" and (target.station_id is None or target.station_id in still)
    return replace(ref, epoch_id=None) if fixed else ref


def _renamed(ref: FrameRef, names: dict[FrameRef, str], survey: Survey) -> FrameRef:
    if ref.kind not in ("camera", "target") or not any((n.kind, n.frame_id) == (ref.kind, ref.frame_id) for n in names):
        return ref
    return FrameRef("station", names[_of_epoch(ref, survey)])


def _frames_of(survey: Survey) -> Iterator[FrameRef]:
    """Every frame that an observation other than a pair names."""
    for block in survey.image_blocks:
        yield FrameRef("camera", block.camera_id)
        if block.target_id is not None:
            yield FrameRef("target", block.target_id)
    for spot in survey.laser_spots:
        yield FrameRef("target", spot.target_id)
    for beam in survey.beams:
        yield FrameRef(beam.carrier_kind, beam.carrier_id)
    for kind in _OBSERVED[1:]:
        yield from _frames_in(getattr(survey, kind))


def _frames_in(value: object) -> Iterator[FrameRef]:
    if isinstance(value, FrameRef):
        yield value
    elif isinstance(value, tuple):
        for item in value:
            yield from _frames_in(item)
    elif is_dataclass(value):
        for f in fields(value):
            yield from _frames_in(getattr(value, f.name))


def _loose_stations(survey: Survey, seen: Set[tuple[str, str]]) -> set[str]:
    """Stations of which nothing is known but pairs, neither."""
    carriers = {c.station_id for c in survey.cameras} | {t.station_id for t in survey.targets}
    return {s.station_id for s in survey.stations if s.motion == "fixed" and s.world_from_station.treatment == "free"
            and not s.world_from_station.held and s.station_id not in carriers
            and ("station", s.station_id) not in seen}  # fmt: skip


def _one_of_each_part(pairs: Sequence[Pair], eyes: set[str], loose: set[str]) -> set[str]:
    """The first eye of every part of the pairs that nothing ties to the datum: its places are relative to it.

    loose: stations, eyes among them, of which pairs alone tell.
    """
    number = {ref: i for i, ref in enumerate(dict.fromkeys(r for p in pairs for r in (p.a, p.b)))}
    ends = np.array([(number[p.a], number[p.b]) for p in pairs], dtype=np.int64).reshape(-1, 2)
    part = dict(zip(number, connected_parts(len(number), *ends.T).tolist(), strict=True))
    own = (r for r in reversed(number) if r.kind == "station" and r.frame_id in eyes)
    first = {part[ref]: ref.frame_id for ref in own}
    anchored = {part[r] for r in number if not (r.kind == "station" and r.frame_id in loose)}
    return {frame_id for p, frame_id in first.items() if p not in anchored}


# -- mounts ------------------------------------------------------------------------------------------------------------


def _with_play(survey: Survey, closures: Sequence[Closure]) -> tuple[Pair, ...]:
    by_id = {p.pair_id: p for p in survey.pairs}
    mounts = Counter(c.pair_ids[-1] for c in closures if c.pair_ids)
    for closure in closures:
        _check(closure, by_id)
        last = closure.pair_ids[-1]
        if mounts[last] > 1:
            raise SurveyError(f"closure {closure.closure_id!r}: another closure ends with pair {last!r} too; one mount "
                              "sits at one pair")  # fmt: skip
        pair = by_id[last]
        by_id[last] = replace(pair, cov=pair.cov + closure.cov(len(pair.cov)))
    return tuple(by_id[p.pair_id] for p in survey.pairs)


def _check(closure: Closure, by_id: dict[str, Pair]) -> None:
    """Raises SurveyError unless the pairs, in their order, come back to where the first of them began."""
    what = f"closure {closure.closure_id!r}"
    for pair_id in closure.pair_ids:
        if pair_id not in by_id:
            raise SurveyError(f"{what}: there is no pair {pair_id!r} in pairs.csv; correct the id")
    if len(closure.pair_ids) < 2 or len(set(closure.pair_ids)) < len(closure.pair_ids):
        raise SurveyError(f"{what}: a loop has two pairs or more, none of them twice; found {list(closure.pair_ids)}")
    ends = [(by_id[i].a, by_id[i].b) for i in closure.pair_ids]
    for start in ends[0]:
        here: FrameRef | None = start
        for a, b in ends:
            here = b if here == a else a if here == b else None
        if here == start:
            return
    walk = "; ".join(f"{i} joins {a.frame_id} and {b.frame_id}" for i, (a, b) in zip(closure.pair_ids, ends,
                                                                                 strict=True))  # fmt: skip
    raise SurveyError(f"{what}: its pairs are no loop in this order ({walk}); list them as they are walked")


def play(closures: Sequence[Closure], pair: Pair, residual: FloatArray) -> FloatArray:
    """The mount's share (dim,) of a pair's residual, zero where the pair has no mount. pair: with the mount's play."""
    for closure in closures:
        if closure.pair_ids[-1] == pair.pair_id:
            return np.asarray(closure.cov(len(residual)) @ np.linalg.solve(pair.cov, residual))
    return np.zeros(len(residual))


# -- the condition form of a survey of pairs ---------------------------------------------------------------------------


def in_condition_form(result: Adjustment) -> Adjustment:
    """Measured pairs adjusted once more: one unknown per pair, all independent loops as conditions.

    ``result``: by the poses of its stations, screened. What it says of stations stays; what it says of pairs is then
    from the conditions, and a warning tells where the two forms differ. Where something else is observed too, where
    priors, several given stations, or cameras and targets whose poses on a body are given close loops as well, where
    rotations and poses are mixed, or where there is no loop, ``result`` is returned as it is.
    """
    survey = result.survey
    if len(result.image_residuals.used) or any(o.kind != "pair" for o in result.other_residuals):
        return result
    if not survey.pairs_join_fixed_stations:
        return result
    used = [p for p in survey.pairs if p.used]
    given = [s for s in survey.stations if s.world_from_station.treatment != "free" or s.world_from_station.held]
    kinds = {isinstance(p.b_from_a, Rot3) for p in used}
    if len(given) > 1 or len(kinds) != 1:
        return result
    from adjust.relay.conditions import adjust_loops  # here: what is not solved by conditions goes without

    found = adjust_loops(network_from_pairs(used))
    pairs, precision = found.pairs, result.precision
    if not len(found.basis) or not isinstance(precision, Precision):
        return result
    residuals, apart = _residuals(result, pairs)
    warnings = result.warnings
    if apart > _AGREEMENT:
        warnings += (f"the conditions and the poses of the stations give residuals that differ by {apart:.2g} sigmas",)
    omegas = np.square((whitening(pairs.network.cov) @ pairs.residual[..., None])[..., 0]).sum(axis=1)
    groups = []
    for g in result.groups:
        mine = np.array([p.group == g.group for p in used])
        groups.append(replace(g, redundancy=float(pairs.redundancy[mine].sum()), omega=float(omegas[mine].sum())))
    alpha = result.global_test.alpha if result.global_test is not None else 0.05
    precision = copy(precision)
    precision.by_conditions = dict(zip(pairs.network.topology.pair_ids, pairs.cov, strict=True))
    return replace(
        result, other_residuals=residuals, groups=tuple(groups), omega=pairs.omega, sigma0=pairs.sigma0,
        redundancy=pairs.redundancy_total, global_test=global_test(pairs.omega, pairs.redundancy_total, alpha),
        iterations=pairs.iterations, warnings=warnings,
        precision=precision,
    )  # fmt: skip


def _residuals(result: Adjustment, pairs: AdjustedPairs) -> tuple[tuple[ObservationResidual, ...], float]:
    """All residuals, those of the adjusted pairs from the conditions; and by how many sigmas these differ at most."""
    index = {pair_id: e for e, pair_id in enumerate(pairs.network.topology.pair_ids)}
    out, apart = [], 0.0
    for o in result.other_residuals:
        e = index.get(o.ids[0]) if o.kind == "pair" else None
        if e is None or not o.used:
            out.append(o)
            continue
        v = pairs.residual[e]
        apart = max(apart, float(np.max(np.abs(v - o.residual) / o.sigma)))
        out.append(
            replace(o, adjusted=adjusted_motion(o.observed, v), residual=v, redundancy=pairs.redundancy[e],
                    standardized=pairs.standardized[e], test=float(pairs.test[e]))
        )  # fmt: skip
    return tuple(out), apart
