"""Start values from set-ups that are not levelled: poses of their stations, points they see, targets tied to these.

Direction and zenith angle are a ray in the station's frame, with a distance a point in it. A station follows from the
points that it sees and that are known, by resection or by fitting; points follow from stations, targets from points.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from gtsam import Pose3

from adjust.model.errors import SurveyError
from adjust.model.observations import FrameRef, PositionRef
from adjust.model.result import ParameterName
from adjust.model.survey import FloatArray, Survey
from adjust.native.views import refine_poses, view_errors
from adjust.spatial.rigid import align, inverse, rotation_exp
from adjust.start.closed_forms.absolute_pose import pose_solutions
from adjust.start.closed_forms.triangulation import intersect
from adjust.start.readings.sights import Node, node_of, spread_differences

_PARALLAX = np.deg2rad(0.3)
_TOGETHER = np.deg2rad(75.0)
"""Rays within this of one of them are resected as a view; the others only refine it."""
_FEWEST, _SURE = 3, 4
_THIN = 1e-3
_OFF = np.deg2rad(2.0)
"""A resection that misses its rays by more, in the median, is none."""


@dataclass(frozen=True, eq=False)
class TiltedSight:
    """One target from one set-up: unit ray (3,) in the station's frame, orientation zero; distance m, nan if none."""

    setup_id: str
    node: Node
    ray: FloatArray
    distance: float


@dataclass(eq=False)
class TiltedStart:
    """What is known by now: nodes (3,) m in the world, poses (4, 4) of stations and of targets by their reference."""

    known: dict[Node, FloatArray]
    stations: dict[PositionRef, FloatArray] = field(default_factory=dict)
    targets: dict[str, FloatArray] = field(default_factory=dict)
    turns: dict[str, float] = field(default_factory=dict)

    def poses(self) -> dict[ParameterName, Pose3]:
        """The poses under their names."""
        out = {station_name(ref): Pose3(np.ascontiguousarray(T)) for ref, T in self.stations.items()}
        for target_id, T in self.targets.items():
            out["carrier_from_target", target_id] = Pose3(np.ascontiguousarray(T))
        return out


def station_name(ref: PositionRef) -> ParameterName:
    """The pose of the station at whose origin a tilted set-up stands."""
    frame = ref.frame or FrameRef("world")
    return ("world_from_station", frame.frame_id, *((frame.epoch_id,) if frame.epoch_id else ()))


def tilted_sights(survey: Survey) -> dict[PositionRef, list[TiltedSight]]:
    """The rays of every station with set-ups that are not levelled, from readings in use."""
    tilted = {s.setup_id for s in survey.setups if not s.levelled}
    sign = -1.0 if survey.bearings.clockwise else 1.0
    found: dict[tuple[PositionRef, str, Node], dict[str, list[float]]] = {}
    for r in survey.readings:
        if r.used and r.setup_id in tilted and r.at.frame is not None and r.at.frame.kind == "station":
            found.setdefault((r.at, r.setup_id, node_of(r.to)), {}).setdefault(r.kind, []).append(r.value)
    out: dict[PositionRef, list[TiltedSight]] = {}
    for (at, setup_id, node), values in found.items():
        mine = out.setdefault(at, [])
        if "direction" not in values or "zenith" not in values:
            continue
        # the mean direction: readings of both faces lie together
        turn = float(np.angle(np.mean(np.exp(1j * np.array(values["direction"])))))
        zenith = float(np.median(values["zenith"]))
        ray = np.array([np.sin(zenith) * np.cos(sign * turn), np.sin(zenith) * np.sin(sign * turn), np.cos(zenith)])
        distance = float(np.median(values["slope_distance"])) if "slope_distance" in values else np.nan
        if not np.isfinite(distance) and "horizontal_distance" in values:
            distance = float(np.median(values["horizontal_distance"])) / max(abs(np.sin(zenith)), 1e-6)
        mine.append(TiltedSight(setup_id, node, ray, distance))
    return out


