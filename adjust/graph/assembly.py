"""The one graph of a survey as GTSAM has it, what it is evaluated to, and values to begin with."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import field, replace
from functools import cached_property
from typing import TYPE_CHECKING, TypeVar

import gtsam
import numpy as np
from gtsam import Pose3

from adjust.frames.state import State
from adjust.frames.unknowns import Unknowns
from adjust.model.clocks import CLOCKS
from adjust.model.frozen import frozen
from adjust.model.observations import ImageBlock, Pair
from adjust.model.result import Estimated, ParameterName
from adjust.model.rewriting import vector_parameters
from adjust.model.survey import BoolArray, FloatArray, IntArray, Survey, VectorParameter
from adjust.observations.factors import ObservationFactor
from adjust.observations.images.batch import ImageBatch
from adjust.observations.images.bundle_points import add_point_factors
from adjust.observations.images.bundles import BundleBatch
from adjust.observations.images.reduction import PoseReduction
from adjust.observations.terrestrial.batch import TerrestrialBatch

if TYPE_CHECKING:
    from adjust.observations.pairs import PairBatch

_Rows = TypeVar("_Rows", FloatArray, BoolArray)
_T = TypeVar("_T")


@frozen(eq=False)
class StartValues:
    """Where the adjustment begins: full lens vectors, poses by parameter name, world points, table angles, vectors."""

    lenses: Mapping[str, FloatArray]
    poses: Mapping[ParameterName, Pose3]
    points: Mapping[str, FloatArray]
    vectors: Mapping[ParameterName, FloatArray] = field(default_factory=dict)


def values_of(adjustment: Estimated, survey: Survey | None = None) -> StartValues:
    """Adjusted values as start values; for another survey, whose tables, boards, clocks may have other components."""
    estimates = adjustment.estimates
    poses = {n: e.value for n, e in estimates.items() if isinstance(e.value, Pose3)}
    arrays = {n: np.asarray(e.value) for n, e in estimates.items() if not isinstance(e.value, Pose3)}
    return StartValues(
        {n[1]: v for n, v in arrays.items() if n[0] == "lens"},
        poses,
        {n[1]: v for n, v in arrays.items() if n[0] == "point"},
        {n: v for n, v in arrays.items() if n[0] not in ("lens", "point")} | _by_component(adjustment, survey),
    )


def _by_component(adjustment: Estimated, survey: Survey | None) -> dict[ParameterName, FloatArray]:
    """Of tables, boards, clocks, in the order of their components in the survey: adjusted, else as given."""
    if survey is None:
        return {}
    out: dict[ParameterName, FloatArray] = {}
    for name, owner in vector_parameters(survey).items():
        listed = name in adjustment.estimates and name[0] in ("table_geometry", "warp", *CLOCKS)
        if listed and isinstance(owner, VectorParameter):
            estimate = adjustment.estimates[name]
            known = dict(zip(estimate.components, np.asarray(estimate.value).tolist(), strict=True))
            given = zip(owner.names, owner.values.tolist(), strict=True)
            out[name] = np.array([known[n] if n in known and n in owner.free else v for n, v in given])
    return out


@frozen(eq=False)
class Evaluation:
    """A graph evaluated at ``values``, with ``damping`` of what is reduced there.

    reduction: of the poses that only image points touch; None where nothing is reduced. number: as long as it is that
    of the graph's state, what the batches have computed is this evaluation.
    """

    values: gtsam.Values
    damping: float
    reduction: PoseReduction | None
    number: int


@frozen(eq=False)
class AdjustmentGraph:
    """The graph, its start and the batches that serve it. Held together with the survey only by the solver.

    ``graph`` has every observation as a factor on its unknowns and nothing else; the solver
    takes a ``view`` of it, in which points and poses that nothing else touches are reduced.
    bundles: image blocks of unknown points, in parts that are reduced each by itself. image_numbers: of every block in
    ``images`` the number in the survey of that which it is, or a part of. image_parts: of every image block of the
    survey 0 where it is in ``images``, i in the bundle before the i-th.
    reduction: of the poses that only image points touch; None where it would not pay. pairs: those between two fixed
    stations, ``others[first_pair + pairs.rows[e]]`` the e-th; singles: the others that are in no batch.
    """

    survey: Survey
    unknowns: Unknowns
    state: State
    start: gtsam.Values
    images: ImageBatch
    bundles: tuple[BundleBatch, ...]
    image_numbers: IntArray
    image_parts: IntArray
    singles: list[ObservationFactor]
    singles_graph: gtsam.NonlinearFactorGraph
    terrestrial: TerrestrialBatch | None = None
    reduction: PoseReduction | None = None
    pairs: "PairBatch | None" = None
    first_pair: int = 0

    @property
    def n_others(self) -> int:
        """How many ``others`` there are; makes none."""
        return len(self.singles) + (0 if self.pairs is None else len(self.pairs))

    @cached_property
    def others(self) -> list[ObservationFactor]:
        """Every observation that is neither an image point nor a reading, in the order of the survey."""
        return [self.other(i) for i in range(self.n_others)]

    def other(self, i: int) -> ObservationFactor:
        """One of :attr:`others`, always the same; makes no other one."""
        place, batch = self._place[i], self.pairs
        if batch is None or place >= 0:
            return self.singles[place]
        if i not in self._made:
            self._made[i] = batch.item(~place, self.survey.pairs)
        return self._made[i]

    def of_others(self, of: Callable[[ObservationFactor], _T], of_pair: Callable[[Pair], _T]) -> list[_T]:
        """What is asked of each of :attr:`others`; makes none of the pairs in batches, which are asked themselves."""
        rows = [] if self.pairs is None else self.pairs.rows.tolist()
        pairs = self.survey.pairs
        return [of(self.singles[p]) if p >= 0 else of_pair(pairs[rows[~p]]) for p in self._place]

    @cached_property
    def _made(self) -> dict[int, ObservationFactor]:
        return {}

    @cached_property
    def _place(self) -> list[int]:
        """Of each of :attr:`others` its number among the singles, or as ``~e`` in the batch of pairs."""
        place = np.zeros(self.n_others, dtype=np.int64)
        if self.pairs is not None:
            place[self.first_pair + self.pairs.rows] = ~np.arange(len(self.pairs))
        place[place == 0] = np.arange(len(self.singles))
        return place.tolist()

    @cached_property
    def single(self) -> list[int]:
        """Which of :attr:`others` are in no batch, by number, in the order of :attr:`singles`."""
        return [i for i, p in enumerate(self._place) if p >= 0]

    @cached_property
    def others_graph(self) -> gtsam.NonlinearFactorGraph:
        """The factors of :attr:`others` that take part, and what holds single components."""
        if self.pairs is None:
            return self.singles_graph
        graph = gtsam.NonlinearFactorGraph(self.singles_graph)
        self.pairs.add_factors(graph)
        return graph

    @cached_property
    def only_pairs(self) -> bool:
        """Whether nothing but pairs between fixed stations is observed, and whole poses (priors) beside them."""
        if self.pairs is None or self.survey.image_blocks or self.terrestrial is not None or self.unknowns.held:
            return False
        alone = [item.factor.keys() for item in self.singles if item.used and item.factor.size()]
        if any(len(keys) > 1 for keys in alone) or any(u.kind != "pose" for u in self.unknowns.by_key.values()):
            return False
        return self.pairs.seen() | {keys[0] for keys in alone} == set(self.unknowns.by_key)

    def keys(self, reduction: PoseReduction | None) -> list[int]:
        """The unknowns of :meth:`view`, in ascending order."""
        return sorted(self.unknowns.by_key) if self.only_pairs else list(self.view(reduction).keyVector())

    @cached_property
    def graph(self) -> gtsam.NonlinearFactorGraph:
        """All factors on all unknowns, right at any values and in any of GTSAM's algorithms."""
        if not self.bundles:
            return self._unreduced
        graph = self._factors(None)
        for bundle in self.bundles:
            add_point_factors(bundle, graph)
        return graph

    @cached_property
    def _reduced(self) -> gtsam.NonlinearFactorGraph:
        graph = self._with_bundles(self.reduction)
        if self.reduction is not None:
            self.reduction.add_factor(graph)
        return graph

    @cached_property
    def _unreduced(self) -> gtsam.NonlinearFactorGraph:
        return self._with_bundles(None)

    def _with_bundles(self, reduction: PoseReduction | None) -> gtsam.NonlinearFactorGraph:
        graph = self._factors(reduction)
        for bundle in self.bundles:
            bundle.add_factor(graph)
        return graph

    def view(self, reduction: PoseReduction | None) -> gtsam.NonlinearFactorGraph:
        """What the solver linearises: of the chi-square of ``graph``, with what is reduced eliminated already.

        reduction: :attr:`reduction`, or None for all poses in sight; :attr:`bundles` are reduced in any case.
        """
        return self._unreduced if reduction is None else self._reduced

    @cached_property
    def _on_unknowns(self) -> gtsam.NonlinearFactorGraph:
        """``others_graph`` without observations of what is held: they are constant, and on no unknown to eliminate."""
        if all(item.factor.size() for item in self.singles):
            return self.others_graph
        graph = gtsam.NonlinearFactorGraph()
        for i in range(self.others_graph.size()):
            if self.others_graph.at(i).size():
                graph.push_back(self.others_graph.at(i))
        return graph

    def _factors(self, reduction: PoseReduction | None) -> gtsam.NonlinearFactorGraph:
        """All factors but those of a bundle, and of the image blocks that ``reduction`` takes."""
        graph = gtsam.NonlinearFactorGraph(self._on_unknowns)
        self.images.add_factors(graph, None if reduction is None else reduction.others)
        if self.terrestrial is not None:
            self.terrestrial.add_factors(graph)
        return graph

    def prepare(
        self, values: gtsam.Values, jacobians: bool, damping: float = 0.0, reduced: bool = True
    ) -> Evaluation:  # fmt: skip
        """Evaluate all batches at ``values``, which nobody may change while the evaluation is used.

        reduced: with :attr:`reduction`; where that finds no inverse, all is in sight.
        """
        self.state.load(values)
        self.images.prepare(jacobians)
        reduction = self._reduced_here(damping) if reduced and jacobians else None
        if jacobians:
            self.images.serve(None if reduction is None else reduction.others)
        if self.terrestrial is not None:
            self.terrestrial.prepare(values, jacobians)
        for bundle in self.bundles:
            bundle.prepare(values, jacobians, damping)
        return Evaluation(values, damping, reduction, self.state.evaluation)

    def prepare_rows(self, values: gtsam.Values) -> None:
        """The same for the rows of single observations alone: no normal equations of image blocks, no reduction."""
        self.state.load(values)
        self.images.chains.evaluate(self.state)
        if self.terrestrial is not None:
            self.terrestrial.prepare(values, True)
        for bundle in self.bundles:
            bundle.prepare(values, False)

    def _reduced_here(self, damping: float) -> PoseReduction | None:
        return self.reduction if self.reduction is not None and self.reduction.reduce(damping) else None

    def linearized(self, at: Evaluation) -> gtsam.GaussianFactorGraph:
        """The solver's system, linearised with what was evaluated, once more where something else was in between."""
        if at.number != self.state.evaluation:
            at = self.prepare(at.values, True, at.damping, at.reduction is not None)
        with self.state.serving():
            return self.view(at.reduction).linearize(at.values)

    def objective(self, at: Evaluation) -> float:
        """Weighted square sum v'Pv of the last evaluation."""
        images = float(self.images.chi.sum()) + sum(bundle.chi_square for bundle in self.bundles)
        readings = self.terrestrial.chi_square if self.terrestrial is not None else 0.0
        if self.only_pairs and self.pairs is not None:
            return float(np.sum(self.pairs.rows_here()[0] ** 2)) + 2.0 * float(self.singles_graph.error(at.values))
        with self.state.serving():
            return images + readings + 2.0 * float(self.others_graph.error(at.values))

    def omega(self, values: gtsam.Values) -> float:
        """Weighted square sum v'Pv at ``values``."""
        return self.objective(self.prepare(values, jacobians=False))

    def with_sigmas_at(self, values: gtsam.Values) -> tuple["AdjustmentGraph", float]:
        """The graph with sigmas of readings that follow the distances at ``values``; their largest relative change."""
        if self.terrestrial is None:
            return self, 0.0
        readings, change = self.terrestrial.with_sigmas_at(values)
        return (self if readings is self.terrestrial else replace(self, terrestrial=readings)), change

    @cached_property
    def image_rows(self) -> IntArray:
        """Where the image points (N,), in the order of the survey's blocks, stand in those of all parts one by one."""
        ptr = self.survey.image_points.ptr
        lengths, order = np.diff(ptr), np.argsort(self.image_parts, kind="stable")
        first = np.empty(len(order), dtype=np.int64)
        first[order] = np.cumsum(lengths[order]) - lengths[order]
        return np.asarray(np.arange(ptr[-1]) + np.repeat(first - ptr[:-1], lengths))

    def joined(self, of_images: _Rows, of_bundles: Sequence[_Rows]) -> _Rows:
        """Rows (N, ...) of all image points in the order of ``Survey.image_blocks``, from those of every part."""
        return np.concatenate([of_images, *of_bundles])[self.image_rows] if self.bundles else of_images

    def used(self) -> BoolArray:
        """Which image points (N,) take part, in the order of ``Survey.image_blocks``."""
        return self.joined(self.images.used, [b.unsorted(b.used) for b in self.bundles])

    def square_roots(self) -> FloatArray:
        """Square root information (N, 3) of the image points: w00, w01, w11, as ``Survey.image_blocks`` are ordered."""
        return self.joined(self.images.W_all, [b.unsorted(b.W_all) for b in self.bundles])

    def set_weights(self, weights: FloatArray) -> None:
        """Weights (N,) of the image points, on top of their covariance; zero leaves a point out."""
        sizes, by_part = [self.images.n_points, *(len(b.uv) for b in self.bundles)], weights
        if self.bundles:
            by_part = np.empty_like(weights)
            by_part[self.image_rows] = weights
        known, *unknown = np.split(by_part, np.cumsum(sizes)[:-1])
        self.images.set_weights(known)
        for bundle, part in zip(self.bundles, unknown, strict=True):
            bundle.set_weights(part)

    def whitened_squares(self, values: gtsam.Values) -> FloatArray:
        """Weighted squares v' inv(Q_ll) v (N,) of all image points at ``values``, whatever their weight."""
        self.prepare(values, jacobians=False)
        return self.joined(self.images.whitened_squares(), [b.whitened_squares() for b in self.bundles])

    def behind_camera(self) -> list[ImageBlock]:
        """Blocks with a point behind their camera at the prepared values."""
        found = [self.images.blocks[b] for b in np.flatnonzero(self.images.depth <= 0.0).tolist()]
        for bundle in self.bundles:
            found += [b for b, z in zip(bundle.blocks, bundle.depth, strict=True) if z <= 0.0]
        if not found:
            return found
        fisheye = {c.camera_id for c in self.survey.cameras if c.lens.model == "fisheye"}
        return [b for b in found if b.camera_id not in fisheye]
