"""Whether cameras and targets stayed the same through a session, and targets are as given: score tests, no adjustment.

A parameter that the model does not have, with the whitened columns B, is tested at the solution (Lagrange multiplier or
score test; Rao 1948, Silvey 1959; in geodesy the test of an additional parameter, Teunissen 2006): with
``g = B' e`` and ``M = B' (I - A Q A') B`` the statistic ``g' M^+ g`` is chi-square with rank M degrees of freedom, and
``-M^+ g`` estimates it. A change is looked for at every border between two epochs, or between as many runs of them as
can be paid for; each that is found is added to the model before the next is looked for.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from scipy import sparse

from adjust.frames.unknowns import POSE_COMPONENTS, POSE_UNITS
from adjust.model.frozen import frozen
from adjust.model.names import natural_key
from adjust.model.result import Adjustment
from adjust.model.survey import FloatArray, IntArray
from adjust.native.parallel import side_by_side
from adjust.native.point_tests import ColumnsOfRows, SparseRows, change_squares
from adjust.precision.precision import noise_of
from adjust.statistics.condensed import CondensedSystem
from adjust.statistics.result import Change, ChangeShift
from adjust.statistics.system import LinearSystem
from adjust.testing.distributions import chi2, fisher
from adjust.testing.quadratic_forms import explaining, many_pseudo_squares, normal_score

_SEEN = 1e-4
"""Share of a column that no unknown takes over, below which it is not told from rounding."""
_MOST_RUNS, _MOST_COLUMNS = 256, 12_000
"""Of a system without structure, where every column of a run goes through the tree."""
_MOST, _MOST_OF_ONE = 20, 2
"""Changes that are named: in all, and of the same kind of one camera, target or table, which may drift without end."""
_SHAPES = {True: (("width", "1"), ("height", "1"), ("sag along x", "m"), ("sag along y", "m")),
           False: (("width", "1"), ("height", "1"), ("depth", "1"), ("", "1"))}  # fmt: skip


@frozen(eq=False)
class Unit:
    """What may change: kind and name of its owner, columns B (k, q) in rows (k,) of the condensed system.

    run: (k,) of which run of epochs a row is; epochs: the first epoch of every run; one run: the same at all epochs.
    """

    kind: str
    name: str
    what: str
    columns: ColumnsOfRows
    run: IntArray
    epochs: tuple[str, ...]
    components: tuple[tuple[str, str], ...]

    @property
    def rows(self) -> IntArray:
        """(k,)."""
        return self.columns.rows

    @property
    def B(self) -> FloatArray:
        """(k, q)."""
        return np.asarray(self.columns.table[self.columns.at[:, None] + np.arange(len(self.components))])

    def at(self, which: IntArray) -> "Unit":
        """Of its rows some, in this order."""
        rows, at, table = self.columns
        return replace(self, columns=ColumnsOfRows(rows[which], at[which], table), run=self.run[which])


@frozen(eq=False)
class _Candidates:
    """A unit's possible changes (J, ...), scaled so that B'B has a unit diagonal: M (J, q, q), g (J, q), scale (J, q).

    A change has what its run and all later ones have.
    """

    unit: Unit
    M: FloatArray
    g: FloatArray
    scale: FloatArray


@frozen(eq=False)
class _Chosen:
    """What was found, less what was found before it: B (m, q) over all rows, and left = (I - A Q A') B.

    inverse: (q, q) of its M; amounts: (q,) that times its g.
    """

    B: FloatArray
    left: FloatArray
    inverse: FloatArray
    amounts: FloatArray


class ChangeSearch:
    """Score tests of a survey's cameras, targets and tables."""

    def __init__(self, adjustment: Adjustment, condensed: CondensedSystem) -> None:
        self.adjustment, self.condensed = adjustment, condensed
        self.system: LinearSystem = condensed.system
        s = self.system
        rows = s.used[s.row_of]
        step = s.times_covariance(np.asarray(s.A.T @ np.where(rows, s.e, 0.0)))
        self.A, self.e = s.A, s.e - s.A @ step
        self.epoch, self.epochs = _coded([b.epoch_id for b in adjustment.survey.image_blocks])
        self.owners = list(self._owners())
        read = {r.epoch_id for r in adjustment.survey.table_readings}
        self.runs = _MOST_RUNS if s.structured is None else max(2, len(self.epochs), len(read))
        units = list(self._units(self.runs))
        columns = sum(len(u.components) * len(u.epochs) for u in units)
        if s.structured is not None:
            self.rows, self.own = (SparseRows(x.indptr.astype(np.int64), x.indices.astype(np.int64), x.data)
                                   for x in (self.A, s.structured.own))  # fmt: skip
            self.shared = np.zeros((len(s.columns), -(-len(s.structured.U) // 8) * 8))  # whole vectors
            self.shared[:, : len(s.structured.U)] = s.structured.U.T
        elif columns > _MOST_COLUMNS:
            self.runs = max(self.runs * _MOST_COLUMNS // columns, 2)
            units = list(self._units(self.runs))
        self.n_tests = sum(max(len(u.epochs) - 1, 1) for u in units)
        open_ = [u for u in units if not self._taken_over(u)]
        self.candidates = side_by_side(lambda u: self._candidates(_by_runs(u)), open_)

    def left_out(self) -> tuple[str, ...]:
        """For people: between which epochs no change was looked for."""
        longest = max((len(np.unique(self._epochs_of(rows))) for _, _, rows in self.owners), default=0)
        if longest <= self.runs:
            return ()
        return (f"changes of cameras and targets were looked for at {self.runs - 1} of {longest - 1} borders between "
                "epochs, evenly spread; a change elsewhere is found at the next of them",)  # fmt: skip

    def found(self, level: float, relative: bool) -> tuple[Change, ...]:
        """Changes significant at this level of one test, the clearest first, each given those before."""
        out: list[Change] = []
        chosen: list[_Chosen] = []
        candidates = self.candidates  # M and g are given what was found, step by step
        omega, left = self.adjustment.omega, self.adjustment.redundancy
        while len(out) < _MOST:
            named = Counter((x.kind, x.name, x.what) for x in out)
            best = _clearest([c for c in candidates if named[c.unit.kind, c.unit.name, c.unit.what] < _MOST_OF_ONE])
            if best is None:
                break
            c, j, T, q = best
            p, spread = float(chi2.sf(T, max(q, 1))), 1.0
            if relative and left > q and omega > T:
                spread = (omega - T) / (left - q)
                p = max(p, float(fisher.sf(T / q / spread, q, left - q)))
            if not p < level:
                break
            u, shifts = c.unit, _shifts(c, j, T, max(spread, 1.0))
            out.append(Change(u.kind, u.name, u.what, u.epochs[j + 1] if len(u.epochs) > 1 else "", T, q, p, shifts))
            chosen.append(self._chosen(c, j, chosen))
            candidates = [_given(x, chosen[-1]) for x in candidates]
            omega, left = omega - T, left - q
        return tuple(out)

    # -- what may change ---------------------------------------------------------------------------------------------

    def _owners(self) -> Iterator[tuple[str, str, IntArray]]:
        """Cameras and targets with their rows."""
        blocks, of_row = self.adjustment.survey.image_blocks, self.condensed.block
        for kind in ("camera", "target"):
            names = [b.camera_id if kind == "camera" else b.target_id or "" for b in blocks]
            number = {name: i for i, name in enumerate(dict.fromkeys(names))}
            of_rows = np.array([number[name] for name in names], dtype=np.int64)[of_row]
            for name, i in number.items():
                if name and len(rows := np.flatnonzero(of_rows == i)):
                    yield kind, name, rows

    def _epochs_of(self, rows: IntArray) -> IntArray:
        """Of every image row."""
        return np.asarray(self.epoch[self.condensed.block[rows]])

    def _units(self, most_runs: int) -> Iterator[Unit]:
        c, survey = self.condensed, self.adjustment.survey
        vectors = self.system.precision.graph.unknowns.vectors
        poses = tuple(zip(POSE_COMPONENTS, POSE_UNITS, strict=True))
        whole = {t.target_id: t.x_in_target for t in survey.targets}
        for kind, name, rows in self.owners:
            run, first = _runs(self._epochs_of(rows), self.epochs, most_runs)
            if kind == "camera":
                lens = vectors[("lens", name)]
                free = tuple((x, lens.units[lens.names.index(x)]) for x in lens.free) if lens.key is not None else ()
                if free and len(first) > 1:
                    yield Unit(kind, name, "lens", _columns(rows, c.own.lens), run, first, free)
            if len(first) > 1:
                B = c.own.camera if kind == "camera" else c.own.target
                yield Unit(kind, name, "position", _columns(rows, B), run, first, poses)
            if kind == "target":
                flat = bool(np.ptp(whole[name][:, 2]) < 1e-9)
                once = np.zeros_like(run), first[:1]
                yield Unit(kind, name, "shape", _columns(rows, c.own.shape), *once, _SHAPES[flat])
        yield from self._table_units(most_runs)

    def _table_units(self, most_runs: int) -> Iterator[Unit]:
        """Readings of tables: their zeros from some epoch on, and errors that repeat with the turn of an axis.

        The latter are those of an eccentric circle (once a turn) and of an inclined or oval one (twice); each axis.
        """
        s, others = self.system, self.system.precision.graph.others
        for table in self.adjustment.survey.tables:
            mine = [i for i, o in enumerate(others) if o.kind == "table" and o.ids[0] == table.table_id and o.used]
            if not mine:
                continue
            W = [np.asarray(noise_of(others[i]).R()) for i in mine]
            rows = np.concatenate([np.arange(s.ptr[s.n_image + i], s.ptr[s.n_image + i + 1]) for i in mine])
            epochs = [others[i].ids[1] for i, w in zip(mine, W, strict=True) for _ in range(len(w))]
            run, first = _runs(*_coded(epochs), most_runs)
            axes, apart = tuple(others[mine[0]].components), np.arange(len(rows))
            if len(first) > 1:
                zeros = tuple((x, "rad") for x in axes)
                yield Unit("table", table.table_id, "zero", _columns(rows, np.vstack(W), apart), run, first, zeros)
            for axis, name in enumerate(axes):
                angle = np.array([others[i].observed[axis] for i in mine])
                waves = np.stack([f(k * angle) for k in (1, 2) for f in (np.sin, np.cos)], axis=1)
                B = np.concatenate([w[:, axis, None] * wave for w, wave in zip(W, waves, strict=True)])
                said = tuple((f"{name} {f} {k}a".replace(" 1a", " a"), "rad") for k in (1, 2) for f in ("sin", "cos"))
                once = np.zeros_like(run), first[:1], said
                yield Unit("table", table.table_id, f"reading of {name}", _columns(rows, B, apart), *once)

    def _taken_over(self, u: Unit) -> bool:
        """Whether unknowns take over all of it: it is a test like the others, and finds nothing."""
        c = self.condensed
        return u.what == "position" and c.has_own_poses(u.kind, u.name, np.unique(c.block[u.rows]))

    # -- tests -------------------------------------------------------------------------------------------------------

    def _candidates(self, u: Unit) -> _Candidates:
        """Of the runs from j on, j = 1, 2, ..., or of the only one."""
        which = slice(1 if len(u.epochs) > 1 else 0, None)
        squares, M, g = (x[which] for x in (self._whole if self.system.structured is None else self._structured)(u))
        scale = np.divide(1.0, np.sqrt(squares), out=np.zeros_like(squares), where=squares > 0.0)
        M = M * scale[:, :, None] * scale[:, None, :]
        return _Candidates(u, 0.5 * (M + M.transpose(0, 2, 1)), g * scale, scale)

    def _structured(self, u: Unit) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Of every run and all later ones the diagonal of B'B (J, q), M (J, q, q) and g (J, q)."""
        return change_squares(_first(u), u.columns, len(u.components), self.rows, self.e, self.own, self.shared)

    def _whole(self, u: Unit) -> tuple[FloatArray, FloatArray, FloatArray]:
        """The same of a system without structure."""
        B, J, q = u.B, len(u.epochs), len(u.components)
        some = B.any(axis=1)
        places = ((u.run[some] * q)[:, None] + np.arange(q)).ravel(), np.repeat(u.rows[some], q)
        turned = sparse.csr_matrix((B[some].ravel(), places), (J * q, self.A.shape[0]))
        both = np.cumsum(_by_run(u, B, np.column_stack([B, self.e[u.rows]]))[::-1], axis=0)[::-1]
        taken = self.system.among_sums(turned @ self.A, q)
        return np.einsum("jqq->jq", both[:, :, :q]), both[:, :, :q] - taken, both[:, :, q]

    def _chosen(self, c: _Candidates, j: int, before: Sequence[_Chosen]) -> _Chosen:
        """Its directions that show, less what they have in common with those before."""
        u, B = c.unit, np.zeros((len(self.e), len(c.unit.components)))
        mine = u.run >= (j + 1 if len(u.epochs) > 1 else 0)
        B[u.rows[mine]] = u.B[mine] * c.scale[j]
        left = B - self.A @ self.system.times_covariance(np.asarray(self.A.T @ B))
        shares = [x.inverse @ (x.B.T @ left) for x in before]
        for x, share in zip(before, shares, strict=True):
            B, left = B - x.B @ share, left - x.left @ share
        values, vectors = np.linalg.eigh(next(x.M[j] for x in self.candidates if x.unit is u))
        V = vectors[:, values > _SEEN]
        inverse = np.linalg.pinv(V.T @ c.M[j] @ V, rcond=1e-12, hermitian=True)
        return _Chosen(B @ V, left @ V, inverse, inverse @ (V.T @ c.g[j]))


def _columns(rows: IntArray, B: FloatArray, at: IntArray | None = None) -> ColumnsOfRows:
    """Columns that rows (k,) of the system have in those rows of B, or in others (k,)."""
    return ColumnsOfRows(rows, (rows if at is None else at) * B.shape[1], B.ravel())


def _by_runs(u: Unit) -> Unit:
    """With its rows in the order of the runs."""
    return u if (u.run[1:] >= u.run[:-1]).all() else u.at(np.argsort(u.run, kind="stable"))


def _coded(epochs: Sequence[str]) -> tuple[IntArray, tuple[str, ...]]:
    """Number (k,) of every epoch among the different ones, and these in natural order."""
    names = tuple(sorted(set(epochs), key=natural_key))
    number = {e: i for i, e in enumerate(names)}
    return np.array([number[e] for e in epochs], dtype=np.int64), names


def _runs(epochs: IntArray, names: Sequence[str], most: int) -> tuple[IntArray, tuple[str, ...]]:
    """Number (k,) of the run of epochs that each belongs to, at most so many, and the first epoch of every run."""
    seen = np.bincount(epochs, minlength=len(names)) > 0
    there, place = np.flatnonzero(seen), np.cumsum(seen)[epochs] - 1
    n = min(most, len(there))
    number = np.arange(len(there)) * n // max(len(there), 1)
    first = there[np.searchsorted(number, np.arange(n))]
    return number[place], tuple(names[i] for i in first.tolist())


def _first(u: Unit) -> IntArray:
    """First of the rows of every run (J + 1,)."""
    return np.searchsorted(u.run, np.arange(len(u.epochs) + 1))


def _by_run(u: Unit, B: FloatArray, other: FloatArray) -> FloatArray:
    """B' times other columns (k, r), of every run apart: (J, q, r)."""
    return np.array([B[i:j].T @ other[i:j] for i, j in pairwise(_first(u).tolist())])


def _from_runs_on(of_runs: FloatArray) -> FloatArray:
    """Of what runs have (J, ...) the sums from the second, the third, ... on (J - 1, ...); of one run what it has."""
    return np.asarray(np.cumsum(of_runs[::-1], axis=0)[::-1][1 if len(of_runs) > 1 else 0 :])


def _given(c: _Candidates, known: _Chosen) -> _Candidates:
    """Candidates with M and g where one more change is part of the model."""
    K = _from_runs_on(_by_run(c.unit, c.unit.B, known.left[c.unit.rows])) * c.scale[:, :, None]
    M = c.M - K @ known.inverse @ K.transpose(0, 2, 1)
    return replace(c, M=0.5 * (M + M.transpose(0, 2, 1)), g=c.g - K @ known.amounts)


def _clearest(candidates: Sequence[_Candidates]) -> tuple[_Candidates, int, float, int] | None:
    """Whose change is the least likely, which of its changes, its statistic and degrees of freedom."""
    best, most = None, -np.inf
    for c in candidates:
        T, q = many_pseudo_squares(c.g, c.M, _SEEN)
        z = np.where(q > 0, normal_score(T, np.maximum(q, 1)), -np.inf)
        j = int(z.argmax()) if len(z) else -1
        if j >= 0 and z[j] > most:
            best, most = (c, j, float(T[j]), int(q[j])), float(z[j])
    return best


def _shifts(c: _Candidates, j: int, T: float, spread: float) -> tuple[ChangeShift, ...]:
    """The components that explain it, with variances ``spread`` times the a priori ones."""
    M, g = c.M[j], c.g[j]
    index = explaining(M, g, T, spread, _SEEN)
    inverse = np.linalg.pinv(M[np.ix_(index, index)], rcond=1e-9, hermitian=True)
    amount, sigma = -inverse @ g[index] * c.scale[j, index], np.sqrt(spread * np.diag(inverse)) * c.scale[j, index]
    order = np.argsort(-np.abs(amount) / np.maximum(sigma, 1e-300), kind="stable")
    said = [c.unit.components[i] for i in index]
    return tuple(ChangeShift(said[i][0], said[i][1], float(amount[i]), float(sigma[i])) for i in order)
