"""The measured pairs of a survey as a network: counts after theorem 1 of the relay paper, and its loops one by one.

Frames are the eyes: stations, cameras, targets. What is known without pairs closes loops too: of the datum (held
stations, stations with a full prior, the world) where there is more than one, each joined to the world; of a calibrated
rig the cameras and targets whose poses on their station are held or have a full prior, where pairs reach more than one
of its frames, each joined to the station.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from gtsam import Pose3

from adjust.model.names import natural_key
from adjust.model.observations import FrameRef, Pair
from adjust.model.result import Adjustment, ParameterName
from adjust.model.survey import FloatArray, PoseParameter, Survey
from adjust.observations.pair_arrays import PairArrays, pair_arrays
from adjust.pose_network.loops import loop_vectors
from adjust.pose_network.network import Topology
from adjust.relay.closed import play
from adjust.relay.counts import Counts, count
from adjust.relay.loops import LoopMisclosures, loop_misclosures
from adjust.relay.network import MeasuredPairs, topology
from adjust.spatial.rigid_motions import Motions
from survey.solution.quantities import ARCSEC_PER_RAD

ALPHA = 0.001
"""Error probability of the test of all loops together."""
_Ends = list[tuple[str, str, str]]
_GIVEN = "given:"  # no station's id holds a colon
_WORLD = "world"


@dataclass(frozen=True, eq=False)
class PairNetwork:
    """counts: of the pairs in use. shifts: the same of those with a translation, where not all have one.

    given: frames whose pose is known without pairs. uncontrolled: pairs in use that close no loop, not even through
    given frames. conditions: independent ones, those through given frames included. redundancy: their equations.
    """

    counts: Counts
    shifts: Counts | None
    given: tuple[str, ...]
    uncontrolled: tuple[str, ...]
    inseparable: tuple[tuple[str, ...], ...]
    parts: tuple[tuple[str, ...], ...]
    conditions: int
    redundancy: int


def frame_name(frame: FrameRef) -> str:
    """As in tables; a station goes without its kind."""
    return frame.text.removeprefix("station:")


def pair_network(survey: Survey) -> PairNetwork:
    """Count what the pairs in use can tell."""
    used = [p for p in survey.pairs if p.used]
    bare = _bare_stations(survey)
    poses = [p for p in used if isinstance(p.b_from_a, Pose3)]
    dim, ends = 6 if len(poses) == len(used) and used else 3, _ends(used)
    whole = topology(ends, bare)
    counts, links = count(whole, dim), _links(survey, used, ends, 6 if poses else 3)
    closed = count(_tied(ends, links, bare), dim) if links else counts
    real = set(whole.station_ids) - {_WORLD}
    conditions, redundancy, shifts = closed.independent_conditions, closed.redundancy, None
    if dim == 3 and poses:
        of_poses = _ends(poses)
        shifts = count(topology(of_poses, bare), 3)
        redundancy += count(_tied(of_poses, _links(survey, poses, of_poses, 6), bare), 3).redundancy
    return PairNetwork(
        counts, shifts, _given(survey, ends, 6 if poses else 3),
        _ordered(_real(closed.uncontrolled_pairs)), _groups(_real(g) for g in closed.inseparable_pairs),
        tuple(found for part in closed.parts if (found := _ordered(s for s in part if s in real))),
        conditions, redundancy,
    )  # fmt: skip


def _ordered(ids: Iterable[str]) -> tuple[str, ...]:
    """In natural order, whatever the order of the rows."""
    return tuple(sorted(ids, key=natural_key))


def _groups(groups: Iterable[tuple[str, ...]]) -> tuple[tuple[str, ...], ...]:
    found = [_ordered(g) for g in groups if len(g) > 1]
    return tuple(sorted(found, key=lambda g: natural_key(g[0])))


def _real(ids: Sequence[str]) -> tuple[str, ...]:
    return tuple(i for i in ids if not i.startswith(_GIVEN))


def _ends(pairs: Sequence[Pair]) -> _Ends:
    """Ids of the pairs, and names of their frames a and b."""
    seen = {id(r): r for p in pairs for r in (p.a, p.b)}  # most are the same object
    name = {k: frame_name(r) for k, r in seen.items()}
    return [(p.pair_id, name[id(p.a)], name[id(p.b)]) for p in pairs]


def _bare_stations(survey: Survey) -> tuple[str, ...]:
    """Fixed stations that only pairs can determine: they carry neither cameras nor targets."""
    carriers = {c.station_id for c in survey.cameras} | {t.station_id for t in survey.targets}
    return tuple(s.station_id for s in survey.stations if s.motion == "fixed" and s.station_id not in carriers)


def _is_given(parameter: PoseParameter, dim: int) -> bool:
    if parameter.treatment == "held":
        return True
    cov = parameter.prior_cov
    return parameter.treatment == "prior" and cov is not None and bool(np.isfinite(np.diag(cov)[:dim]).all())


def _given(survey: Survey, ends: _Ends, dim: int) -> tuple[str, ...]:
    names = {name for _, *both in ends for name in both}
    fixed = (s for s in survey.stations if s.motion == "fixed" and s.station_id in names)
    given = tuple(s.station_id for s in fixed if _is_given(s.world_from_station, dim))
    return ((_WORLD,) if _WORLD in names else ()) + given


def _tied(ends: _Ends, links: "Sequence[_Link]", bare: tuple[str, ...] = ()) -> Topology:
    """The pairs, and what is known without them where that closes loops."""
    return topology(ends + [(link.link_id, link.frame, link.carrier) for link in links], bare)


@dataclass(frozen=True, eq=False)
class _Link:
    """A frame whose pose in another one is known without pairs, and the name of the parameter that it is."""

    frame: str
    carrier: str
    parameter: ParameterName
    given: PoseParameter

    @property
    def link_id(self) -> str:
        return _GIVEN + self.frame


def _links(survey: Survey, pairs: Sequence[Pair], ends: _Ends, dim: int) -> list[_Link]:
    """What is known without pairs, where it closes loops."""
    given, stations = _given(survey, ends, dim), survey.stations_by_id
    fixed = [s for s in given if s != _WORLD] if len(given) > 1 else []
    out = [_Link(s, _WORLD, ("world_from_station", s), stations[s].world_from_station) for s in fixed]
    frames, rig = dict[str, FrameRef](), dict[str, list[_Link]]()
    for pair, (_, a, b) in zip(pairs, ends, strict=True):
        frames[a], frames[b] = pair.a, pair.b
    on = {("camera", c.camera_id): (c.station_id, c.station_from_camera) for c in survey.cameras}
    on |= {("target", t.target_id): (t.station_id, t.carrier_from_target)
           for t in survey.targets if t.station_id is not None and t.motion != "epoch"}  # fmt: skip
    for name, ref in frames.items():
        station_id, known = on.get((ref.kind, ref.frame_id), ("", None))
        if station_id and known is not None and _is_given(known, dim):
            epoch = None if stations[station_id].motion == "fixed" else ref.epoch_id
            carrier = frame_name(FrameRef("station", station_id, epoch))
            kind = "station_from_camera" if ref.kind == "camera" else "carrier_from_target"
            rig.setdefault(carrier, []).append(_Link(name, carrier, (kind, ref.frame_id), known))
    return out + [link for carrier, links in rig.items() if len(links) > 1 or carrier in frames for link in links]


def pair_loops(survey: Survey) -> LoopMisclosures | None:
    """How well every independent loop of all measured pairs closes, used or not; None where there is no pair.

    Of pairs with and without translation the rotations alone.
    """
    pairs = list(survey.pairs)
    if not pairs:
        return None
    measured, ends = pair_arrays(survey.pairs), _ends(pairs)
    dim = 6 if measured.is_pose.all() else 3
    links, covs = _links(survey, pairs, ends, dim), [measured.cov[:, :dim, :dim]]
    for given in (link.given for link in links):
        held = given.treatment == "held" or given.prior_cov is None
        covs.append((np.zeros((dim, dim)) if held else np.asarray(given.prior_cov)[:dim, :dim])[None])
    motions = _with_given(measured, [link.given.value or Pose3() for link in links], dim)
    return loop_misclosures(MeasuredPairs(_tied(ends, links), motions, np.concatenate(covs)))


def _with_given(measured: PairArrays, given: Sequence[Pose3], dim: int) -> Motions:
    """Measured pairs and then what is known without them; of poses the rotations alone where ``dim`` is 3."""
    R = np.concatenate([measured.rotations, *(p.rotation().matrix()[None] for p in given)])
    if dim == 3:
        return Motions(R)
    return Motions(R, np.concatenate([measured.translations, *(p.translation()[None] for p in given)]))


def loops_after(adjustment: Adjustment, loops: LoopMisclosures) -> FloatArray:
    """Misclosures (L, dim) of the same loops by the adjusted pairs, predicted where not used; a mount keeps its play.

    loops: of :func:`pair_loops`, the pairs of the survey first. From the residuals: each pair as measured, moved by its
    own. Nan where a pair has none.
    """
    basis, survey = loops.basis, adjustment.survey
    top, dim = basis.topology, loops.vector.shape[1]
    n, given = len(survey.pairs), list[Pose3]()
    if top.n_pairs > n:  # what is given: its adjusted pose, where it is known no better than that
        links = {link.link_id: link for link in _links(survey, survey.pairs, _ends(survey.pairs), dim)}
        for link in (links[i] for i in top.pair_ids[n:]):
            estimate = adjustment.estimates.get(link.parameter)
            now = None if estimate is None else estimate.value
            given.append(now if isinstance(now, Pose3) else link.given.value or Pose3())
    found = {o.ids[0]: o.residual for o in adjustment.other_residuals if o.kind == "pair"}
    mounts = {closure.pair_ids[-1] for closure in survey.closures}
    moved, lost = np.zeros((top.n_pairs, dim)), np.zeros(top.n_pairs, dtype=np.bool_)
    for e, pair in enumerate(survey.pairs):
        v = found.get(pair.pair_id)
        if v is None:
            lost[e] = True
        else:
            moved[e] = (v - play(survey.closures, pair, v) if pair.pair_id in mounts else v)[:dim]
    w = loop_vectors(basis, _with_given(pair_arrays(survey.pairs), given, dim).retract(moved))
    w[np.logical_or.reduceat(lost[basis.pair_idx], basis.ptr[:-1])] = np.nan
    return w


def network_dict(network: PairNetwork) -> dict[str, Any]:
    """The counts as plain values."""
    c = network.counts
    return {
        "n_stations": c.n_stations,
        "n_parts": len(network.parts),
        "parts": [list(part) for part in network.parts] if len(network.parts) > 1 else [],
        "independent_unknown_poses": c.independent_unknowns,
        "measured_pairs": c.n_pairs,
        "measurable_pairs": c.measurable_pairs,
        "triangle_conditions": c.triangle_conditions,
        "independent_conditions": network.conditions,
        "conditions_through_given_stations": network.conditions - c.independent_conditions,
        "equations_per_condition": c.loop_equations,
        "redundancy": network.redundancy,
        "conditions_per_pair": network.conditions / c.n_pairs if c.n_pairs else 0.0,
        "given_stations": list(network.given),
        "uncontrolled_pairs": list(network.uncontrolled),
        "inseparable_pairs": [list(group) for group in network.inseparable],
        "isolated_stations": list(c.isolated_stations),
    }


def loops_dict(
    loops: LoopMisclosures, left_out: Sequence[str] = (), after: FloatArray | None = None, form: str = "poses",
    solved_by: str = "poses",
) -> dict[str, Any]:
    """The loops, worst first, as plain values; left_out: pairs that are not used, named beside the loops they are in.

    sigma_misclosure: along the direction of the misclosure. after: misclosures (L, dim) by the adjusted pairs. form:
    "poses" or "closed", as asked for. solved_by: "poses" or "conditions", how the pairs were adjusted.
    """
    failed = np.zeros(len(loops.test), dtype=np.bool_)
    failed[loops.failed(ALPHA)] = True
    order, out = np.argsort(loops.p_value, kind="stable"), set(left_out)
    columns = misclosure_columns(loops.vector, loops.cov)
    columns |= {"test": loops.test, "p_value": loops.p_value}
    if after is not None:
        columns |= {key: size for key, _, size in _lengths("misclosure_after", after)}
    rows = zip(*(column[order].tolist() for column in columns.values()), strict=True)
    return {
        "n_loops": len(order),
        "n_failed": int(failed.sum()),
        "n_listed": len(order),
        "minimal": loops.basis.minimal,
        "note": loops.basis.note,
        "alpha": ALPHA,
        "form": form,
        "solved_by": solved_by,
        "worst_first": [
            _walk(loops, k, out) | {"freedom": loops.vector.shape[1], "closes": not failed[k]}
            | dict(zip(columns, row, strict=True))
            for k, row in zip(order.tolist(), rows, strict=True)
        ],
    }  # fmt: skip


def closures_dict(adjustment: Adjustment) -> dict[str, Any]:
    """Every loop through a mount: its misclosure as measured, and the play of the mount that the adjustment leaves.

    sigma: of the mount, as given. play_over_sigma: length of the play over its sigmas, of dim components.
    """
    survey, out = adjustment.survey, {}
    every, number = pair_arrays(survey.pairs), {p.pair_id: e for e, p in enumerate(survey.pairs)}
    of_pairs = adjustment.other_residuals if survey.closures else ()
    found = {o.ids[0]: np.asarray(o.residual) for o in of_pairs if o.kind == "pair"}
    for closure in survey.closures:
        rows = [number[i] for i in closure.pair_ids]
        pairs, dim = [survey.pairs[e] for e in rows], 6 if every.is_pose[rows].all() else 3
        motions = Motions(every.rotations[rows], every.translations[rows] if dim == 6 else None)
        loop = loop_misclosures(MeasuredPairs(topology(_ends(pairs)), motions, every.cov[rows, :dim, :dim]))
        entry: dict[str, Any] = {"pairs": list(closure.pair_ids), "used": pairs[-1].used}
        entry |= {"sigma_arcsec": ARCSEC_PER_RAD * closure.rotation_sigma, "sigma_mm": 1e3 * closure.translation_sigma}
        entry |= {key: float(of[0]) for key, of in misclosure_columns(loop.vector, loop.cov).items()}
        entry |= {"test": loop.test[0], "freedom": dim, "p_value": loop.p_value[0]}
        v = found.get(closure.pair_ids[-1])
        if v is not None:
            d = play(survey.closures, pairs[-1], v)
            entry["play_arcsec"] = float(ARCSEC_PER_RAD * np.linalg.norm(d[:3]))
            entry |= {"play_mm": float(1e3 * np.linalg.norm(d[3:]))} if len(d) == 6 else {}
            sigma = np.sqrt(np.diag(closure.cov(len(d))))
            entry["play_over_sigma"] = float(np.linalg.norm(d[sigma > 0.0] / sigma[sigma > 0.0]))
        out[closure.closure_id] = entry
    return out


def _walk(loops: LoopMisclosures, k: int, left_out: set[str]) -> dict[str, Any]:
    pairs = _real(loops.basis.pairs(k))
    return {"stations": list(loops.basis.stations(k)), "pairs": list(pairs),
            "pairs_not_used": [p for p in pairs if p in left_out]}  # fmt: skip


def _lengths(name: str, w: FloatArray) -> Iterator[tuple[str, slice, FloatArray]]:
    """Of the parts of misclosures (L, 3 or 6): key with its unit, components, lengths (L,) in that unit."""
    parts = (("arcsec", slice(3), ARCSEC_PER_RAD), ("mm", slice(3, 6), 1e3))
    for unit, of, factor in parts[: w.shape[1] // 3]:
        yield f"{name}_{unit}", of, factor * np.linalg.norm(w[:, of], axis=1)


def misclosure_columns(w: FloatArray, cov: FloatArray) -> dict[str, FloatArray]:
    """Lengths (L,) of misclosures (L, 3 or 6), and their sigmas along them; of none at all, the mean sigma."""
    out: dict[str, FloatArray] = {}
    for key, of, size in _lengths("misclosure", w):
        part, C = w[:, of], cov[:, of, of]
        length = np.linalg.norm(part, axis=1)
        along = np.einsum("li,lij,lj->l", part, C, part) / np.where(length > 0.0, length, 1.0) ** 2
        variance = np.where(length > 0.0, along, np.trace(C, axis1=1, axis2=2) / 3.0)
        factor = ARCSEC_PER_RAD if key.endswith("_arcsec") else 1e3
        out |= {key: size, f"sigma_{key}": factor * np.sqrt(variance)}
    return out
