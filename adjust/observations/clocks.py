"""Where things are between the epochs: bodies and tables at the time of a clock, from the epochs around.

They follow from the epoch itself and the ``_AROUND`` epochs nearest to it (:mod:`adjust.observations.between_epochs`).
All of these are unknowns of the one graph, so what a late camera sees tells of several epochs at once. Epochs far apart
are another run (:mod:`adjust.frames.runs`).
"""

from collections.abc import Iterable, Sequence

import numpy as np

from adjust.frames.runs import MOVING, runs
from adjust.frames.unknowns import Chain, Link, ShiftedSlot, Unknowns, VectorMap, vector_map
from adjust.model.clocks import CLOCK, EpochTimes, clocks_of, epoch_times
from adjust.model.errors import SurveyError
from adjust.model.observations import ImageBlock, Pair, TableReading
from adjust.model.result import ParameterName
from adjust.model.survey import Survey

_AROUND = 4


def collect_clocks(survey: Survey, unknowns: Unknowns) -> EpochTimes | None:
    """Register all clocks; the times of the epochs, None where there is no clock."""
    found = list(clocks_of(survey))
    if not found:
        return None
    times = epoch_times(survey)
    for name, clock in found:
        units = tuple(CLOCK[x] if CLOCK[x] == "1" else times.unit for x in clock.parameters.names)
        unknowns.vectors[name] = vector_map(clock.parameters, units, unknowns, name)
    return times


class Shifts:
    """Chains at the times of clocks. Made when the slots of all epochs are known."""

    def __init__(self, survey: Survey, unknowns: Unknowns, times: EpochTimes) -> None:
        self.unknowns, self.times = unknowns, times
        self.middle_row = {c.camera_id: 0.5 * (c.image_size[1] - 1) for c in survey.cameras}
        self._around = dict(self._neighbours())
        self._made: dict[tuple[int, ParameterName, float], int] = {}
        self._jitter = {name: clock.jitter for name, clock in clocks_of(survey) if clock.jitter > 0.0}
        self.jitters: dict[ParameterName, float] = {}
        """Sigmas of the single epochs' own times."""

    def _neighbours(self) -> Iterable[tuple[int, list[int]]]:
        """Of every slot of an epoch itself, and the slots of the same body at the epochs around."""
        series: dict[ParameterName, list[tuple[float, int]]] = {}
        self._epoch: dict[int, tuple[ParameterName, float]] = {}
        self._epoch_ids: dict[int, str] = {}
        for name, slot in self.unknowns.slot_of.items():
            if name[0] in MOVING and len(name) == 3 and name[2] in self.times.of:
                body, time = name[:2], self.times.of[name[2]]
                series.setdefault(body, []).append((time, slot))
                self._epoch[slot], self._epoch_ids[slot] = (body, time), name[2]
        for found in series.values():
            found.sort()
            slots = [slot for _, slot in found]
            for run in runs([t for t, _ in found], self._epoch[slots[0]][0]):
                for i in run:
                    yield slots[i], [slots[i], *(slots[j] for j in _near(run, i) if j != i)]

    def of_image(self, block: ImageBlock, chain: Chain) -> list[tuple[ImageBlock, Chain]]:
        """Parts of an image block that were exposed at one moment each, in its order, and their chains."""
        name = ("camera_clock", block.camera_id)
        whole = self.shifted(chain, name)
        vector = self.unknowns.vectors.get(name)
        if whole == chain or vector is None or "line_time" not in vector.names:
            return [(block, whole)]
        if block.target_id is None:
            raise SurveyError(f"camera {block.camera_id!r}: its rows are read one after the other, which is modelled "
                              "for points of targets alone; take line_time out of its clock")  # fmt: skip
        rows = np.split(np.arange(len(block.uv)), np.flatnonzero(np.diff(block.uv[:, 1])) + 1)
        late = [float(block.uv[r[0], 1]) - self.middle_row[block.camera_id] for r in rows if len(r)]
        return [(block.part(r), self.shifted(chain, name, t)) for r, t in zip(rows, late, strict=True)]

    def shifted(self, chain: Chain, clock: ParameterName, row: float = 0.0) -> Chain:
        """A chain at the time of a clock; itself where there is no such clock."""
        vector = self.unknowns.vectors.get(clock)
        if vector is None:
            return chain
        return tuple(Link(self._slot(x.slot, clock, vector, row), x.inverse) if x.slot in self._around else x
                     for x in chain)  # fmt: skip

    def of_pair(self, pair: Pair, chain: Chain) -> Chain:
        """The chain of a pair as it is when the pose of the station that it moves with was measured."""
        moving = [("pose_clock", f.frame_id) for f in (pair.a, pair.b) if f.kind == "station" and f.epoch_id]
        known = [clock for clock in moving if clock in self.unknowns.vectors]
        return self.shifted(chain, (known or moving or [("pose_clock", "")])[0])

    def reading(self, reading: TableReading) -> ShiftedSlot | None:
        """The motion of a table when its angles were read; None where that is the epoch's time, or nothing sees it."""
        slot = self.unknowns.slot_of.get(("table_motion", reading.table_id, reading.epoch_id))
        if slot is None:
            return None
        (link,) = self.shifted((Link(slot),), ("table_clock", reading.table_id))
        return self.unknowns.shifted_slots.get(link.slot)

    def _slot(self, slot: int, clock: ParameterName, vector: VectorMap, row: float) -> int:
        place = slot, clock, row
        if place in self._made:
            return self._made[place]
        u, nodes, (_, time) = self.unknowns, tuple(self._around[slot]), self._epoch[slot]
        times = tuple(self._epoch[n][1] - time for n in nodes[1:])
        by = {"offset": 1.0, "drift": time - self.times.middle, "line_time": row}
        clocks = [(vector, np.array([by[x] for x in vector.names]))]
        if clock in self._jitter:
            clocks.append((self._own_time(clock, nodes[0]), np.ones(1)))
        made = self._made[place] = len(u.slot_key)
        u.slot_key.append(None)
        u.slot_pose.append(u.slot_pose[slot])
        u.slot_identity.append(False)
        u.shifted_slots[made] = ShiftedSlot(made, nodes, times, tuple(clocks), _parts(u, nodes, [c for c, _ in clocks]))
        return made

    def _own_time(self, clock: ParameterName, slot: int) -> VectorMap:
        """The deviation of a clock at the epoch of a slot."""
        u, name = self.unknowns, (*clock, self._epoch_ids[slot])
        if name not in u.vectors:
            self.jitters[name] = self._jitter[clock]
            key = u.add(name, "vector", ("jitter",), (self.times.unit,)).key
            one = np.eye(1)
            u.vectors[name] = VectorMap(("jitter",), (self.times.unit,), np.zeros(1), one, key, ("jitter",), ("prior",))
        return u.vectors[name]


