"""The measured pairs of a survey as a network: counts after theorem 1 of the relay paper.

Frames are the eyes: stations, cameras, targets. What is known without pairs closes loops too: of the datum (the world,
and stations, targets and tables that are held there or have a full prior) where there is more than one, each joined to
the world; of a calibrated rig the cameras and targets whose poses on their station are held or have a full prior, where
pairs reach more than one of its frames, each joined to the station.
"""

from collections.abc import Iterable, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from gtsam import Pose3

from adjust.model.frozen import frozen
from adjust.model.names import natural_key
from adjust.model.observations import FrameRef, Pair
from adjust.model.result import ParameterName
from adjust.model.survey import PoseParameter, Survey
from adjust.pose_network.network import Topology
from adjust.relay.counts import Counts, count
from adjust.relay.network import topology

Ends = list[tuple[str, str, str]]
"""Of pairs: their ids, and the names of their frames a and b."""
_GIVEN = "given:"  # no station's id holds a colon
_WORLD = "world"


@frozen(eq=False)
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
    used = tuple(p for p in survey.pairs if p.used)
    bare = _bare_stations(survey)
    poses = tuple(p for p in used if isinstance(p.b_from_a, Pose3))
    dim, ends = 6 if len(poses) == len(used) and used else 3, ends_of(used)
    whole = topology(ends, bare)
    counts, links = count(whole, dim), links_of(survey, used, ends, 6 if poses else 3)
    closed = count(tied(ends, links, bare), dim) if links else counts
    real = set(whole.station_ids) - {_WORLD}
    conditions, redundancy, shifts = closed.independent_conditions, closed.redundancy, None
    if dim == 3 and poses:
        of_poses = ends_of(poses)
        shifts = count(topology(of_poses, bare), 3)
        redundancy += count(tied(of_poses, links_of(survey, poses, of_poses, 6), bare), 3).redundancy
    return PairNetwork(
        counts, shifts, _given(survey, ends, 6 if poses else 3),
        _ordered(measured_only(closed.uncontrolled_pairs)), _groups(measured_only(g) for g in closed.inseparable_pairs),
        tuple(found for part in closed.parts if (found := _ordered(s for s in part if s in real))),
        conditions, redundancy,
    )  # fmt: skip


def _ordered(ids: Iterable[str]) -> tuple[str, ...]:
    """In natural order, whatever the order of the rows."""
    return tuple(sorted(ids, key=natural_key))


def _groups(groups: Iterable[tuple[str, ...]]) -> tuple[tuple[str, ...], ...]:
    found = [_ordered(g) for g in groups if len(g) > 1]
    return tuple(sorted(found, key=lambda g: natural_key(g[0])))


def measured_only(ids: Sequence[str]) -> tuple[str, ...]:
    """The pairs among these, without what is given."""
    return tuple(i for i in ids if not i.startswith(_GIVEN))


@lru_cache(2)  # all pairs, and those in use
def ends_of(pairs: tuple[Pair, ...]) -> Ends:
    """Ids of the pairs, and names of their frames a and b."""
    return [(p.pair_id, frame_name(p.a), frame_name(p.b)) for p in pairs]


def _bare_stations(survey: Survey) -> tuple[str, ...]:
    """Fixed stations that only pairs can determine: they carry neither cameras nor targets."""
    carriers = {c.station_id for c in survey.cameras} | {t.station_id for t in survey.targets}
    return tuple(s.station_id for s in survey.stations if s.motion == "fixed" and s.station_id not in carriers)


def _is_given(parameter: PoseParameter, dim: int) -> bool:
    if parameter.treatment == "held":
        return True
    cov = parameter.prior_cov
    return parameter.treatment == "prior" and cov is not None and bool(np.isfinite(np.diag(cov)[:dim]).all())


def _given(survey: Survey, ends: Ends, dim: int) -> tuple[str, ...]:
    names = {a for _, a, _ in ends}.union(b for _, _, b in ends)
    given = tuple(name for name, (_, pose) in _in_world(survey).items() if _is_given(pose, dim) and name in names)
    return ((_WORLD,) if _WORLD in names else ()) + given


def _in_world(survey: Survey) -> dict[str, tuple[ParameterName, PoseParameter]]:
    """What stands in the world: stations, targets and tables by the names of their frames, with the pose there."""
    fixed = {s.station_id: (("world_from_station", s.station_id), s.world_from_station)
             for s in survey.stations if s.motion == "fixed"}  # fmt: skip
    targets = {f"target:{t.target_id}": (("carrier_from_target", t.target_id), t.carrier_from_target)
               for t in survey.targets if t.station_id is None and t.motion != "epoch"}  # fmt: skip
    tables = {f"table:{t.table_id}": (("world_from_table", t.table_id), t.world_from_table) for t in survey.tables}
    return {**fixed, **targets, **tables}


def tied(ends: Ends, links: "Sequence[Link]", bare: tuple[str, ...] = ()) -> Topology:
    """The pairs, and what is known without them where that closes loops."""
    return topology(ends + [(link.link_id, link.frame, link.carrier) for link in links], bare)


@frozen(eq=False)
class Link:
    """A frame whose pose in another one is known without pairs, and the name of the parameter that it is."""

    frame: str
    carrier: str
    parameter: ParameterName
    given: PoseParameter

    @property
    def link_id(self) -> str:
        """Told apart from the ids of pairs."""
        return _GIVEN + self.frame


def links_of(survey: Survey, pairs: Sequence[Pair], ends: Ends, dim: int) -> list[Link]:
    """What is known without pairs, where it closes loops."""
    given, stations, standing = _given(survey, ends, dim), survey.stations_by_id, _in_world(survey)
    out = [Link(name, _WORLD, *standing[name]) for name in given if name != _WORLD] if len(given) > 1 else []
    frames, rig = dict[str, FrameRef](), dict[str, list[Link]]()
    on = {("camera", c.camera_id): (c.station_id, c.station_from_camera) for c in survey.cameras}
    on |= {("target", t.target_id): (t.station_id, t.carrier_from_target)
           for t in survey.targets if t.station_id is not None and t.motion != "epoch"}  # fmt: skip
    for pair, (_, a, b) in zip(pairs, ends, strict=True) if on else ():
        frames[a], frames[b] = pair.a, pair.b
    for name, ref in frames.items():
        station_id, known = on.get((ref.kind, ref.frame_id), ("", None))
        if station_id and known is not None and _is_given(known, dim):
            epoch = None if stations[station_id].motion == "fixed" else ref.epoch_id
            carrier = frame_name(FrameRef("station", station_id, epoch))
            kind = "station_from_camera" if ref.kind == "camera" else "carrier_from_target"
            rig.setdefault(carrier, []).append(Link(name, carrier, (kind, ref.frame_id), known))
    return out + [link for carrier, links in rig.items() if len(links) > 1 or carrier in frames for link in links]


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
