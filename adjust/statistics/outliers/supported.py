"""A survey without the unknowns that nothing in use observes any more, and without what only they would predict.

An observation that is not used is still predicted and tested, which needs every unknown in its chain. Where the last
observation in use of an unknown is gone (the only image of an epoch, every sight of a beacon, all images of a camera),
or fewer than three image points of an epoch's pose are left, the unknown would stand in the normal equations with
nothing to determine it: it goes, with the observations that hang on it. What an unused observation does not touch is
never dropped: a station that nobody has measured is an error of the survey, not a decision of its owner. Points left
without rays only once gross errors are out are dropped with a note, instead of stopping everything.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np

from adjust.frames.tree import FrameTree
from adjust.frames.unknowns import Link, Unknowns
from adjust.model.errors import IndeterminateError, listed
from adjust.model.observations import (
    Alignment,
    FrameRef,
    ImageBlock,
    LaserSpot,
    Level,
    Observation,
    Pair,
    PositionRef,
    Reading,
    TableReading,
)
from adjust.model.result import Adjustment, ParameterName
from adjust.model.rewriting import Fields
from adjust.model.subsets import positions_of, with_points
from adjust.model.survey import Survey
from adjust.observations.geometry.building import carrier_of

Item = TypeVar("Item")
Needs = frozenset[ParameterName]
_NOTHING: Needs = frozenset()
_OF_A_POSE = 3
"""Image points that a pose needs at least."""
_MOST = 50
"""Points that may be lost."""


def supported(survey: Survey) -> tuple[Survey, tuple[ParameterName, ...]]:
    """The survey without unknowns that only unused observations touch, and their names, in the order of the survey.

    Names are those of ``Adjustment.estimates``. The same survey and no
    names where every observation is used. Raises SurveyError for frames and points that do not exist.
    """
    if _all_used(survey):
        return survey, ()
    needs = _Needs(survey)
    used, unused = needs.split()
    lost = tuple(dict.fromkeys(name for each in unused for name in sorted(each - used)))
    return (_without(survey, needs, frozenset(lost)), lost) if lost else (survey, ())


def _all_used(survey: Survey) -> bool:
    images = all(b.used is None or b.used.all() for b in survey.image_blocks)
    return images and all(o.used for kind in survey.others.values() for o in kind)


class _Needs:
    """Which unknowns observations touch: those that are free, so that nothing but observations determines them."""

    def __init__(self, survey: Survey) -> None:
        self.survey = survey
        self._unknowns = Unknowns()
        self._frames = FrameTree(survey, self._unknowns)
        self._points = {p.point_id for p in survey.points if p.x_in_world.treatment == "free"}
        self._point_ids = [p.point_id for p in survey.points]
        self._lenses = {c.camera_id for c in survey.cameras if c.lens.free and c.lens.prior is None}
        self._beams = {b.beam_id: b for b in survey.beams}
        self._of_slot: dict[int, Needs] = {}
        self._names: list[ParameterName] = []
        self.of_blocks = [self._of_block(b) for b in survey.image_blocks]

    def _of_chain(self, chain: Sequence[Link]) -> Needs:
        for link in chain:
            if link.slot not in self._of_slot:
                self._of_slot[link.slot] = self._slot(link.slot)
        return frozenset().union(*(self._of_slot[link.slot] for link in chain)) if chain else _NOTHING

    def _slot(self, slot: int) -> Needs:
        table = self._unknowns.table_slots.get(slot)
        if table is not None:
            return frozenset({("table_angles", table.table_id, table.epoch_id)})
        if slot >= len(self._names):
            self._names = list(self._unknowns.slot_of)  # slots are numbered as they come
        name = self._names[slot]
        parameter = self._unknowns.parameters[name]
        return frozenset({name}) if parameter.treatment == "free" else _NOTHING

    def _of_block(self, block: ImageBlock) -> Needs:
        lens: Needs = frozenset({("lens", block.camera_id)}) if block.camera_id in self._lenses else _NOTHING
        return lens | self._of_chain(self._frames.of_image(block))

    def of_point(self, index: int) -> Needs:
        """Of a world point in an image."""
        return self._of_point(self._point_ids[index])

    def _of_point(self, point_id: str | None) -> Needs:
        return frozenset({("point", str(point_id))}) if point_id in self._points else _NOTHING

    def others(self) -> dict[str, list[Needs]]:
        """Of every observation that is no image point, by field of the survey."""
        return {field: [self._of_other(o) for o in of] for field, of in self.survey.others.items()}

    def _of_other(self, o: Observation) -> Needs:
        match o:
            case TableReading():
                return frozenset({("table_angles", o.table_id, o.epoch_id)})
            case Pair() | Alignment():
                return self._of_chain(self._frames.relative(o.a, o.b))
            case Level():
                return self._of_chain(self._frames.world_from(o.frame))
            case LaserSpot():
                target = FrameRef("target", o.target_id, o.epoch_id)
                return self._of_chain(self._frames.relative(carrier_of(self._beams, o), target))
            case Reading(kind="direction"):
                return frozenset({("orientation", o.setup_id)}).union(*map(self._of_position, positions_of(o)))
        return _NOTHING.union(*map(self._of_position, positions_of(o)))

    def _of_position(self, ref: PositionRef) -> Needs:
        if ref.frame is not None:
            return self._of_chain(self._frames.world_from(ref.frame))
        return self._of_point(ref.point_id)

    def split(self) -> tuple[Needs, list[Needs]]:
        """All that observations in use need, and what each of the others needs."""
        used: set[ParameterName] = set()
        unused: list[Needs] = []
        others = self.others()
        few = self._seen_by_too_few(others)
        for block, needs in zip(self.survey.image_blocks, self.of_blocks, strict=True):
            taking = block.mask & (not needs & few)
            if taking.any():
                used |= needs
            if not taking.all():
                unused.append(needs)
            if block.target_id is None:
                for index in np.unique(block.point_idx[taking]).tolist():
                    used |= self.of_point(index)
                unused += [self.of_point(index) for index in np.unique(block.point_idx[~taking]).tolist()]
        for name, all_needs in others.items():
            for item, needs in zip(self.survey.others[name], all_needs, strict=True):
                if item.used:
                    used |= needs
                else:
                    unused.append(needs)
        return frozenset(used), unused

    def _seen_by_too_few(self, others: dict[str, list[Needs]]) -> Needs:
        """Poses of an epoch of which people left less than a pose needs, all images of it together, and no reading."""
        points: dict[ParameterName, int] = {}
        reduced: set[ParameterName] = set()
        for block, needs in zip(self.survey.image_blocks, self.of_blocks, strict=True):
            for name in (name for name in needs if _is_of_epoch(name)):
                points[name] = points.get(name, 0) + block.n_used
                if block.n_used < len(block.uv):
                    reduced.add(name)
        few = {n for n in reduced if 0 < points[n] < _OF_A_POSE and not self._unknowns.parameters[n].held}
        for kind, all_needs in others.items() if few else ():
            for item, needs in zip(self.survey.others[kind], all_needs, strict=True):
                few -= needs if item.used else _NOTHING
        return frozenset(few)


def _is_of_epoch(name: ParameterName) -> bool:
    return len(name) == 3 and name[0] in ("world_from_station", "carrier_from_target")


def _without(survey: Survey, needs: _Needs, lost: Needs) -> Survey:
    """Less the lost unknowns and the (unused) observations that need them."""

    def left(items: Iterable[Item], of_each: Iterable[Needs]) -> tuple[Item, ...]:
        return tuple(item for item, mine in zip(items, of_each, strict=True) if not mine & lost)

    others: Fields = {name: left(survey.others[name], of_each) for name, of_each in needs.others().items()}
    kept = replace(survey, image_blocks=left(survey.image_blocks, needs.of_blocks), **others)
    points = {name[1] for name in lost if name[0] == "point"}
    kept = without_named_points(kept, points) if points else kept
    names = {r.reading_id for r in kept.readings}
    joint = tuple(c for c in kept.reading_covariances if names.issuperset(c.reading_ids))
    return _without_owners(replace(kept, reading_covariances=joint), lost)


def _without_owners(survey: Survey, lost: Needs) -> Survey:
    """Less cameras, targets and fixed stations that are not known any more."""
    cameras = tuple(c for c in survey.cameras
                    if not {("lens", c.camera_id), ("station_from_camera", c.camera_id)} & lost)  # fmt: skip
    targets = tuple(t for t in survey.targets if ("carrier_from_target", t.target_id) not in lost)
    carrying = {c.station_id for c in cameras} | {t.station_id for t in targets}
    stations = tuple(
        s for s in survey.stations if s.station_id in carrying or ("world_from_station", s.station_id) not in lost
    )
    datum = replace(
        survey.datum,
        points=tuple(p for p in survey.datum.points if ("point", p) not in lost),
        stations=tuple(s for s in survey.datum.stations if ("world_from_station", s) not in lost),
    )
    return replace(survey, cameras=cameras, targets=targets, stations=stations, datum=datum)


def lost_notes(lost: Iterable[ParameterName]) -> tuple[str, ...]:
    """One line that names what is gone, for people; none where nothing is."""
    names = [" ".join(name) for name in lost]
    if not names:
        return ()
    return (f"left out, because every observation of it is left out, or too many are: {listed(names, 12)}",)


def without_lost_points(survey: Survey, run: Callable[[Survey], Adjustment]) -> Adjustment:
    """``run(survey)``; a point that it leaves undetermined is taken out with its image points, and it is run again.

    A spot that two cameras saw and one of them mistook leaves nothing of its point. Such points are named in the
    warnings. Raises what ``run`` raises for other reasons, and when nothing but lost points is found.
    """
    lost: list[str] = []
    while True:
        try:
            result = run(survey)
        except IndeterminateError as error:
            names = [p.removeprefix("point ") for p in error.parameters if p.startswith("point ")]
            if not names or len(names) != len(error.parameters) or len(lost) >= _MOST or not _spare(survey, set(names)):
                raise
            lost += names
            survey = without_named_points(survey, set(names))
            continue
        if not lost:
            return result
        note = f"left out, because gross errors leave no intersection: point{'s' * (len(lost) > 1)} {', '.join(lost)}"
        return replace(result, warnings=(*result.warnings, note))


def _spare(survey: Survey, names: set[str]) -> bool:
    """Whether these are points seen by two images or more (else they never had an intersection), and not all."""
    blocks = [b.point_idx for b in survey.image_blocks if b.target_id is None]
    counts = np.bincount(np.concatenate([*blocks, np.zeros(0, dtype=np.int64)]), minlength=len(survey.points))
    mine = [i for i, p in enumerate(survey.points) if p.point_id in names]
    return len(mine) == len(names) and bool(np.all(counts[mine] >= 2)) and len(survey.points) > 10 * len(names)


def without_named_points(survey: Survey, names: set[str]) -> Survey:
    """The survey without these world points, and all that was observed of them."""
    return with_points(survey, [i for i, p in enumerate(survey.points) if p.point_id not in names])