def find_tilted(
    survey: Survey, known: Mapping[Node, FloatArray], given: Mapping[ParameterName, Pose3]
) -> TiltedStart | None:
    """Stations, points and targets from tilted set-ups, as far as they go; None where there are no such set-ups.

    known: (3,) m by point, nan for components not known. given: poses with a value. Where nothing at all is known, the
    station with the most distances is set freely.
    """
    sights = tilted_sights(survey)
    if not sights:
        return None
    whole = {n: np.asarray(x, dtype=float) for n, x in known.items() if np.isfinite(x).all()}
    start = TiltedStart(whole)
    for ref in sights:
        pose = given.get(station_name(ref), given.get(station_name(ref)[:2]))
        if pose is not None:
            start.stations[ref] = np.asarray(pose.matrix())
    fixed = {t.target_id for t in survey.targets if t.station_id is None and t.motion == "fixed"}
    for target_id in fixed:
        pose = given.get(("carrier_from_target", target_id))
        if pose is not None:
            start.targets[target_id] = np.asarray(pose.matrix())
    search = _Search(survey, sights, start, fixed)
    search.run()
    return start


@dataclass(eq=False)
class _Search:
    survey: Survey
    sights: dict[PositionRef, list[TiltedSight]]
    start: TiltedStart
    fixed: set[str]

    def run(self) -> None:
        while self._advance():
            pass

    def _advance(self) -> bool:
        """One step, the first of the list that is possible; whether there was one."""
        return (
            spread_differences(self.survey, self.start.known) or self._targets() or self._turns()
            or self._stations(_SURE) or self._points() or self._stations(_FEWEST) or self._untold_turns()
            or self._set_freely()
        )  # fmt: skip

    def _targets(self) -> bool:
        """Targets of which three points are known, and from these all their points."""
        found = False
        for target in self.survey.targets:
            if target.target_id not in self.fixed:
                continue
            nodes = [node_of(PositionRef(p, FrameRef("target", target.target_id))) for p in target.point_ids]
            mine = [i for i, n in enumerate(nodes) if n in self.start.known]
            if target.target_id not in self.start.targets:
                there = np.array([self.start.known[nodes[i]] for i in mine]).reshape(-1, 3)
                if not _spans(there):
                    continue
                self.start.targets[target.target_id] = align(there, target.x_in_target[mine])
            T = self.start.targets[target.target_id]
            for n, x in zip(nodes, target.x_in_target, strict=True):
                if n not in self.start.known:
                    self.start.known[n] = T[:3, :3] @ x + T[:3, 3]
                    found = True
        return found

    def _setups(self, ref: PositionRef) -> list[str]:
        return list(dict.fromkeys(s.setup_id for s in self.sights[ref]))

    def _turns(self) -> bool:
        """Orientations of set-ups on stations that are known, from the known points that they see."""
        found = False
        for ref, T in self.start.stations.items():
            for setup_id in self._setups(ref):
                if setup_id not in self.start.turns and (turn := self._turn(ref, setup_id, T)) is not None:
                    self.start.turns[setup_id], found = turn, True
        return found

    def _turn(self, ref: PositionRef, setup_id: str, T: FloatArray) -> float | None:
        back = inverse(T)
        angles = []
        for s in self.sights[ref]:
            if s.setup_id == setup_id and s.node in self.start.known:
                x = back[:3, :3] @ self.start.known[s.node] + back[:3, 3]
                angles.append(np.arctan2(x[1], x[0]) - np.arctan2(s.ray[1], s.ray[0]))
        if not angles:
            return None
        # the one nearest to all others: a wrong point turns nothing
        apart = np.abs(np.angle(np.exp(1j * np.subtract.outer(angles, angles)))).sum(axis=1)
        return float(angles[int(np.argmin(apart))])

    def _stations(self, fewest: int) -> bool:
        """Poses of stations from the known points that one of their set-ups sees."""
        found = False
        for ref in self.sights:
            if ref in self.start.stations:
                continue
            for setup_id in self._setups(ref):
                mine = [s for s in self.sights[ref] if s.setup_id == setup_id and s.node in self.start.known]
                pose = _station_pose(mine, self.start.known, fewest)
                if pose is not None:
                    self.start.stations[ref], self.start.turns[setup_id], found = pose, 0.0, True
                    break
        return found

    def _points(self) -> bool:
        """Points that known stations see, by a distance or from two directions."""
        polar: dict[Node, list[FloatArray]] = {}
        origins, directions, names = [], [], []
        for ref, T in self.start.stations.items():
            for s in self.sights[ref]:
                if s.node in self.start.known or s.setup_id not in self.start.turns:
                    continue
                ray = T[:3, :3] @ rotation_exp(np.array([0.0, 0.0, self.start.turns[s.setup_id]])) @ s.ray
                if np.isfinite(s.distance):
                    polar.setdefault(s.node, []).append(T[:3, 3] + s.distance * ray)
                origins.append(T[:3, 3])
                directions.append(ray)
                names.append(s.node)
        new = {n: np.asarray(np.median(x, axis=0)) for n, x in polar.items()}
        nodes = sorted(set(names) - set(new))
        rows = np.array([i for i, n in enumerate(names) if n not in new], dtype=np.int64)
        if len(rows):
            place = {n: i for i, n in enumerate(nodes)}
            which = np.array([place[names[i]] for i in rows], dtype=np.int64)
            met = intersect(np.array(origins)[rows], np.array(directions)[rows], which, len(nodes))
            good = (met.parallax > _PARALLAX) & np.isfinite(met.x[:, 0])
            new |= {n: met.x[i] for n, i in place.items() if good[i]}
        self.start.known |= new
        return bool(new)

    def _untold_turns(self) -> bool:
        """Set-ups on known stations that see no known point: as their station's axes say."""
        for ref in self.start.stations:
            for setup_id in self._setups(ref)[:1]:
                if setup_id not in self.start.turns:
                    self.start.turns[setup_id] = 0.0
                    return True
        return False

    def _set_freely(self) -> bool:
        """Where nothing is known, the station with the most distances is the world."""
        if self.start.known or self.start.stations:
            return False
        count = {ref: sum(np.isfinite(s.distance) for s in mine) for ref, mine in self.sights.items()}
        ref = max(count, key=lambda r: count[r])
        if count[ref] < _FEWEST:
            return False
        self.start.stations[ref] = np.eye(4)
        return True


