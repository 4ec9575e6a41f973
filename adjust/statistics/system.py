"""A solved survey as one linear system: the whitened row of every observation over every unknown, sparse.

The solver condenses image points and hides unknowns; what compares observations with each other (variance components,
influences, the search for outliers) needs them apart. Rows are linearised at the solution: ``e(x + dx) = e + A dx``.
"""

from functools import cached_property
from itertools import pairwise

import numpy as np
from scipy import sparse

from adjust.graph.assembly import AdjustmentGraph
from adjust.model.frozen import frozen
from adjust.model.result import Adjustment
from adjust.model.survey import BoolArray, FloatArray, IntArray
from adjust.native.parallel import side_by_side
from adjust.observations.factors import ObservationFactor
from adjust.observations.images.segments import ranges
from adjust.precision.precision import Precision, precision_of
from adjust.precision.s_transformation import without_datum_rows
from adjust.precision.stacked import AT_ONCE
from adjust.statistics.normal import PLAIN, Inverse, Normal
from adjust.statistics.rows import Columns, Entries, ItemRows, KeyColumns, MakeImageRows, points_apart, survey_rows


@frozen(eq=False)
class JointReadings:
    """Readings with a joint covariance. rows: (k,) of the system. W: (k, k), inv(cov) = W'W, that whitens them."""

    rows: IntArray
    W: FloatArray


