"""A network that grows: stations and pairs added to a solved network, one by one or in groups.

iSAM2 (Kaess et al., IJRR 2012) over native factors: an addition re-eliminates only what it touches, so on corridors the
time stays flat however long they are. :meth:`NetworkSession.finish` ends in the adjustment of all the pairs.
"""

from collections.abc import Sequence
from dataclasses import replace

import gtsam
import numpy as np
from gtsam import Pose3, Rot3

from adjust.adjustment import adjust
from adjust.graph.assembly import StartValues
from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.observations import Pair
from adjust.model.result import Adjustment, ParameterName
from adjust.model.survey import FloatArray, PoseParameter, Station, Survey
from adjust.observations.factors import pose_prior_factor
from adjust.observations.pair_arrays import checked_arrays
from adjust.observations.pairs import NoiseCache, native_factor
from adjust.pose_network.from_survey import network_from_survey
from adjust.pose_network.network import PoseNetwork
from adjust.pose_network.start import carried
from adjust.relay.growth import Tree

_RELINEARIZE = 1e-3
"""Change (rad, m) from which a station is linearised anew."""
_WILDFIRE = 1e-5
"""Change below which steps do not spread."""
_MOVED_RAD, _MOVED_M = 1e-6, 1e-5
_SECTION = 1000
"""Latest stations that are always kept moving; older ones may rest until :meth:`NetworkSession.finish`."""


@frozen(eq=False)
class Addition:
    """What an addition did.

    new: ``world_from_station`` of the stations added. moved: how far the others went, (rad, m).
    misfit: v'Pv of every pair added, at the new estimates.
    """

    new: dict[str, Pose3]
    moved: dict[str, tuple[float, float]]
    misfit: dict[str, float]