def _spans(x: FloatArray) -> bool:
    """Whether points (n, 3) lie neither at one place nor on one line."""
    if len(x) < _FEWEST:
        return False
    s = np.linalg.svd(x - x.mean(axis=0), compute_uv=False)
    return bool(s[1] > _THIN * s[0])


def _station_pose(mine: list[TiltedSight], known: Mapping[Node, FloatArray], fewest: int) -> FloatArray | None:
    """``world_from_station`` (4, 4) from sights to known nodes, None where they do not tell."""
    polar = [s for s in mine if np.isfinite(s.distance)]
    there = np.array([known[s.node] for s in polar]).reshape(-1, 3)
    if _spans(there):
        return align(there, np.array([s.distance * s.ray for s in polar]))
    if len(mine) < fewest:
        return None
    x, rays = np.array([known[s.node] for s in mine]), np.array([s.ray for s in mine])
    candidates = _resections(x, rays)
    if not len(candidates):
        return None
    n = len(candidates)
    ptr, every, seen = np.arange(n + 1) * len(x), np.tile(x, (n, 1)), np.tile(rays, (n, 1))
    candidates = refine_poses(candidates, every, seen, ptr, 10)
    error, in_front = view_errors(candidates, every, seen, ptr)
    error = np.where(in_front & np.isfinite(error), error, np.inf)
    best = int(np.argmin(error))
    return inverse(candidates[best]) if error[best] < _OFF else None


def _resections(x: FloatArray, rays: FloatArray) -> FloatArray:
    """Poses (k, 4, 4) station_from_world: of all rays, or where they look all around of those near each of them."""
    out = [np.zeros((0, 4, 4))]
    groups = [np.arange(len(rays))] + [np.flatnonzero(rays @ ray > np.cos(_TOGETHER)) for ray in rays]
    for rows in groups:
        if len(rows) < _FEWEST:
            continue
        try:
            out.append(pose_solutions(x[rows], rays[rows]))
        except SurveyError:  # on a line, or too wide: another group may do
            continue
    return np.concatenate(out)
