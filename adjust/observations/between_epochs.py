"""Bodies and tables at times between epochs, with derivatives by the epochs around and by the clocks that say when.

With Lagrange's weights w over the times of the epoch e and those around it a body is at

    T(dt) = T_e Exp(sum_k w_k(dt) Log(T_e^-1 T_k)),    d T / d T_k = w_k Jr(xi) Jr^-1(L_k)

a time dt after e, and a table at angles ``sum_k w_k(dt) a_k``.
"""

from collections.abc import Callable, Sequence
from functools import cached_property

import gtsam
import numpy as np

from adjust.frames.state import State
from adjust.frames.unknowns import ShiftedSlot, Unknowns
from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray, IntArray
from adjust.spatial.rigid import rigid
from adjust.spatial.rigid_motions import Motions, exp, right_jacobian, right_jacobian_inverse

Reading = Callable[[gtsam.Values], tuple[FloatArray, list[tuple[int, FloatArray]]]]


def between(poses: Sequence[FloatArray], times: Sequence[float], dt: float) -> FloatArray:
    """(4, 4) a time dt after the first of the times, from poses (4, 4) at all of them."""
    w, by_dt = weights(np.array([times]) - times[0], np.array([dt]))
    every = np.array(poses)
    motions = Motions(every[:, :3, :3], every[:, :3, 3])
    only = np.zeros(1, dtype=np.int64)
    R, t, _ = moved_poses(motions[:1], motions[1:], only, Interpolated(w, by_dt, np.zeros((1, 0))))
    return rigid(R[0], t[0])


