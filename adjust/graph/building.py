"""From a survey and its start values to the one graph."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import gtsam
import numpy as np
from gtsam import Pose3, Rot3

from adjust.frames.state import State, collect_vectors
from adjust.frames.tree import FrameTree
from adjust.frames.unknowns import POSE_COMPONENTS, POSE_UNITS, Chain, Unknowns
from adjust.graph.assembly import AdjustmentGraph, StartValues
from adjust.model.boards import deformation, warming_of
from adjust.model.clocks import CLOCKS, EpochTimes, clocks_of
from adjust.model.errors import SurveyError
from adjust.model.observations import Coordinates, FrameRef, ImageBlock, Pair, PositionRef, frame_text, position_text
from adjust.model.result import ParameterName
from adjust.model.survey import FloatArray, IntArray, Survey, VectorPrior
from adjust.observations.clocks import Shifts, collect_clocks, reading_residual, shift
from adjust.observations.factors import (
    ChainPose,
    ObservationFactor,
    Position,
    coordinates_factor,
    custom,
    distance_factor,
    gaussian,
    hold_factor,
    pair_factor,
    pose_prior_factor,
    step_factor,
    vector_prior_factor,
)
from adjust.observations.geometry.building import GeometryFactors, position_refs
from adjust.observations.images.batch import ImageBatch
from adjust.observations.images.bundle_layout import may_be_hidden
from adjust.observations.images.bundles import BundleBatch
from adjust.observations.images.helmert_blocks import helmert_blocks, runs_of_epochs
from adjust.observations.images.reduction import reduction
from adjust.observations.terrestrial.building import build_batch, reading_refs
from adjust.observations.terrestrial.parameters import collect_terrestrial, full_start

if TYPE_CHECKING:
    from adjust.observations.pairs import PairArrays, PairBatch


class GraphBuilder:
    """Builds an :class:`AdjustmentGraph`; one use."""

    def __init__(
        self, survey: Survey, lenses: Mapping[str, FloatArray], measured: "PairArrays | None" = None
    ) -> None:
        """measured: the pairs of the survey as arrays, where these and :attr:`simple` are known."""
        self.survey, self.unknowns, self.measured = survey, Unknowns(), measured
        collect_vectors(survey, self.unknowns, dict(lenses))
        self.times = collect_clocks(survey, self.unknowns)
        self.shifts: Shifts | None = None
        self.terrestrial = collect_terrestrial(survey, self.unknowns)
        self.frames = FrameTree(survey, self.unknowns)
        self.point_ids = [p.point_id for p in survey.points]
        self.known_ids = set(self.point_ids)
        self.others: list[ObservationFactor] = []
        self.vector_starts: dict[ParameterName, FloatArray] = {}
        self.simple: tuple[IntArray, ...] = ()
        """Pairs between fixed stations: their rows in ``Survey.pairs``, and the slots of both ends."""

    def build(self, start: StartValues) -> AdjustmentGraph:
        """The whole graph. Raises SurveyError naming what is missing or contradictory."""
        self._register_points()
        split = [self._block(i, block) for i, block in enumerate(self.survey.image_blocks)]
        chains = {i: self.frames.of_image(block) for i, _, block in split}
        positions, pair_chains = self._chains_of_others()
        geometry = GeometryFactors(self.survey, self.unknowns, self.frames)
        parts_of = {i: [(block, chains[i])] for i, _, block in split}
        if self.times is not None:
            parts_of, pair_chains = self._at_their_times(self.times, parts_of, pair_chains)
        self.vector_starts |= geometry.starts
        state = State(self.survey, self.unknowns, shift)
        pairs = self._pair_batch(state)
        at = {ref: self._position(state, ref, chain) for ref, chain in positions.items()}
        values = self._values(start)
        readings = build_batch(self.survey, self.unknowns, self.terrestrial, self.frames, state, at)
        if readings is not None:
            turned = {s: u.key for s, n in self.terrestrial.repeated.items() if (u := self.unknowns.by_name.get(n))}
            readings.orient(values, {name[1] for name in start.vectors if name[0] == "orientation"}, turned)
            readings, _ = readings.with_sigmas_at(values)
        survey = geometry.find_starts(state, at, values, start.vectors)
        first_pair = self._other_factors(state, at, pair_chains)
        self.others += geometry.factors(state, at, values)
        self._priors(state)
        others = gtsam.NonlinearFactorGraph()
        for item in self.others:
            if item.used:
                others.add(item.factor)
        for factor in self._holds():
            others.add(factor)
        numbers = [i for i, free, _ in split if not free for _ in parts_of[i]]
        known = [part for i, free, _ in split if not free for part in parts_of[i]]
        x_in_world = self._world_points() if any(b.target_id is None for b, _ in known) else np.zeros((0, 3))
        images = ImageBatch(self.survey, state, [b for b, _ in known], [chain for _, chain in known], x_in_world)
        # unused observations too: they are predicted with the joint covariance of their unknowns
        outside = {k for item in self.others for k in list(item.factor.keys())} | set(self.unknowns.held)
        outside |= set() if pairs is None else pairs.keys()
        outside |= readings.keys if readings is not None else set()
        of_images = set(images.of_blocks.key.tolist())
        unknown = [(i, *parts_of[i][0]) for i, free, _ in split if free]
        parts = self._parts([b for _, b, _ in unknown], [chain for *_, chain in unknown], outside | of_images)
        bundles = tuple(
            BundleBatch(self.unknowns, state, [unknown[k][1] for k in part], [unknown[k][2] for k in part],
                        self.point_ids, outside | of_images | shared, by_rows)
            for part, shared, by_rows in parts
        )  # fmt: skip
        for bundle in bundles:
            outside |= set(bundle.order) | set(bundle.point_key.values())
        # a free datum is found and completed with all unknowns in sight
        reduced = None if survey.datum.kind == "inner" else reduction(images, self.unknowns, outside)
        part_of = {unknown[k][0]: p for p, (part, *_) in enumerate(parts, 1) for k in part}
        order = [(i, part_of.get(i, 0)) for i, _, _ in split]
        return AdjustmentGraph(
            survey, self.unknowns, state, values, images, bundles, order, numbers, self.others, others, readings,
            reduced, pairs, first_pair,
        )  # fmt: skip

    def _at_their_times(
        self, times: EpochTimes, images: Mapping[int, list[tuple[ImageBlock, Chain]]], pairs: Mapping[int, Chain]
    ) -> tuple[dict[int, list[tuple[ImageBlock, Chain]]], dict[int, Chain]]:
        """Image blocks, in parts of one moment each, and pairs, with their chains when the clocks say."""
        self.shifts = shifts = Shifts(self.survey, self.unknowns, times)
        parts = {i: shifts.of_image(*whole) for i, (whole,) in images.items()}
        chains = {i: shifts.of_pair(self.survey.pairs[i], chain) for i, chain in pairs.items()}
        for reading in self.survey.table_readings:
            shifts.reading(reading)
        return parts, chains

    def _parts(
        self, blocks: Sequence[ImageBlock], chains: Sequence[Chain], outside: set[int]
    ) -> list[tuple[list[int], set[int], bool]]:
        """Image blocks of unknown points by number, in parts; keys of points that others see too; if rows stay rows."""
        if not blocks:
            return []
        number: dict[tuple[int, ...], int] = {}
        keys = [tuple(key for link in chain for key in self.unknowns.link_keys(link.slot)) for chain in chains]
        may_hide = [tuple(k for k in mine if k not in outside and may_be_hidden(self.unknowns, k)) for mine in keys]
        owner = np.array([number.setdefault(h or (-1, *k), len(number)) for h, k in zip(may_hide, keys, strict=True)])
        hidden = np.array([6.0 if pose[:1] != (-1,) else 0.0 for pose in number])
        point_key = [self.unknowns.by_name.get(("point", p)) for p in self.point_ids]
        free = np.array([u is not None and u.key not in outside for u in point_key])
        seen = [b.point_idx[free[b.point_idx]] for b in blocks]
        part = helmert_blocks(owner, seen, hidden)
        open_ = [k for k, (s, h) in enumerate(zip(seen, may_hide, strict=True)) if not len(s) and not h]
        run = runs_of_epochs([blocks[k] for k in open_])
        first_run = int(part.max()) + 1
        if run.max(initial=0):
            part[open_] = first_run + run
        count = np.zeros(len(free), dtype=np.int64)
        parts = [np.flatnonzero(part == p).tolist() for p in np.unique(part)]
        for mine in parts:
            count[np.unique(np.concatenate([blocks[k].point_idx for k in mine]))] += 1
        shared = {u.key for u, n in zip(point_key, count, strict=True) if u is not None and n > 1}
        return [(mine, shared, bool(part[mine[0]] >= first_run)) for mine in parts]

    def _register_points(self) -> None:
        for point in self.survey.points:
            parameter = point.x_in_world
            if parameter.treatment == "held":
                if parameter.value is None:
                    raise SurveyError(f"point {point.point_id!r} is held but has no coordinates; give x_mm")
                self.unknowns.held_points[point.point_id] = np.asarray(parameter.value, dtype=float)
            else:
                unknown = self.unknowns.add(("point", point.point_id), "point", ("x", "y", "z"), ("m", "m", "m"))
                self.unknowns.hold(unknown, parameter.held)

    def _block(self, i: int, block: ImageBlock) -> tuple[int, bool, ImageBlock]:
        free = block.target_id is None and any(
            self.point_ids[int(p)] not in self.unknowns.held_points for p in block.point_idx
        )
        return i, free, block

    def block_keys(self, block: ImageBlock) -> set[int]:
        """Keys of the pose and table unknowns that an image block depends on."""
        return {key for link in self.frames.of_image(block) for key in self.unknowns.link_keys(link.slot)}

    def table_keys(self) -> set[int]:
        """Keys of the table angles, which are always read."""
        return {u.key for name, u in self.unknowns.by_name.items() if name[0] == "table_angles"}

    def _world_points(self) -> FloatArray:
        """Held world points (P, 3) m; NaN for those that are not held."""
        held, unheld = self.unknowns.held_points, np.full(3, np.nan)
        return np.array([held.get(p, unheld) for p in self.point_ids]).reshape(-1, 3)

    def _position_chain(self, ref: PositionRef) -> Chain | None:
        if ref.frame is None:
            if ref.point_id not in self.known_ids:
                raise SurveyError(f"point {ref.point_id!r} is observed but not part of the survey; add it under points")
            return None
        return self.frames.relative(ref.frame, FrameRef("world"))

    def _chains_of_others(self) -> tuple[dict[PositionRef, Chain | None], dict[int, Chain]]:
        refs = position_refs(self.survey) + reading_refs(self.survey)
        positions = {ref: self._position_chain(ref) for ref in refs}
        if not self.survey.pairs:
            return positions, {}
        from adjust.observations.pairs import simple_pairs  # here: a survey without pairs starts without it

        if self.measured is None:
            self.simple = simple_pairs(self.survey, self.frames)
        elif len(self.simple[0]) == len(self.survey.pairs):
            return positions, {}
        alone = set(range(len(self.survey.pairs))).difference(self.simple[0].tolist())
        return positions, {i: self.frames.relative((p := self.survey.pairs[i]).a, p.b) for i in sorted(alone)}

    def _pair_batch(self, state: State) -> "PairBatch | None":
        """The pairs between fixed stations."""
        if not self.simple or not len(self.simple[0]):
            return None
        from adjust.observations.pairs import PairBatch, pair_arrays  # here: as above

        rows, a_slot, b_slot = self.simple
        measured = self.measured or pair_arrays([self.survey.pairs[i] for i in rows.tolist()])
        return PairBatch(measured, rows, a_slot, b_slot, self.unknowns, state)

    def _position(self, state: State, ref: PositionRef, chain: Chain | None) -> Position:
        if chain is None:
            unknown = self.unknowns.by_name.get(("point", ref.point_id or ""))
            held = self.unknowns.held_points.get(ref.point_id or "", np.zeros(3))
            return Position(None, held, unknown.key if unknown else None)
        pose = ChainPose(self.unknowns, state, chain)
        if ref.point_id is None or ref.frame is None:
            return Position(pose, np.zeros(3))
        target = self.survey.targets_by_id[ref.frame.frame_id]
        if ref.point_id not in target.point_ids:
            raise SurveyError(f"target {target.target_id!r} has no point {ref.point_id!r}")
        i = target.point_ids.index(ref.point_id)
        warp = self.unknowns.vectors.get(("warp", target.target_id))
        if warp is None:
            return Position(pose, target.x_in_target[i])
        warming = warming_of(self.survey, target, ref.frame.epoch_id)
        return Position(pose, target.x_in_target[i], None, warp,
                        deformation(target.x_in_target, warp.names, warming)[i])  # fmt: skip

    def _other_factors(
        self, state: State, at: Mapping[PositionRef, Position], pair_chains: Mapping[int, Chain]
    ) -> int:
        """All that are in no batch; the place of the first pair among them."""
        for reading in self.survey.table_readings:
            unknown = self.unknowns.by_name.get(("table_angles", reading.table_id, reading.epoch_id))
            if unknown is not None:
                factor: gtsam.NonlinearFactor
                factor = gtsam.PriorFactorVector(unknown.key, reading.angles, gaussian(reading.cov))
                shifted = None if self.shifts is None else self.shifts.reading(reading)
                if shifted is not None:
                    keys, residual = reading_residual(shifted, self.unknowns, reading.angles)
                    factor = custom(keys, reading.cov, residual)
                self._other(factor, "table", reading.group, (reading.table_id, reading.epoch_id), unknown.components,
                            unknown.units, reading.angles, reading.used)  # fmt: skip
        first_pair = len(self.others)
        for i, chain in pair_chains.items():
            self._pair(state, self.survey.pairs[i], chain)
        for d in self.survey.distances:
            if not at[d.a].keys and not at[d.b].keys:
                raise SurveyError(f"distance {d.distance_id!r} joins two held positions; it can adjust nothing")
            ids = (d.distance_id, position_text(d.a), position_text(d.b))
            self._other(distance_factor(d, at[d.a], at[d.b]), "distance", d.group, ids, ("distance",), ("m",),
                        np.array([d.value]), d.used)  # fmt: skip
        for c in self.survey.coordinates:
            known = np.isfinite(np.diag(c.cov))
            names = tuple(f"{position_text(p)} {axis}" for p in c.positions for axis in "xyz")
            names = tuple(np.array(names)[known].tolist())
            owners = tuple(position_text(p) for p in c.positions)
            self._other(coordinates_factor(c, [at[p] for p in c.positions]), "coordinates", c.group, owners, names,
                        ("m",) * len(names), c.values.ravel()[known], c.used)  # fmt: skip
        return first_pair

    def _pair(self, state: State, pair: Pair, chain: Chain) -> None:
        factor = pair_factor(pair, self.unknowns, state, chain)
        measured = pair.b_from_a
        observed = Pose3.Logmap(measured) if isinstance(measured, Pose3) else Rot3.Logmap(measured)
        n = len(observed)
        self._other(factor, "pair", pair.group, (pair.pair_id, frame_text(pair.a), frame_text(pair.b)),
                    POSE_COMPONENTS[:n], POSE_UNITS[:n], observed, pair.used)  # fmt: skip

    def _priors(self, state: State) -> None:
        u = self.unknowns
        for name, parameter in u.parameters.items():
            if parameter.treatment == "prior":
                if parameter.value is None or parameter.prior_cov is None:
                    raise SurveyError(f"{' '.join(name)} has a prior without value or covariance; give both")
                factor = pose_prior_factor(parameter, u.by_name[name].key)
                known = np.isfinite(np.diag(parameter.prior_cov))
                self._other(factor, "prior", "prior", name, tuple(np.array(POSE_COMPONENTS)[known]),
                            tuple(np.array(POSE_UNITS)[known]), np.zeros(int(known.sum())))  # fmt: skip
        for point in self.survey.points:
            p = point.x_in_world
            if p.treatment == "prior":
                if p.value is None or p.prior_cov is None:
                    raise SurveyError(f"point {point.point_id!r} has a prior without coordinates or sigma; give both")
                name = ("point", point.point_id)
                known = np.isfinite(np.diag(p.prior_cov))
                mean = Coordinates((PositionRef(point.point_id),), np.asarray(p.value)[None], p.prior_cov)
                factor = coordinates_factor(mean, [Position(None, np.zeros(3), u.by_name[name].key)])
                self._other(factor, "prior", "prior", name, tuple(np.array(["x", "y", "z"])[known]),
                            ("m",) * int(known.sum()), np.asarray(p.value)[known])  # fmt: skip
        owners: list[tuple[ParameterName, VectorPrior | None]]
        owners = [(("lens", c.camera_id), c.lens.prior) for c in self.survey.cameras]
        owners += [(("lens_crop", c.camera_id, e), x.parameters.prior) for c in self.survey.cameras
                   for e, x in c.lens.crops.items()]  # fmt: skip
        owners += [(("table_geometry", t.table_id), t.geometry.prior) for t in self.survey.tables]
        owners += [(("warp", t.target_id), t.warp.prior) for t in self.survey.targets if t.warp]
        owners += [(("beam", b.beam_id), b.parameters.prior) for b in self.survey.beams]
        owners += [(("surface", s.surface_id), s.parameters.prior) for s in self.survey.surfaces if s.parameters]
        owners += [(("vertical",), self.survey.vertical.tilt.prior)]
        owners += [(name, clock.parameters.prior) for name, clock in clocks_of(self.survey)]
        owners += self.terrestrial.priors.items()
        for name, sigma in ({} if self.shifts is None else self.shifts.jitters).items():
            factor = step_factor(u.vectors[name], None, np.array([sigma]))
            self._other(factor, "prior", "prior", name, ("jitter",), u.vectors[name].units, np.zeros(1))
        for name, before, sigmas in state.lens_states.priors:
            change = u.vectors[name]
            factor = step_factor(change, None if before is None else u.vectors[before], sigmas)
            self._other(factor, "prior", "prior", name, change.names, change.units, np.zeros(len(sigmas)))
        for name, prior in owners:
            vector = u.vectors.get(name)
            if prior is not None and vector is not None and vector.key is not None:
                units = tuple(vector.units[vector.names.index(x)] for x in prior.names)
                self._other(vector_prior_factor(prior, vector), "prior", "prior", name, prior.names, units, prior.mean)

    def _holds(self) -> list[gtsam.NonlinearFactor]:
        """What keeps single components of poses and points at their values. Raises SurveyError where there is none."""
        u = self.unknowns
        values = {name: parameter.value for name, parameter in u.parameters.items()}
        points: dict[ParameterName, FloatArray | None] = {
            ("point", p.point_id): p.x_in_world.value for p in self.survey.points
        }
        factors = []
        for key, held in u.held.items():
            unknown = u.by_key[key]
            value = points[unknown.name] if unknown.kind == "point" else values[unknown.name]
            if value is None:
                names = ", ".join(unknown.components[i] for i in held)
                raise SurveyError(f"{' '.join(unknown.name)}: {names} held without a value; give it one")
            factors.append(hold_factor(unknown, held, value))
        return factors

    def _other(
        self, factor: gtsam.NonlinearFactor, kind: str, group: str, ids: tuple[str, ...], components: tuple[str, ...],
        units: tuple[str, ...], observed: FloatArray, used: bool = True,
    ) -> None:  # fmt: skip
        self.others.append(
            ObservationFactor(factor, kind, group, ids, components, units, np.asarray(observed, dtype=float), used)
        )

    def _values(self, start: StartValues) -> gtsam.Values:
        values = gtsam.Values()
        missing = []
        for name, unknown in self.unknowns.by_name.items():
            if unknown.kind == "pose":
                if name in start.poses:
                    values.insert(unknown.key, start.poses[name])
                else:
                    missing.append(" ".join(name))
            elif unknown.kind == "point":
                if name[1] in start.points:
                    values.insert(unknown.key, np.asarray(start.points[name[1]], dtype=float))
                else:
                    missing.append(" ".join(name))
            else:
                values.insert(unknown.key, self._start_vector(name, start))
        if missing:
            raise SurveyError("no start value for " + ", ".join(missing))
        return values

    def _start_vector(self, name: ParameterName, start: StartValues) -> FloatArray:
        if name[0] == "table_angles":
            for reading in self.survey.table_readings:
                if (reading.table_id, reading.epoch_id) == name[1:]:
                    return np.array(start.vectors.get(name, reading.angles), dtype=float)
        vector = self.unknowns.vectors[name]
        if name[0] == "lens":
            full = start.lenses[name[1]]
        elif name in start.vectors:
            full = start.vectors[name]
        elif name in self.vector_starts:
            full = self.vector_starts[name]
        elif name[0] == "lens_drift":
            full = np.zeros(len(vector.names))
        elif name[0] == "lens_crop":
            lens = self.survey.cameras_by_id[name[1]].lens
            full = lens.crops[name[2]].parameters.values
        elif name[0] in ("vertical", "instrument", "orientation", "centring"):
            full = full_start(name, self.survey)
        elif name[0] == "table_geometry":
            full = self.survey.tables_by_id[name[1]].geometry.values
        elif name[0] in CLOCKS:
            full = next((c.parameters.values for owner, c in clocks_of(self.survey) if owner == name), np.zeros(1))
        else:
            full = next(t.warp.values for t in self.survey.targets if t.target_id == name[1] and t.warp)
        return np.array([full[vector.names.index(x)] for x in vector.own], dtype=float)
