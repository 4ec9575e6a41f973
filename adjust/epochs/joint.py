"""Several epochs adjusted together: one survey in which stable points are shared, and all others are one per epoch."""

from collections.abc import Collection, Mapping
from dataclasses import replace

from adjust.model.errors import SurveyError
from adjust.model.observations import (
    CoordinateDifferences,
    Coordinates,
    Distance,
    PositionRef,
    Reading,
    ReadingCovariance,
)
from adjust.model.rewriting import Fields
from adjust.model.subsets import Item, with_positions
from adjust.model.survey import Datum, Instrument, Point, Setup, Survey

_PARTS = ("cameras", "stations", "tables", "targets", "image_blocks", "table_readings", "pairs", "levels", "alignments",
          "laser_spots", "on_surfaces", "surfaces", "beams")  # fmt: skip
_JOINED = ("distances", "coordinates", "coordinate_differences", "setups", "readings", "reading_covariances")
_Joined = Distance | Coordinates | CoordinateDifferences | Setup | Reading | ReadingCovariance
_IDS = ("distance_id", "reading_id")


def epoch_name(name: str, epoch: str) -> str:
    """A point, setup or reading of one epoch in the joint survey."""
    return f"{name}@{epoch}"


def joint_survey(epochs: Mapping[str, Survey], stable: Collection[str]) -> Survey:
    """One survey of point networks at several epochs. stable: points that are the same in all epochs that have them.

    Other points become one per epoch, named ``point@epoch``, and so do setups and ids of observations; instruments
    with the same id are shared. The datum is inner over the stable points where any epoch's is. Raises SurveyError for
    surveys with cameras, tables or stations (their poses have epochs of their own), and for unknown stable points.
    """
    if len(epochs) < 2:
        raise SurveyError("a joint adjustment of epochs needs two surveys or more")
    known = {p.point_id for s in epochs.values() for p in s.points}
    lost = [p for p in stable if p not in known]
    if lost:
        raise SurveyError(f"stable point {lost[0]!r} is in none of the epochs")
    for epoch, survey in epochs.items():
        other = [part for part in _PARTS if getattr(survey, part)]
        if other:
            raise SurveyError(
                f"epoch {epoch}: {other[0]} cannot be joined by renaming points; give their poses one per epoch in one "
                "project instead"
            )
    points: dict[str, Point] = {}
    parts: dict[str, list[_Joined]] = {name: [] for name in _JOINED}
    instruments: dict[str, Instrument] = {}
    for epoch, survey in epochs.items():
        for point in survey.points:
            name = point.point_id if point.point_id in stable else epoch_name(point.point_id, epoch)
            points.setdefault(name, replace(point, point_id=name))
        instruments |= {i.instrument_id: i for i in survey.instruments if i.instrument_id not in instruments}
        for part, found in parts.items():
            found += [_renamed(x, epoch, stable) for x in getattr(survey, part)]
    first = next(iter(epochs.values()))
    inner = any(s.datum.kind == "inner" for s in epochs.values())
    datum = Datum("inner", points=tuple(p for p in points if p in stable)) if inner else first.datum
    whole = Survey(points=tuple(points.values()), datum=datum, vertical=first.vertical, bearings=first.bearings,
                   instruments=tuple(instruments.values()))  # fmt: skip
    observed: Fields = {k: tuple(v) for k, v in parts.items()}
    return replace(whole, **observed)


def _renamed(item: Item, epoch: str, stable: Collection[str]) -> Item:
    """An observation or setup of one epoch, with its own ids and points."""
    changed: Fields = {}
    for name in {"setup_id", *_IDS} & set(item.__dataclass_fields__):
        value = getattr(item, name)
        changed[name] = epoch_name(value, epoch) if value or name in _IDS else value
    if hasattr(item, "reading_ids"):
        changed["reading_ids"] = tuple(epoch_name(v, epoch) for v in item.reading_ids)
    return with_positions(replace(item, **changed), lambda ref: _position(ref, epoch, stable))


def _position(ref: PositionRef, epoch: str, stable: Collection[str]) -> PositionRef:
    if ref.frame is not None or ref.point_id is None or ref.point_id in stable:
        return ref
    return replace(ref, point_id=epoch_name(ref.point_id, epoch))
