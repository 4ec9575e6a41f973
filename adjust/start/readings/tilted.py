"""Start values from set-ups that are not levelled: poses of their stations, points they see, targets tied to these.

Direction and zenith angle are a ray in the station's frame, with a distance a point in it. A station follows from the
points that it sees and that are known, by resection or by fitting; points follow from stations, targets from points.
"""

from collections.abc import Mapping

import numpy as np

from adjust.model.boards import deformed
from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.observations import FrameRef, PositionRef
from adjust.model.survey import FloatArray, Survey
from adjust.spatial.averaging import circular_median
from adjust.spatial.rigid import align, inverse, rotation_exp
from adjust.start.chains import ChainObservation
from adjust.start.closed_forms.absolute_pose import best_of, pose_solutions
from adjust.start.closed_forms.triangulation import intersect
from adjust.start.positions import Positions
from adjust.start.readings.sights import Node, node_of, spread_differences, ties

_PARALLAX = np.deg2rad(0.3)
_TOGETHER = np.deg2rad(75.0)
"""Rays within this of one of them are resected as a view; the others only refine it."""
_FEWEST, _SURE = 3, 4
_THIN = 1e-3
_OFF = np.deg2rad(2.0)
"""A resection that misses its rays by more, in the median, is none."""


@frozen(eq=False)
class TiltedSight:
    """One target from one set-up: unit ray (3,) in the station's frame, orientation zero; distance m, nan if none."""

    setup_id: str
    to: PositionRef
    ray: FloatArray
    distance: float

    @property
    def node(self) -> Node:
        """Of the target."""
        return node_of(self.to)


def tilted_sights(survey: Survey) -> dict[PositionRef, list[TiltedSight]]:
    """The rays of every station with set-ups that are not levelled, from readings in use."""
    tilted = {s.setup_id for s in survey.setups if not s.levelled}
    sign = -1.0 if survey.bearings.clockwise else 1.0
    found: dict[tuple[PositionRef, str, PositionRef], dict[str, list[float]]] = {}
    for r in survey.readings:
        if r.used and r.setup_id in tilted and r.at.frame is not None and r.at.frame.kind == "station":
            found.setdefault((r.at, r.setup_id, r.to), {}).setdefault(r.kind, []).append(r.value)
    out: dict[PositionRef, list[TiltedSight]] = {}
    for (at, setup_id, to), values in found.items():
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
        mine.append(TiltedSight(setup_id, to, ray, distance))
    return out


