"""A survey with other parameters: the one walk over all of them, by their names.

And with other rows of one of its lists.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, TypeVar

from adjust.model.clocks import clocks_of
from adjust.model.result import ParameterName
from adjust.model.survey import (
    Camera,
    Clock,
    ImageCrop,
    LensParameter,
    PointParameter,
    PoseParameter,
    Station,
    Surface,
    Survey,
    Table,
    Target,
    VectorParameter,
)

Vector = TypeVar("Vector", LensParameter, VectorParameter)
Fields = dict[str, Any]
"""Fields of a value by their names, as ``dataclasses.replace`` takes them: of any type, for each field has its own."""


class Rewriting:
    """What becomes of every parameter; a method that is not written anew leaves all of its kind as they are."""

    def vector(self, name: ParameterName, given: Vector) -> Vector:
        """A lens, its crops, a clock, a table's geometry, a warp, what an instrument, beam or surface has, the tilt."""
        return given

    def pose(self, name: ParameterName, given: PoseParameter) -> PoseParameter:
        """A pose; that which holds for all epochs that are not listed goes without an epoch."""
        return given

    def epochs(
        self, name: ParameterName, given: Mapping[str, PoseParameter], usual: PoseParameter
    ) -> Mapping[str, PoseParameter]:
        """The poses that are listed by epoch; ``usual``: that of all others."""
        return {epoch: self.pose((*name, epoch), pose) for epoch, pose in given.items()}

    def point(self, name: ParameterName, given: PointParameter) -> PointParameter:
        """A point in the world."""
        return given

    def __call__(self, survey: Survey) -> Survey:
        """The survey rewritten: owner after owner, of each its vector first."""
        return replace(
            survey,
            cameras=tuple(map(self._camera, survey.cameras)),
            stations=tuple(map(self._station, survey.stations)),
            tables=tuple(map(self._table, survey.tables)),
            targets=tuple(map(self._target, survey.targets)),
            points=tuple(replace(p, x_in_world=self.point(("point", p.point_id), p.x_in_world)) for p in survey.points),
            instruments=tuple(
                replace(x, parameters=self.vector(("instrument", x.instrument_id), x.parameters))
                for x in survey.instruments
            ),
            beams=tuple(replace(x, parameters=self.vector(("beam", x.beam_id), x.parameters)) for x in survey.beams),
            surfaces=tuple(map(self._surface, survey.surfaces)),
            vertical=replace(survey.vertical, tilt=self.vector(("vertical",), survey.vertical.tilt)),
        )

    def _surface(self, s: Surface) -> Surface:
        name = ("surface", s.surface_id)
        return s if s.parameters is None else replace(s, parameters=self.vector(name, s.parameters))

    def _camera(self, c: Camera) -> Camera:
        lens = self.vector(("lens", c.camera_id), c.lens)
        if lens.crops:
            lens = replace(lens, crops={e: self._crop(("lens_crop", c.camera_id, e), x) for e, x in lens.crops.items()})
        pose = self.pose(("station_from_camera", c.camera_id), c.station_from_camera)
        clock = self._clock("camera_clock", c.camera_id, c.clock)
        return replace(c, lens=lens, station_from_camera=pose, clock=clock)

    def _crop(self, name: ParameterName, crop: ImageCrop) -> ImageCrop:
        return replace(crop, parameters=self.vector(name, crop.parameters))

    def _station(self, s: Station) -> Station:
        name = ("world_from_station", s.station_id)
        pose, mount = self.pose(name, s.world_from_station), ("mount_from_station", s.station_id)
        return replace(s, world_from_station=pose, mount_from_station=self.pose(mount, s.mount_from_station),
                       epochs=self.epochs(name, s.epochs, s.world_from_station),
                       clock=self._clock("pose_clock", s.station_id, s.clock))  # fmt: skip

    def _table(self, t: Table) -> Table:
        geometry = self.vector(("table_geometry", t.table_id), t.geometry)
        pose = self.pose(("world_from_table", t.table_id), t.world_from_table)
        clock = self._clock("table_clock", t.table_id, t.clock)
        return replace(t, geometry=geometry, world_from_table=pose, clock=clock)

    def _clock(self, kind: str, owner: str, clock: Clock | None) -> Clock | None:
        return None if clock is None else replace(clock, parameters=self.vector((kind, owner), clock.parameters))

    def _target(self, t: Target) -> Target:
        warp = None if t.warp is None else self.vector(("warp", t.target_id), t.warp)
        name = ("carrier_from_target", t.target_id)
        return replace(t, warp=warp, carrier_from_target=self.pose(name, t.carrier_from_target),
                       epochs=self.epochs(name, t.epochs, t.carrier_from_target))  # fmt: skip


def vector_parameters(survey: Survey) -> dict[ParameterName, LensParameter | VectorParameter]:
    """All that is named numbers, owner after owner; of a lens also its crops."""
    out: dict[ParameterName, LensParameter | VectorParameter]
    out = {("lens", c.camera_id): c.lens for c in survey.cameras}
    out |= {("lens_crop", c.camera_id, e): x.parameters for c in survey.cameras for e, x in c.lens.crops.items()}
    out |= {("table_geometry", t.table_id): t.geometry for t in survey.tables}
    out |= {("warp", t.target_id): t.warp for t in survey.targets if t.warp}
    out |= {("beam", b.beam_id): b.parameters for b in survey.beams}
    out |= {("surface", s.surface_id): s.parameters for s in survey.surfaces if s.parameters}
    out |= {("vertical",): survey.vertical.tilt} | {name: clock.parameters for name, clock in clocks_of(survey)}
    return out | {("instrument", i.instrument_id): i.parameters for i in survey.instruments}


def with_rows(survey: Survey, field: str, new: Mapping[int, object]) -> Survey:
    """The survey with others at these positions of one of its lists: "readings", "image_blocks", "targets" ..."""
    fields: Fields = {field: tuple(new.get(i, row) for i, row in enumerate(getattr(survey, field)))}
    return replace(survey, **fields)


def with_changed(survey: Survey, field: str, owner: str, **changes: object) -> Survey:
    """The survey with other values of one thing: of ``targets`` that whose ``target_id`` is ``owner``."""
    key = f"{field.removesuffix('s')}_id"
    rows = {i: replace(x, **changes) for i, x in enumerate(getattr(survey, field)) if getattr(x, key) == owner}
    return with_rows(survey, field, rows)
