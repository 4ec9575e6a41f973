"""From a survey and its start values to the one graph."""

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING

import gtsam
import numpy as np

from adjust.frames.state import State, collect_vectors
from adjust.frames.tree import FrameTree
from adjust.frames.unknowns import Chain, Unknowns
from adjust.graph.assembly import AdjustmentGraph, StartValues
from adjust.graph.singles import Singles, beside_images
from adjust.model.boards import deformation, warming_of
from adjust.model.clocks import EpochTimes
from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.observations import FrameRef, ImageBlock, PositionRef
from adjust.model.result import ParameterName
from adjust.model.rewriting import vector_parameters
from adjust.model.survey import BoolArray, FloatArray, IntArray, Survey, VectorParameter
from adjust.observations.between_epochs import Shifting
from adjust.observations.clocks import Shifts, collect_clocks
from adjust.observations.factors import (
    ChainPose,
    Position,
)
from adjust.observations.geometry.building import GeometryFactors, position_refs
from adjust.observations.images.batch import ImageBatch
from adjust.observations.images.bundle_layout import may_be_hidden
from adjust.observations.images.bundles import BundleBatch
from adjust.observations.images.helmert_blocks import helmert_blocks, runs_of_epochs
from adjust.observations.images.reduction import reduction
from adjust.observations.terrestrial.building import build_batch
from adjust.observations.terrestrial.parameters import collect_terrestrial

if TYPE_CHECKING:
    from adjust.observations.pair_arrays import PairArrays
    from adjust.observations.pairs import PairBatch