class TiltedSetups:
    """Stations, points and targets from tilted set-ups, as steps of the search."""

    def __init__(self, survey: Survey, positions: Positions) -> None:
        self.survey, self.positions = survey, positions
        self.sights = tilted_sights(survey)
        self.turns: dict[str, float] = {}
        self.known: dict[Node, FloatArray] = {}
        """Coordinates (3,) m in the world, also of points of targets that are not known themselves."""
        self._told: set[FrameRef] = set()
        refs = [ref for mine in self.sights.values() for s in mine for ref in (s.to,)]
        refs += [ref for a, b, _ in ties(survey) for ref in (a, b)]
        seen = {ref.frame.frame_id for ref in refs if ref.frame is not None and ref.frame.kind == "target"}
        self.fixed = [
            (FrameRef("target", t.target_id), t) for t in survey.targets
            if t.target_id in seen and t.station_id is None and t.motion == "fixed"
        ]  # fmt: skip
        refs += [PositionRef(n, frame) for frame, t in self.fixed for n in t.point_ids]
        self._refs = {ref: node_of(ref) for ref in refs}

    def advance(self) -> bool:
        """One step, the first of the list that is possible; whether there was one."""
        if not self.sights:
            return False
        self.known |= {self._refs[ref]: x for ref, x in self.positions.of(self._refs).items()}
        return (
            spread_differences(self.survey, self.known) or self._targets() or self._turns()
            or self._stations(_SURE) or self._points() or self._stations(_FEWEST) or self._untold_turns()
            or self._set_freely()
        )  # fmt: skip

    def _placed(self) -> list[tuple[PositionRef, FloatArray]]:
        """Stations whose pose (4, 4) is known."""
        network = self.positions.network
        chains = {ref: self.positions.chain(ref.frame) for ref in self.sights if ref.frame is not None}
        return [(ref, network.product(chain)) for ref, chain in chains.items() if not network.open_slots(chain)]

    def _tell(self, frame: FrameRef | None, pose: FloatArray) -> bool:
        """``world_from_frame`` is observed."""
        if frame is None or frame in self._told:
            return False
        self._told.add(frame)
        network = self.positions.network
        network.observe([ChainObservation(self.positions.chain(frame), pose[None])])
        network.propagate()
        return True

    def _targets(self) -> bool:
        """Targets of which three points are known."""
        for frame, target in self.fixed:
            nodes = [node_of(PositionRef(p, frame)) for p in target.point_ids]
            mine = [i for i, n in enumerate(nodes) if n in self.known]
            there = np.array([self.known[nodes[i]] for i in mine]).reshape(-1, 3)
            unknown = self.positions.network.open_slots(self.positions.chain(frame))
            if unknown and _spans(there) and self._tell(frame, align(there, deformed(target)[mine])):
                return True
        return False

    def _setups(self, ref: PositionRef) -> list[str]:
        return list(dict.fromkeys(s.setup_id for s in self.sights[ref]))

    def _turns(self) -> bool:
        """Orientations of set-ups on stations that are known, from the known points that they see."""
        found = False
        for ref, T in self._placed():
            for setup_id in self._setups(ref):
                if setup_id not in self.turns and (turn := self._turn(ref, setup_id, T)) is not None:
                    self.turns[setup_id], found = turn, True
        return found

    def _turn(self, ref: PositionRef, setup_id: str, T: FloatArray) -> float | None:
        back = inverse(T)
        angles = []
        for s in self.sights[ref]:
            if s.setup_id == setup_id and s.node in self.known:
                x = back[:3, :3] @ self.known[s.node] + back[:3, 3]
                angles.append(np.arctan2(x[1], x[0]) - np.arctan2(s.ray[1], s.ray[0]))
        return circular_median(np.array(angles)) if angles else None

    def _stations(self, fewest: int) -> bool:
        """Poses of stations from the known points that one of their set-ups sees."""
        found, placed = False, {ref for ref, _ in self._placed()}
        for ref in self.sights:
            for setup_id in self._setups(ref) if ref not in placed and ref.frame not in self._told else ():
                mine = [s for s in self.sights[ref] if s.setup_id == setup_id and s.node in self.known]
                pose = _station_pose(mine, self.known, fewest)
                if pose is not None:
                    self.turns[setup_id], found = 0.0, self._tell(ref.frame, pose)
                    break
        return found

    def _points(self) -> bool:
        """Points that known stations see, by a distance or from two directions."""
        polar: dict[Node, list[FloatArray]] = {}
        origins, directions, names = [], [], []
        for ref, T in self._placed():
            for s in self.sights[ref]:
                if s.node in self.known or s.setup_id not in self.turns:
                    continue
                ray = T[:3, :3] @ rotation_exp(np.array([0.0, 0.0, self.turns[s.setup_id]])) @ s.ray
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
        self.known |= new
        return bool(new)

    def _untold_turns(self) -> bool:
        """Set-ups on known stations that see no known point: as their station's axes say."""
        for ref, _ in self._placed():
            for setup_id in self._setups(ref)[:1]:
                if setup_id not in self.turns:
                    self.turns[setup_id] = 0.0
                    return True
        return False

    def _set_freely(self) -> bool:
        """Where nothing is known, the station with the most distances is the world."""
        if self.known or self._placed() or np.isfinite(self.positions.points.x).any():
            return False
        count = {ref: sum(np.isfinite(s.distance) for s in mine) for ref, mine in self.sights.items()}
        ref = max(count, key=lambda r: count[r])
        if count[ref] < _FEWEST:
            return False
        return self._tell(ref.frame, np.eye(4))


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
    one = np.zeros(len(candidates), dtype=np.int64)
    poses, errors = best_of(candidates, one, x, rays, np.array([0, len(x)]), 10)
    return inverse(poses[0]) if errors[0] < _OFF else None


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
