"""The linear system of an :class:`~adjust.graph.assembly.AdjustmentGraph` at values, its elimination and its step."""

import gtsam
import numpy as np

from adjust.graph.assembly import AdjustmentGraph, Evaluation
from adjust.graph.cliques import Cliques, SolvedTree
from adjust.graph.datum import InnerDatum, inner_datum, normal_diagonal, stacking, survey_motions, visible_keys
from adjust.graph.elimination import Elimination
from adjust.graph.pair_normals import PairLinear, PairNormals
from adjust.graph.rank import describe_null_space
from adjust.graph.trial import tried
from adjust.model.errors import IndeterminateError, SurveyError
from adjust.model.survey import FloatArray
from adjust.native.elimination import PoseTree

_LATE = frozenset((
    "lens", "lens_drift", "lens_crop", "station_from_camera", "mount_from_station", "world_from_table",
    "table_geometry", "warp", "instrument", "vertical", "beam", "surface", "camera_clock", "table_clock", "pose_clock",
))  # fmt: skip
"""What many observations share is eliminated last."""


class System:
    """What a search steps by. at: everything evaluated at the present values; linear: the system there, with its datum.

    judging: whether what is undetermined is named, else it is only no solution. determined: it was judged before.
    covariances: whether they are wanted in the end. exact: as of ``PairNormals``. damping: of Marquardt. use_qr: rows
    are eliminated, not squares.
    """

    def __init__(
        self, graph: AdjustmentGraph, start: gtsam.Values, determined: bool, covariances: bool, exact: bool = True
    ) -> None:
        self.graph, self.determined, self.covariances = graph, determined, covariances
        self.damping, self.judging = 0.0, True
        self.reduced, self.use_qr = True, False
        self._orderings: dict[bool, gtsam.Ordering] = {}
        self.linear: gtsam.GaussianFactorGraph | PairLinear
        self._linear_at: gtsam.Values | None = None
        self._damping: Damping | None = None
        self._moved: tuple[gtsam.Values, InnerDatum, dict[int, FloatArray]] | None = None
        self.at = self._evaluated(start)
        self.omega = graph.objective(self.at)
        if not np.isfinite(self.omega) and graph.terrestrial is not None:
            graph.terrestrial.require_directions()
        self.datum = inner_datum(graph, self.at)
        self.pairs = PairNormals(graph, self._last_keys(), exact) if graph.only_pairs else None
        self._linearize()

    def _evaluated(self, values: gtsam.Values) -> Evaluation:
        """Everything at ``values``, ready to be linearised there. A reduction without inverse is given up for good."""
        at = self.graph.prepare(values, True, self.damping, self.reduced)
        self.reduced = at.reduction is not None
        return at

    def _linearize(self) -> None:
        """``linear``: the system at the present values, with the minimal datum where the survey has an inner one."""
        self.linear = self.graph.linearized(self.at) if self.pairs is None else self.pairs.linearized(self.at)
        if self.datum is not None:
            self.datum.add_to(self.linear)
        self._linear_at = self.at.values

    def completed(self, delta: gtsam.VectorValues) -> tuple[gtsam.VectorValues, float]:
        """The step of all unknowns in the survey's datum, from that of the visible ones in the minimal datum.

        Also by how much what was hidden lowers chi-square (to first order) beside what the visible step does.
        """
        decrease = 0.0
        if self.at.reduction is not None:
            decrease += self.at.reduction.complete(delta)
        for bundle in self.graph.bundles:
            bundle.complete(delta)
            decrease += bundle.hidden_decrease
        if self.datum is not None:
            delta = self.datum.completed(self.at.values, delta, self._motions(self.datum))
        return delta, decrease

    def _motions(self, datum: InnerDatum) -> dict[int, FloatArray]:
        """How all unknowns move with what the datum holds, from here; once for all dampings."""
        if self._moved is None or self._moved[0] is not self.at.values or self._moved[1] is not datum:
            if self.at.number != self.graph.state.evaluation:
                self.at = self._evaluated(self.at.values)
            self._moved = self.at.values, datum, survey_motions(self.graph, self.at.values, datum.directions)
        return self._moved[2]

    @property
    def elimination(self) -> Elimination:
        """How GTSAM eliminates the system as it is now."""
        reduced = self.at.reduction is not None
        if reduced not in self._orderings:
            system, last = self.graph.view(self.at.reduction), self._last_keys()
            self._orderings[reduced] = gtsam.Ordering.ColamdConstrainedLastNonlinearFactorGraph(system, last)
        return Elimination(self._orderings[reduced], self.use_qr)

    def step(self) -> tuple[gtsam.VectorValues, float]:
        """The (damped) step, and by how much it lowers chi-square to first order.

        Raises IndeterminateError where there is none, by name where that is judged.
        """
        if isinstance(self.linear, PairLinear):
            system = self.linear if self.damping == 0.0 else self.linear.damped(self.damping)
            found = self.linear.normals.solution(system)
        else:
            graph = self.linear if self.damping == 0.0 else self._damped(self.linear)
            found = self.elimination.solution(graph)
        if found is None:
            return self._weak_step()
        if not np.isfinite(found[0].norm()):
            raise SurveyError("the normal equations have no finite solution; check the sigmas and start values")
        return found

    def _damped(self, linear: gtsam.GaussianFactorGraph) -> gtsam.GaussianFactorGraph:
        if self._damping is None or self._damping.linear is not linear:
            self._damping = Damping(self.graph, linear)
        return self._damping.damped(self.damping)

    def _weak_step(self) -> tuple[gtsam.VectorValues, float]:
        """The step of a system that Cholesky finds indeterminate; raises where it is."""
        if self.use_qr or not self.judging:
            raise IndeterminateError("the normal equations have no solution here")
        if isinstance(self.linear, PairLinear):  # with GTSAM's factors what is weak is named, or solved by QR
            self.pairs = None
            self._linearize()
            return self.step()
        if self.at.reduction is not None:  # what is weak is judged, and named, with all unknowns in sight
            self.reduced = False
            self.at = self._evaluated(self.at.values)
            self._linearize()
            return self.step()
        self.use_qr = True  # where it is weak, but determined: GTSAM's Cholesky refuses pivots that QR still resolves
        if not self.determined and not self._seen():
            names = describe_null_space(self.graph, self.linear, self.at.values)
            if names is not None:
                raise names
        return self.step()

    def _seen(self) -> bool:
        """Whether the observations tell of the weakest motion of all for sure."""
        found = self._tree()
        if found is None or isinstance(self.linear, PairLinear):
            return False
        try:
            return tried(self.graph, self.linear, Cliques.of(found[0], self.graph.unknowns.dims)).seen
        except ZeroDivisionError:
            return False

    def _lost(self, eliminated: SolvedTree) -> float:
        """Share of its variance that the weakest motion of all has lost in the elimination."""
        if isinstance(self.linear, PairLinear):
            return self.linear.normals.lost(self.linear)
        return tried(self.graph, self.linear, eliminated.cliques).lost

    def _tree(self) -> tuple[gtsam.GaussianBayesTree | PoseTree, gtsam.VectorValues] | None:
        """The Bayes tree of the system as it is now, and its solution; None where the elimination finds none."""
        if isinstance(self.linear, PairLinear):
            self.linear.normals.kept &= not self.covariances
            return self.linear.normals.tree(self.linear)
        return self.elimination.tree(self.linear)

    def _last_keys(self) -> list[int]:
        by_key, all_keys = self.graph.unknowns.by_key, self.graph.keys(self.at.reduction)
        keys = [k for k in all_keys if k in by_key and by_key[k].name[0] in _LATE]
        if self.determined and self.graph.pairs is not None:
            # far stations eliminated last would have lost nearly all of their information by then
            keys += sorted(self.graph.pairs.next_to_held() | self._with_prior())
        keys += [k for k in (self.datum.minimal if self.datum is not None else ()) if k not in keys]
        return keys if len(keys) < len(all_keys) else []

    def _with_prior(self) -> set[int]:
        by_name = self.graph.unknowns.by_name
        return {by_name[item.ids].key for item in self.graph.singles if item.kind == "prior"}

    def _proposed(self) -> tuple[gtsam.VectorValues, float]:
        """The step of all unknowns from here, and by how much it lowers chi-square to first order, at least."""
        delta, decrease = self.step()
        delta, hidden = self.completed(delta)
        return delta, decrease + hidden

    def _images_behind(self) -> frozenset[tuple[str, str, str | None]]:
        """Images with a point behind their camera at the values that were prepared last."""
        return frozenset((b.camera_id, b.epoch_id, b.target_id) for b in self.graph.behind_camera())

    def _prepared_here(self) -> bool:
        """Linearise at the present values with the damping of now; False where that has no solution, which is none."""
        hidden = self.reduced or self.at.reduction is not None or bool(self.graph.bundles)
        if self.pairs is None and not hidden:  # the system is the same for every damping
            if self._linear_at is not self.at.values:
                self._linearize()
            return True
        try:
            self.at = self._evaluated(self.at.values)
        except IndeterminateError:
            if self.judging and self.damping == 0.0:
                raise
            return False
        self._linearize()
        return True


class Damping:
    """Marquardt's: every unknown of a linear system held with so many times its own diagonal."""

    def __init__(self, graph: AdjustmentGraph, linear: gtsam.GaussianFactorGraph) -> None:
        stack = stacking(graph, visible_keys(graph, linear))
        self.linear, diagonal = linear, np.maximum(normal_diagonal(linear, stack), 1e-12)
        parts = {key: diagonal[at] for key, at in stack.at.items()}
        one = {n: (gtsam.noiseModel.Unit.Create(n), np.zeros(n)) for n in {len(part) for part in parts.values()}}
        self.rows = [(key, part, *one[len(part)]) for key, part in parts.items()]

    def damped(self, damping: float) -> gtsam.GaussianFactorGraph:
        """The system with it."""
        out = gtsam.GaussianFactorGraph()
        out.push_back(self.linear)
        for key, diagonal, noise, zero in self.rows:
            out.add(key, np.diag(np.sqrt(damping * diagonal)), zero, noise)
        return out