@frozen(eq=False)
class _Images:
    """Image blocks, or parts of them that were exposed at one moment, with their chains. number: each one's block."""

    number: IntArray
    blocks: Sequence[ImageBlock]
    chains: Sequence[Chain]

    def part(self, which: BoolArray | IntArray) -> "_Images":
        """Some of them; itself where these are all."""
        if which.dtype == np.bool_ and which.all():
            return self
        rows = np.arange(len(self.blocks))[which].tolist()
        return _Images(self.number[rows], [self.blocks[i] for i in rows], [self.chains[i] for i in rows])


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
        self.vector_starts: dict[ParameterName, FloatArray] = {}
        self.simple: tuple[IntArray, ...] = ()
        """Pairs between fixed stations: their rows in ``Survey.pairs``, and the slots of both ends."""

    def build(self, start: StartValues) -> AdjustmentGraph:
        """The whole graph. Raises SurveyError naming what is missing or contradictory."""
        self._register_points()
        blocks = self.survey.image_blocks
        seen = _Images(np.arange(len(blocks)), blocks, [self.frames.of_image(block) for block in blocks])
        positions, pair_chains = self._chains_of_others()
        geometry = GeometryFactors(self.survey, self.unknowns, self.frames)
        if self.times is not None:
            seen, pair_chains = self._at_their_times(self.times, seen, pair_chains)
        self.vector_starts |= geometry.starts
        state = State(self.survey, self.unknowns, Shifting(self.unknowns))
        pairs = self._pair_batch(state)
        at = {ref: self._position(state, ref, chain) for ref, chain in positions.items()}
        values = self._values(start)
        readings = build_batch(self.survey, self.unknowns, self.terrestrial, self.frames, state, at)
        if readings is not None:
            turned = {s: u.key for s, n in self.terrestrial.repeated.items() if (u := self.unknowns.by_name.get(n))}
            readings.orient(values, {name[1] for name in start.vectors if name[0] == "orientation"}, turned)
            readings, _ = readings.with_sigmas_at(values)
        survey = geometry.find_starts(state, at, values, start.vectors)
        singles = Singles(self.survey, self.unknowns, state, self.shifts)
        singles.add_table_readings()
        first_pair = len(singles.items)
        singles.add_pairs(pair_chains)
        singles.add_distances(at)
        singles.add_coordinates(at)
        singles.items += geometry.factors(state, at, values)
        singles.add_priors(self.terrestrial.priors)
        # unused observations too: they are predicted with the joint covariance of their unknowns
        outside = beside_images(self.unknowns, singles.items, pairs, readings)
        number, images, part_of, bundles = self._image_batches(state, seen, outside)
        for bundle in bundles:
            outside |= set(bundle.order) | set(bundle.point_key.values())
        # a free datum is found and completed with all unknowns in sight
        reduced = None if self.survey.datum.kind == "inner" else reduction(images, self.unknowns, outside)
        return AdjustmentGraph(
            survey, self.unknowns, state, values, images, bundles, number, part_of, singles.items, singles.graph(),
            readings, reduced, pairs, first_pair,
        )  # fmt: skip

    def _image_batches(
        self, state: State, seen: _Images, outside: set[int]
    ) -> tuple[IntArray, ImageBatch, IntArray, tuple[BundleBatch, ...]]:
        """Image blocks of known points in one batch, of unknown ones in bundles, with keys ``outside`` of both.

        Numbers of the blocks in the batch, this, of every block the bundle (0: none) and these.
        """
        unheld = np.array([p not in self.unknowns.held_points for p in self.point_ids], dtype=np.bool_)
        free = np.array([b.target_id is None and bool(unheld[b.point_idx].any()) for b in seen.blocks], dtype=np.bool_)
        known, unknown = seen.part(~free), seen.part(free)
        x_in_world = self._world_points() if any(b.target_id is None for b in known.blocks) else np.zeros((0, 3))
        images = ImageBatch(self.survey, state, known.blocks, known.chains, x_in_world)
        of_images = set(images.of_blocks.key.tolist())
        part_of, bundles = np.zeros(len(self.survey.image_blocks), dtype=np.int64), list[BundleBatch]()
        for rows, shared, by_rows in self._parts(unknown.blocks, unknown.chains, outside | of_images):
            mine = unknown.part(rows)
            bundles.append(BundleBatch(self.unknowns, state, mine.blocks, mine.chains, self.point_ids,
                                       outside | of_images | shared, by_rows))  # fmt: skip
            part_of[mine.number] = len(bundles)
        return known.number, images, part_of, tuple(bundles)

    def _at_their_times(
        self, times: EpochTimes, seen: _Images, pairs: Mapping[int, Chain]
    ) -> tuple[_Images, dict[int, Chain]]:
        """Image blocks, in parts of one moment each, and pairs, with their chains when the clocks say."""
        self.shifts = shifts = Shifts(self.survey, self.unknowns, times)
        of_blocks = [shifts.of_image(*whole) for whole in zip(seen.blocks, seen.chains, strict=True)]
        parts = [part for parts in of_blocks for part in parts]
        number = np.repeat(seen.number, np.array([len(parts) for parts in of_blocks], dtype=np.int64))
        chains = {i: shifts.of_pair(self.survey.pairs[i], chain) for i, chain in pairs.items()}
        for reading in self.survey.table_readings:
            shifts.reading(reading)
        return _Images(number, [block for block, _ in parts], [chain for _, chain in parts]), chains

    def _parts(
        self, blocks: Sequence[ImageBlock], chains: Sequence[Chain], outside: set[int]
    ) -> list[tuple[IntArray, set[int], bool]]:
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
        parts = [np.flatnonzero(part == p) for p in np.unique(part)]
        for mine in parts:
            count[np.unique(np.concatenate([blocks[k].point_idx for k in mine.tolist()]))] += 1
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
        refs = [*position_refs(self.survey), *self.survey.reading_refs]
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
        from adjust.observations.pair_arrays import pair_arrays  # here: as above
        from adjust.observations.pairs import PairBatch

        rows, a_slot, b_slot = self.simple
        measured = self.measured or pair_arrays(tuple(self.survey.pairs[i] for i in rows.tolist()))
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

    def _values(self, start: StartValues) -> gtsam.Values:
        values, missing = gtsam.Values(), []
        for name, unknown in self.unknowns.by_name.items():
            if unknown.kind == "pose" and name in start.poses:
                values.insert(j=unknown.key, pose3=start.poses[name])  # named: nothing else is tried
            elif unknown.kind == "point" and name[1] in start.points:
                values.insert(unknown.key, np.asarray(start.points[name[1]], dtype=float))
            elif unknown.kind == "vector":
                values.insert(unknown.key, self._start_vector(name, start))
            else:
                missing.append(" ".join(name))
        if missing:
            raise SurveyError("no start value for " + ", ".join(missing))
        return values

    @cached_property
    def _given(self) -> dict[ParameterName, FloatArray]:
        vectors = vector_parameters(self.survey).items()
        return {name: p.values for name, p in vectors if isinstance(p, VectorParameter)} | {
            ("table_angles", r.table_id, r.epoch_id): r.angles for r in reversed(self.survey.table_readings)
        }

    def _start_vector(self, name: ParameterName, start: StartValues) -> FloatArray:
        if name[0] == "table_angles":
            return np.array(start.vectors.get(name, self._given[name]), dtype=float)
        vector = self.unknowns.vectors[name]
        if name[0] == "lens":
            full = start.lenses[name[1]]
        else:
            given = self._given.get(name, np.zeros(len(vector.names)))
            full = start.vectors.get(name, self.vector_starts.get(name, given))
        return np.array([full[vector.names.index(x)] for x in vector.own], dtype=float)