@frozen(eq=False)
class LinearSystem:
    """All observations at the solution, image points first, then ``Adjustment.other_residuals``; M in all.

    A: (m, n) whitened. e: (m,) whitened predicted minus observed. ptr: (M + 1,) rows of an observation. used: (M,).
    group: (M,) into group_names. datum: (d, n) rows that decide on what the observations leave open; motions: (n, d')
    that these are. n_image: image points. joint: readings that are whitened together.
    """

    precision: Precision
    columns: Columns
    A: sparse.csr_matrix
    e: FloatArray
    ptr: IntArray
    used: BoolArray
    group: IntArray
    group_names: tuple[str, ...]
    datum: sparse.csr_matrix
    motions: FloatArray
    n_image: int
    joint: tuple[JointReadings, ...] = ()

    @cached_property
    def joint_of(self) -> dict[int, tuple[JointReadings, int]]:
        """By observation: the readings it is whitened with, and its place among them."""
        return {int(self.row_of[r]): (j, i) for j in self.joint for i, r in enumerate(j.rows)}

    def bias_column(self, observation: int, bias: FloatArray) -> tuple[IntArray, FloatArray]:
        """Right-hand side of the normal equations for a bias of one observation: summands and their places (k,).

        bias: (k,) whitened, or (1,) over the conditional sigma of a reading with a joint covariance.
        """
        rows: IntArray = np.arange(self.ptr[observation], self.ptr[observation + 1])
        if observation in self.joint_of:
            joint, i = self.joint_of[observation]
            rows, bias = joint.rows, joint.W[:, i] * (bias[0] / np.linalg.norm(joint.W[:, i]))
        lengths = self.A.indptr[rows + 1] - self.A.indptr[rows]
        places = ranges(self.A.indptr[rows], lengths)
        return self.A.indices[places], self.A.data[places] * np.repeat(bias, lengths)

    @cached_property
    def row_of(self) -> IntArray:
        """Observation (m,) of every row."""
        return np.repeat(np.arange(len(self.used)), np.diff(self.ptr))

    @cached_property
    def _stacked(self) -> IntArray:
        """Rows (n,) of the columns in a stacked vector of the precision's unknowns."""
        by_name, places = self.precision.unknowns.by_name, self.precision.stacked.places
        rows = [places[by_name[name].key].start + free for name, free in self.columns.free.items()]
        return np.concatenate(rows or [np.zeros(0, dtype=np.int64)])

    def times_covariance(self, right: FloatArray) -> FloatArray:
        """The covariance matrix of all unknowns, a priori, in the survey's datum, times (n,) or (n, k)."""
        if len(self.columns) <= PLAIN or self.structured is not None:
            out = self.normal.solve(right)
            if not self.motions.shape[1]:
                return out
            return without_datum_rows(out, self.motions, self.datum @ self.motions, right)
        columns = right.reshape(len(right), -1)
        parts = [columns[:, i : i + AT_ONCE] for i in range(0, columns.shape[1], AT_ONCE)]
        found = side_by_side(self.through_tree, parts)
        return np.asarray(found[0] if len(found) == 1 else np.concatenate(found, axis=1)).reshape(right.shape)

    def through_tree(self, right: FloatArray) -> FloatArray:
        """The same of some columns (n, k) in one go, as the sigmas are found: fast where many are wanted."""
        stacked = np.zeros((self.precision.stacked.n, right.shape[1]))
        stacked[self._stacked] = right
        return self.precision.stacked.times_in_datum(stacked)[self._stacked]

    def among(self, rows: sparse.csr_matrix) -> FloatArray:
        """``R Q R'`` (c, c) of sparse rows R (c, n) of the normal equations, or of what is observed: in any datum."""
        if len(self.columns) <= PLAIN:
            return np.asarray(rows @ self.normal.solve(rows.T.toarray()))
        return self.precision.stacked.among(self._in_stack(rows))

    def among_sums(self, rows: sparse.csr_matrix, q: int) -> FloatArray:
        """The same (J, q, q) of the sums of the J sets of q rows from each on, as of what changed since then."""
        if len(self.columns) <= PLAIN:
            sums = np.cumsum(rows.toarray().reshape(-1, q, rows.shape[1])[::-1], axis=0)[::-1]
            return self.normal.squares(sums)
        return self.precision.stacked.among_sums(self._in_stack(rows), q)

    def _in_stack(self, rows: sparse.csr_matrix) -> sparse.csr_array:
        """Rows (c, n) over a stacked vector of the precision's unknowns."""
        entries = rows.data, self._stacked[rows.indices], rows.indptr
        return sparse.csr_array(entries, (rows.shape[0], self.precision.stacked.n))

    def among_each(self, rows: sparse.csr_matrix, ptr: IntArray) -> list[FloatArray]:
        """The same of sets of rows, set i from ``ptr[i]`` on."""
        if len(self.columns) <= PLAIN or self.precision.hidden:
            return [self.among(rows[i:j]) for i, j in pairwise(ptr.tolist())]
        return self.precision.tree.each_among(self._in_stack(rows), ptr)

    def drawn(self, k: int) -> FloatArray:
        """Errors (n, k) of k solutions, drawn with the covariance in the survey's datum; always the same."""
        return self.precision.stacked.drawn(k)[self._stacked]

    @cached_property
    def normal(self) -> Normal:
        """The normal matrix of the used observations and the datum."""
        return self.normal_of(self.used[self.row_of].astype(float))

    @cached_property
    def structured(self) -> Inverse | None:
        """The inverse of :attr:`normal` as a sum, of surveys of many epochs before known targets; None of others."""
        return None if self.precision.hidden or not self.n_image else self.normal.structured

    @cached_property
    def covariance(self) -> FloatArray:
        """A priori covariance (n, n) of the unknowns in the survey's datum, of systems that are solved as a whole."""
        n = len(self.columns)
        return self.normal.covariance(self.datum) if n <= PLAIN else self.times_covariance(np.eye(n))

    def normal_of(self, weights: FloatArray) -> Normal:
        """The normal matrix with weights (m,) of the rows."""
        kept = weights > 0.0
        A = self.A if kept.all() else self.A[kept]
        weighted = A
        if (weights[kept] != 1.0).any():
            weighted = A.copy()
            weighted.data *= np.repeat(weights[kept], np.diff(A.indptr))
        N = (A.T @ weighted).tocsc()
        return Normal((N + self.datum.T @ self.datum).tocsc() if self.datum.shape[0] else N, self.motions)

    @cached_property
    def sigmas(self) -> FloatArray:
        """A priori sigmas (n,) of the unknowns, in the survey's datum."""
        out = np.zeros(len(self.columns))
        for k in {len(at) for at in self.columns.at.values()}:
            mine = np.array([at for at in self.columns.at.values() if len(at) == k])
            out[mine] = np.sqrt(np.diagonal(self.own_covariances(mine), axis1=1, axis2=2))
        return out

    def own_covariances(self, columns: IntArray) -> FloatArray:
        """A priori covariances (u, k, k) in the survey's datum of unknowns whose free components are columns (u, k)."""
        by_name, out = self.precision.graph.unknowns.by_name, np.empty((*columns.shape, columns.shape[1]))
        of_size: dict[int, list[int]] = {}
        names = [self.columns.names[first] for first in columns[:, 0].tolist()] if columns.size else []
        for i, name in enumerate(names):
            of_size.setdefault(by_name[name].dim, []).append(i)
        for dim, rows in of_size.items():
            found = self.precision.covs(np.array([by_name[names[i]].key for i in rows]), dim)
            if dim == columns.shape[1]:
                out[rows] = found
                continue
            for i, Q in zip(rows, found, strict=True):
                free = self.columns.free[names[i]]
                out[i] = Q[free[:, None], free]
        return out