class NetworkSession:
    """An adjusted network that takes additions; not a value, but the state of one piece of work."""

    def __init__(self, network: Survey | Adjustment) -> None:
        """network: fixed stations and pairs of poses between them, adjusted here where it is not.

        Raises SurveyError for a survey of anything else, and for rotations alone.
        """
        survey = network if isinstance(network, Survey) else network.survey
        if not survey.is_pose_network:
            raise SurveyError("sessions take fixed stations and pairs between them; adjust the survey as a whole")
        base = network_from_survey(survey)
        if base.rotation_only:
            raise SurveyError("sessions take networks of poses; solve a network of rotations as a whole")
        if survey.datum.kind == "inner":
            raise SurveyError("sessions need a station that is held or has a prior; solve a free network as a whole")
        self._survey = survey
        self._ids = list(base.station_ids)
        self._index = dict(base.index_of)
        self._added: list[Pair] = []
        self._removed: set[str] = set()
        self._pair_ids = set(base.pair_ids)
        adjusted = adjust(self.survey()) if isinstance(network, Survey) else network
        self._noise = NoiseCache()
        self._neighbours: list[list[int]] = [[] for _ in self._ids]
        poses = [adjusted.estimates["world_from_station", s].value for s in self._ids]
        self._last = {i: p for i, p in enumerate(poses) if isinstance(p, Pose3)}
        self._constant = {i: self._last[i] for i in np.flatnonzero(base.constants).tolist()}
        self._factor_of: dict[str, int] = {}
        self._growth = Tree(_RELINEARIZE, _WILDFIRE, _SECTION)
        self._begin(base)

    def _begin(self, network: PoseNetwork) -> None:
        """The tree of what is known."""
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for i, cov in network.prior_cov.items():
            mean = Pose3(Rot3(network.station_rotations[i]), network.station_translations[i])
            graph.push_back(pose_prior_factor(PoseParameter(mean, "prior", cov), i))
        poses, W = network.arrays.poses, network.arrays.whitening
        for e in np.flatnonzero(network.used).tolist():
            factor = self._factor(int(network.a_idx[e]), int(network.b_idx[e]), poses[e], W[e])
            if factor is not None:
                self._factor_of[network.pair_ids[e]] = graph.size()
                graph.push_back(factor)
        for i in np.flatnonzero(~network.constants).tolist():
            values.insert(i, self._last[i])
        self._growth.update(graph, values)

    def _factor(self, a: int, b: int, b_from_a: Pose3, W: FloatArray) -> gtsam.NonlinearFactor | None:
        """Of a pair, which makes its ends neighbours; None between held stations."""
        self._neighbours[a].append(b)
        self._neighbours[b].append(a)
        return native_factor(self._constant.get(a, a), self._constant.get(b, b), b_from_a, W, self._noise)

    @property
    def n_stations(self) -> int:
        """Stations so far."""
        return len(self._ids)

    def estimate(self, station_id: str) -> Pose3:
        """Present ``world_from_station`` of one station."""
        return self._estimate(self._index[station_id])

    def _estimate(self, i: int) -> Pose3:
        return self._constant[i] if i in self._constant else self._growth.estimate(i)

    def add(self, pairs: Sequence[Pair]) -> Addition:
        """Add pairs between stations; stations named for the first time are new.

        Raises SurveyError for a pair id that exists, for a pair that does not join stations and for new stations that
        no pair ties to the network; the session is then as before.
        """
        arrays = checked_arrays(pairs)
        new, start = self._placed(pairs)
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for station in new:
            self._index[station] = len(self._ids)
            self._ids.append(station)
            self._neighbours.append([])
            values.insert(self._index[station], start[station])
            self._last[self._index[station]] = start[station]
        kept = list[Pair]()
        for pair, b_from_a, W in zip(pairs, arrays.poses, arrays.whitening, strict=True):
            factor = self._factor(self._index[pair.a.frame_id], self._index[pair.b.frame_id], b_from_a, W)
            if factor is not None:
                graph.push_back(factor)
                kept.append(pair)
        self._added += pairs
        self._pair_ids |= {pair.pair_id for pair in pairs}
        positions = self._growth.update(graph, values)
        self._factor_of |= {pair.pair_id: n for pair, n in zip(kept, positions, strict=True)}
        ends = sorted({self._index[r.frame_id] for p in pairs for r in (p.a, p.b)})
        moved = self._moved(ends, {self._index[s] for s in new})
        misfit = {p.pair_id: self._misfit(p) for p in kept}
        return Addition({s: self.estimate(s) for s in new}, moved, misfit)

    def _placed(self, pairs: Sequence[Pair]) -> tuple[list[str], dict[str, Pose3]]:
        """New stations in the order found and where the best of their pairs puts them; checks all pairs first."""
        fresh: set[str] = set()
        for pair in pairs:
            if pair.pair_id in self._pair_ids or pair.pair_id in fresh:
                raise SurveyError(f"pair id {pair.pair_id!r} exists already; give every pair a name of its own")
            fresh.add(pair.pair_id)
            if pair.a.kind != "station" or pair.b.kind != "station" or pair.a.frame_id == pair.b.frame_id:
                raise SurveyError(f"pair {pair.pair_id!r} does not join two stations")
        named = dict.fromkeys(r.frame_id for p in pairs for r in (p.a, p.b))
        known = {s: self.estimate(s) for s in named if s in self._index}
        start = carried(known, (p for p in pairs if isinstance(p.b_from_a, Pose3)))
        lost = [s for s in named if s not in known and s not in start]
        if lost:
            raise SurveyError(f"no pair with a translation ties {', '.join(lost[:8])} to the network; measure one")
        return [s for s in named if s in start], start

    def _moved(self, ends: list[int], new: set[int]) -> dict[str, tuple[float, float]]:
        """Stations that moved since last asked, found by spreading from the ends of the added pairs."""
        out: dict[str, tuple[float, float]] = {}
        waiting, seen = list(ends), set(ends)
        while waiting:
            i = waiting.pop()
            if i in self._constant:
                continue
            now = self._estimate(i)
            step = Pose3.Logmap(self._last[i].between(now))
            turn, shift = float(np.linalg.norm(step[:3])), float(np.linalg.norm(step[3:]))
            far = turn > _MOVED_RAD or shift > _MOVED_M
            if far:
                self._last[i] = now
                if i not in new:
                    out[self._ids[i]] = turn, shift
            if far or i in new:
                for j in self._neighbours[i]:
                    if j not in seen:
                        seen.add(j)
                        waiting.append(j)
        return out

    def _misfit(self, pair: Pair) -> float:
        a, b = self.estimate(pair.a.frame_id), self.estimate(pair.b.frame_id)
        present, measured = b.between(a), pair.b_from_a
        if isinstance(measured, Pose3):
            e = Pose3.Logmap(measured.between(present))
        else:
            e = Rot3.Logmap(measured.between(present.rotation()))
        return float(e @ np.linalg.solve(pair.cov, e))

    def uses(self, pair_id: str) -> bool:
        """Whether a pair is in use; one between held stations is not."""
        return pair_id in self._factor_of

    def remove(self, pair_ids: Sequence[str]) -> None:
        """Take pairs out again; they stay listed, out of use. Raises SurveyError for ids that are not in use."""
        missing = [p for p in pair_ids if p not in self._factor_of]
        if missing:
            raise SurveyError(f"pair {missing[0]!r} is not in use in this session")
        positions = [self._factor_of.pop(p) for p in pair_ids]
        self._growth.update(gtsam.NonlinearFactorGraph(), gtsam.Values(), positions)
        self._removed |= set(pair_ids)

    def survey(self) -> Survey:
        """All pairs and the stations that they reach, as they stand."""
        pairs, given = (*self._survey.pairs, *self._added), self._survey.stations_by_id
        return replace(
            self._survey, stations=tuple(given.get(s, Station(s)) for s in self._ids),
            pairs=tuple(replace(p, used=False) if p.pair_id in self._removed else p for p in pairs),
        )  # fmt: skip

    def poses(self) -> dict[str, Pose3]:
        """Present ``world_from_station`` of all stations."""
        values = self._growth.values()
        return {s: self._constant[i] if i in self._constant else values.atPose3(i) for i, s in enumerate(self._ids)}

    def finish(self) -> Adjustment:
        """The adjustment of all pairs, from the present estimates to the minimum, with its precision."""
        poses: dict[ParameterName, Pose3] = {("world_from_station", s): p for s, p in self.poses().items()}
        return adjust(self.survey(), StartValues({}, poses, {}))