def weights(times: FloatArray, dt: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Lagrange's weights (s, n) at dt (s,) over times (s, n) that differ, and their derivatives by dt."""
    w, by = np.ones(times.shape), np.zeros(times.shape)
    for j in range(times.shape[1]):
        f, g = (dt - times[:, j])[:, None], times - times[:, j : j + 1]
        g[:, j], own = 1.0, np.arange(times.shape[1]) == j
        factor = np.where(own, 1.0, f / g)
        by = by * factor + np.where(own, 0.0, w / g)
        w *= factor
    return w, by


@frozen(eq=False)
class Interpolated:
    """Of s slots with n nodes each the weights (s, n) and by_dt (s, n) at their times, and how clocks move these.

    by_clock: (s, c) derivatives of the times by free components of the clocks, which are equally many.
    """

    w: FloatArray
    by_dt: FloatArray
    by_clock: FloatArray


class Alike:
    """Shifted slots of bodies, or of one table, with equally many nodes and free components of their clocks."""

    def __init__(self, unknowns: Unknowns, slots: Sequence[ShiftedSlot]) -> None:
        self.slot = np.array([s.slot for s in slots], dtype=np.int64)
        self.tables = [unknowns.table_slots[n] for n in slots[0].nodes if n in unknowns.table_slots]
        self._times, self._by_clock = np.array([(0.0, *s.times) for s in slots]), np.array([s.by_clocks for s in slots])
        self._clocks = list(dict.fromkeys(clock for s in slots for clock, _ in s.clocks))
        first = dict(zip(self._clocks, np.cumsum([0, *(len(c.names) for c in self._clocks)]).tolist(), strict=False))
        terms = [(first[clock] + i, rate) for s in slots for clock, rates in s.clocks for i, rate in enumerate(rates)]
        self._component, self._rate = np.array([i for i, _ in terms]), np.array([rate for _, rate in terms])
        self._term = np.cumsum([0, *(sum(len(rates) for _, rates in s.clocks) for s in slots)])[:-1]
        around = {nodes: k for k, nodes in enumerate(dict.fromkeys(s.nodes for s in slots))}
        self.nodes, self.epoch = np.array(list(around), dtype=np.int64), np.array([around[s.nodes] for s in slots])
        if self.tables:
            self._angles = [[unknowns.table_slots[n].angles_key for n in nodes] for nodes in around]

    def at(self, values: gtsam.Values) -> Interpolated:
        """At the times that the clocks tell."""
        full = np.concatenate([clock.full(values) for clock in self._clocks])
        late = np.add.reduceat(self._rate * full[self._component], self._term)
        return Interpolated(*weights(self._times, late), self._by_clock)

    def angles(self, values: gtsam.Values) -> FloatArray:
        """(s, n, k) of a table at all nodes."""
        return np.asarray(np.array([[values.atVector(key) for key in keys] for keys in self._angles])[self.epoch])


def alike(unknowns: Unknowns, slots: Sequence[ShiftedSlot]) -> list[Alike]:
    """All slots, those together that are so."""
    found: dict[tuple[str, int, int], list[ShiftedSlot]] = {}
    for s in slots:
        table = unknowns.table_slots.get(s.nodes[0])
        place = "" if table is None else table.table_id, len(s.nodes), len(s.by_clocks)
        found.setdefault(place, []).append(s)
    return [Alike(unknowns, of) for of in found.values()]


def moved_poses(
    own: Motions, others: Motions, epoch: IntArray, at: Interpolated
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """R (s, 3, 3), t (s, 3) between poses of e epochs and others (e (n - 1)) around; each about one epoch, (s,).

    Then their derivatives (s, 6, 6 n + c) by all of these and the clocks.
    """
    s, n = at.w.shape
    first = Motions(np.repeat(own.rotation, n - 1, axis=0), np.repeat(own.shifts, n - 1, axis=0))
    logs = (first.inverse() @ others).log()
    inverse, L = right_jacobian_inverse(logs), logs.reshape(-1, n - 1, 6)[epoch]
    back = (inverse @ exp(-logs).adjoint()).reshape(-1, n - 1, 36)[epoch]
    xi = (at.w[:, None, 1:] @ L)[:, 0]
    right, w = right_jacobian(xi), np.repeat(at.w[:, 1:], 6, axis=1)[:, None]
    by_others = right @ (w * np.swapaxes(inverse.reshape(-1, n - 1, 6, 6), 1, 2).reshape(-1, 6, 6 * n - 6)[epoch])
    by_own = exp(-xi).adjoint() - right @ (at.w[:, None, 1:] @ back).reshape(s, 6, 6)
    speed = right @ np.swapaxes(at.by_dt[:, None, 1:] @ L, 1, 2)
    moved = own[epoch] @ exp(xi)
    D = np.concatenate([by_own, by_others, speed * at.by_clock[:, None, :]], axis=2)
    return moved.rotation, moved.shifts, D


class Shifting:
    """Fills poses of slots at the times of clocks, and their derivatives; what they follow from is in the state."""

    def __init__(self, unknowns: Unknowns) -> None:
        self.unknowns = unknowns

    @cached_property
    def _every(self) -> list[Alike]:
        return alike(self.unknowns, list(self.unknowns.shifted_slots.values()))

    def __call__(self, state: State, values: gtsam.Values, slots: Sequence[ShiftedSlot] | None) -> None:
        """Of these slots, or of all."""
        for of in self._every if slots is None else alike(self.unknowns, slots):
            if of.tables:
                R, t, D = _between_readings(state, values, of)
            else:
                own, others = of.nodes[:, 0], of.nodes[:, 1:].ravel()
                first, rest = (Motions(state.slot_R[x], state.slot_t[x]) for x in (own, others))
                R, t, D = moved_poses(first, rest, of.epoch, of.at(values))
            state.slot_R[of.slot], state.slot_t[of.slot] = R, t
            state.D[state.derived_index[of.slot], :, : D.shape[2]] = D


def _between_readings(state: State, values: gtsam.Values, of: Alike) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Of slots of one table R, t, and derivatives by the angles of all nodes, free geometry and clocks."""
    at, angles = of.at(values), of.angles(values)
    R, t, D = state.of_table(values, of.tables[0], np.einsum("sk,ska->sa", at.w, angles))
    k = angles.shape[2]
    by_nodes = np.einsum("sk,sia->sika", at.w, D[:, :, :k]).reshape(len(angles), 6, -1)
    speed = D[:, :, :k] @ np.einsum("sk,ska->sa", at.by_dt, angles)[..., None]
    return R, t, np.concatenate([by_nodes, D[:, :, k:], speed * at.by_clock[:, None, :]], axis=2)


def reading_residual(slot: ShiftedSlot, unknowns: Unknowns, observed: FloatArray) -> tuple[list[int], Reading]:
    """Keys, and angles (k,) of a table at the time of its clock minus those read, with derivatives by these keys."""
    nodes, of = [unknowns.table_slots[n].angles_key for n in slot.nodes], Alike(unknowns, [slot])
    clocks = [(clock.key, rates @ clock.matrix) for clock, rates in slot.clocks if clock.key is not None]

    def residual(values: gtsam.Values) -> tuple[FloatArray, list[tuple[int, FloatArray]]]:
        at, (angles,) = of.at(values), of.angles(values)
        by = [(key, w * np.eye(len(observed))) for key, w in zip(nodes, at.w[0], strict=True)]
        return at.w[0] @ angles - observed, by + [(key, np.outer(at.by_dt[0] @ angles, r)) for key, r in clocks]

    return nodes + [key for key, _ in clocks], residual