def _near(run: range, i: int) -> range:
    """The epochs of a run from which it is known how things move about the i-th."""
    first = min(max(run.start, i - _AROUND // 2), max(run.start, run.stop - 1 - _AROUND))
    return range(first, min(run.stop, first + _AROUND + 1))


def nearest(times: Sequence[float], time: float) -> list[float]:
    """Of the times of a body's epochs those from which it is known how it moves about one of them, that one first."""
    order = sorted(times)
    i = order.index(time)
    run = next(r for r in runs(order, ("epochs",)) if i in r)
    return [time, *(order[j] for j in _near(run, i) if j != i)]


def _parts(u: Unknowns, nodes: Sequence[int], clocks: Sequence[VectorMap]) -> list[tuple[int, int, int]]:
    """Where the derivatives of a shifted slot stand: by the pose or angles of every node, geometry, clocks."""
    tables, parts, at = [u.table_slots[n] for n in nodes if n in u.table_slots], [], 0
    for node in nodes:
        table = u.table_slots.get(node)
        key, n = (u.slot_key[node], 6) if table is None else (table.angles_key, len(table.axes))
        parts += [] if key is None else [(key, at, n)]
        at += n
    if tables:
        parts += tables[0].parts[1:] and [(tables[0].parts[1][0], at, tables[0].parts[1][2])]
        at += len(tables[0].geometry.free)
    for clock in clocks:
        parts += [] if clock.key is None else [(clock.key, at, len(clock.free))]
        at += len(clock.free)
    return parts
