"""A survey without the unknowns that nothing in use observes any more, and without what only they would predict.

An observation that is not used is still predicted and tested, which needs every unknown in its chain. Where the last
observation in use of an unknown is gone (the only image of an epoch, every sight of a beacon, all images of a camera),
or fewer than three image points of an epoch's pose are left, the unknown would stand in the normal equations with
nothing to determine it: it goes, with the observations that hang on it. What an unused observation does not touch is
never dropped: a station that nobody has measured is an error of the survey, not a decision of its owner.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np

from adjust.frames.tree import FrameTree
from adjust.frames.unknowns import Link, Unknowns
from adjust.model.errors import listed
from adjust.model.observations import FrameRef, ImageBlock, PositionRef
from adjust.model.result import ParameterName
from adjust.model.rewriting import Fields
from adjust.model.survey import Survey
from adjust.observations.geometry.building import carrier_of
from adjust.statistics.outliers.undetermined_points import without_named_points

Item = TypeVar("Item")
Needs = frozenset[ParameterName]
_NOTHING: Needs = frozenset()
_OF_A_POSE = 3
"""Image points that a pose needs at least."""


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

    def of_frame(self, frame: FrameRef) -> Needs:
        """Of a frame in the world."""
        return self._of_chain(self._frames.world_from(frame))

    def of_position(self, ref: PositionRef | None) -> Needs:
        """Of a position in the world."""
        if ref is None:
            return _NOTHING
        if ref.frame is not None:
            return self.of_frame(ref.frame)
        return frozenset({("point", str(ref.point_id))}) if ref.point_id in self._points else _NOTHING

    def of_pair(self, a: FrameRef, b: FrameRef) -> Needs:
        """Of the motion between two frames."""
        return self._of_chain(self._frames.relative(a, b))

    def _of_block(self, block: ImageBlock) -> Needs:
        lens: Needs = frozenset({("lens", block.camera_id)}) if block.camera_id in self._lenses else _NOTHING
        return lens | self._of_chain(self._frames.of_image(block))

    def of_point(self, index: int) -> Needs:
        """Of a world point in an image."""
        point_id = self._point_ids[index]
        return frozenset({("point", point_id)}) if point_id in self._points else _NOTHING

    def others(self) -> dict[str, list[Needs]]:
        """Of every observation that is no image point, by field of the survey."""
        s, at = self.survey, self.of_position
        beams = {b.beam_id: b for b in s.beams}

        def every(refs: Iterable[PositionRef | None]) -> Needs:
            return _NOTHING.union(*(at(ref) for ref in refs))

        return {
            "table_readings": [frozenset({("table_angles", r.table_id, r.epoch_id)}) for r in s.table_readings],
            "pairs": [self.of_pair(p.a, p.b) for p in s.pairs],
            "distances": [every((d.a, d.b)) for d in s.distances],
            "coordinates": [every(c.positions) for c in s.coordinates],
            "coordinate_differences": [every((*d.at, *d.to)) for d in s.coordinate_differences],
            "readings": [
                every((r.at, r.to, r.second)) | ({("orientation", r.setup_id)} if r.kind == "direction" else _NOTHING)
                for r in s.readings
            ],
            "levels": [self.of_frame(x.frame) for x in s.levels],
            "alignments": [self.of_pair(x.a, x.b) for x in s.alignments],
            "laser_spots": [
                self.of_pair(carrier_of(beams, x), FrameRef("target", x.target_id, x.epoch_id)) for x in s.laser_spots
            ],
            "on_surfaces": [at(o.position) for o in s.on_surfaces],
        }

    def split(self) -> tuple[Needs, list[Needs]]:
        """All that observations in use need, and what each of the others needs."""
        used: set[ParameterName] = set()
        unused: list[Needs] = []
        others = self.others()
        few = self._seen_by_too_few(others)
        for block, needs in zip(self.survey.image_blocks, self.of_blocks, strict=True):
            taking = block.mask
            taking = taking & (not needs & few)
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
            n = block.n_used
            for name in (name for name in needs if _is_of_epoch(name)):
                points[name] = points.get(name, 0) + n
                if n < len(block.uv):
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

    def gone(*name: str) -> bool:
        return name in lost

    cameras = tuple(
        c for c in survey.cameras if not (gone("lens", c.camera_id) or gone("station_from_camera", c.camera_id))
    )
    targets = tuple(t for t in survey.targets if not gone("carrier_from_target", t.target_id))
    carrying = {c.station_id for c in cameras} | {t.station_id for t in targets}
    stations = tuple(
        s for s in survey.stations if s.station_id in carrying or not gone("world_from_station", s.station_id)
    )
    return replace(survey, cameras=cameras, targets=targets, stations=stations, datum=replace(
        survey.datum,
        points=tuple(p for p in survey.datum.points if not gone("point", p)),
        stations=tuple(s for s in survey.datum.stations if not gone("world_from_station", s)),
    ))  # fmt: skip


def lost_notes(lost: Iterable[ParameterName]) -> tuple[str, ...]:
    """One line that names what is gone, for people; none where nothing is."""
    names = [" ".join(name) for name in lost]
    if not names:
        return ()
    return (f"left out, because every observation of it is left out, or too many are: {listed(names, 12)}",)