def linear_system(adjustment: Adjustment) -> LinearSystem:
    """The system of an adjustment. Raises SurveyError for one without covariances."""
    return assembled(precision_of(adjustment), points_apart)


def assembled(precision: Precision, image_rows: MakeImageRows) -> LinearSystem:
    """The system of these image rows over n columns, and of all other observations."""
    graph = precision.graph
    graph.prepare_rows(precision.solved.values)

    def of_item(item: ObservationFactor) -> ItemRows:
        kept = precision.rows(item)
        return kept.keys, kept.A, kept.e

    rows = survey_rows(graph, precision.solved.values, image_rows, of_item)
    names = tuple(dict.fromkeys(rows.groups))
    number = {g: i for i, g in enumerate(names)}
    group = np.array([number[g] for g in rows.groups], dtype=np.int64)
    datum, motions = _datum(precision, len(rows.columns), rows.key_columns)
    joint = tuple(JointReadings(rows.n_before + at, W) for at, W in joint_readings(graph))
    return LinearSystem(precision, rows.columns, rows.A, rows.e, rows.ptr, rows.used, group, names, datum, motions,
                        rows.n_image, joint)  # fmt: skip


def joint_readings(graph: AdjustmentGraph) -> list[tuple[IntArray, FloatArray]]:
    """Readings that share a covariance, by their place in ``Survey.readings``, and what whitens them."""
    chunks = graph.terrestrial.layout.chunks if graph.terrestrial is not None else ()
    return [(c.rows, c.whitener) for c in chunks if c.whitener is not None]


def mixed_blocks(system: LinearSystem) -> list[tuple[IntArray, tuple[str, ...], FloatArray]]:
    """Joint readings of several groups: rows (k,) of the system, groups (k,), inverse of what whitens them (k, k)."""
    out = []
    for joint in system.joint:
        groups = tuple(system.group_names[g] for g in system.group[system.row_of[joint.rows]])
        if len(set(groups)) > 1:
            out.append((joint.rows, groups, np.asarray(np.linalg.inv(joint.W))))
    return out


def _datum(precision: Precision, n: int, key_columns: KeyColumns) -> tuple[sparse.csr_matrix, FloatArray]:
    datum, transformation = precision.solved.datum, precision.transformation
    if datum is None or transformation is None:
        return sparse.csr_matrix((0, n)), np.zeros((n, 0))
    entries, motions = Entries(), np.zeros((n, datum.defect))
    for key, rows in datum.rows.items():
        entries.add(np.arange(datum.defect), key_columns[key], rows / datum.sigma)
    for key, columns in key_columns.items():
        motions[columns[columns >= 0]] = transformation.motions[key][columns >= 0]
    return entries.matrix((datum.defect, n)), motions
