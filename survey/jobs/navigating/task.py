"""What of a project is navigated, and what it is calibrated from: station, epochs, their times, spots and readings."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import repeat
from pathlib import Path

import numpy as np

from adjust.model.errors import SurveyError, listed
from adjust.model.frozen import frozen
from adjust.model.names import natural_key
from adjust.model.observations import ImageBlock
from adjust.model.subsets import in_use, points_read, with_points
from adjust.model.survey import Survey
from adjust.navigation import NavigationEpoch, Spots, head_of
from adjust.statistics.outliers.supported import supported
from survey.folder.text import csv_rows, read_text
from survey.jobs.navigating.lenses import with_images_left
from survey.project import Project


@frozen
class NavigateRequest:
    """What is navigated.

    station: None for the only one with cameras, or the one a table carries. epochs: None for all in which its cameras
    show beacons and no target. interval_s: time between epochs. times: instead, a table with columns epoch_id and
    time_s; epochs then come in the order of time. Without either motion is not used. unnamed: forget the names that
    spots have.
    """

    station: str | None = None
    epochs: tuple[str, ...] | None = None
    interval_s: float | None = None
    use_table: bool = True
    unnamed: bool = False
    times: Path | None = None


def chosen_station(project: Project) -> str:
    """The station to navigate: the only one with cameras, or the only one on a table. Raises SurveyError."""
    found = head_of(project.survey)
    if found is not None:
        return found
    carrying = list(dict.fromkeys(c.station_id for c in project.survey.cameras))
    if not carrying:
        raise SurveyError(f"{project.folder}/survey.toml: there is no camera; navigation needs a calibrated one")
    raise SurveyError(
        f"{project.folder}/survey.toml: {len(carrying)} stations carry cameras ({', '.join(carrying)}); say which one "
        "is to be navigated with --station"
    )


def chosen_epochs(project: Project, station: str, request: NavigateRequest) -> list[str]:
    """Epochs to navigate, in natural order. Raises SurveyError."""
    own = {c.camera_id for c in project.survey.cameras if c.station_id == station}
    if not own:
        carrying = ", ".join(dict.fromkeys(c.station_id for c in project.survey.cameras))
        raise SurveyError(
            f"{project.folder}/survey.toml: no camera is on station {station!r}; stations with cameras: {carrying}"
        )
    lit, shown = _lit_and_shown(project, own)
    if request.epochs is not None:
        unknown = [e for e in request.epochs if e not in lit]
        if unknown:
            raise SurveyError(f"{project.folder}: no beacon was observed at epoch {', '.join(unknown)} from {station}")
        return list(request.epochs)
    found = sorted(lit - shown, key=natural_key)
    if not found:
        raise SurveyError(
            f"{project.folder}/observations: no epoch to navigate: none shows beacons to station {station} without a "
            "target; name epochs with --epochs, or detect spots first"
        )
    return found


def _lit_and_shown(project: Project, own: set[str]) -> tuple[set[str], set[str]]:
    """Epochs at which these cameras show beacons, and those at which they show a target."""
    blocks = [b for b in in_use(project.survey).image_blocks if b.camera_id in own]
    lit = {s.epoch_id for s in project.spots if s.camera_id in own}
    lit |= {b.epoch_id for b in blocks if b.target_id is None}
    return lit, {b.epoch_id for b in blocks if b.target_id is not None}


def others_to_navigate(project: Project, station: str, epochs: Sequence[str]) -> list[str]:
    """Epochs that could be navigated as well and were not asked for, in natural order.

    They take no part in the calibration either, so that it is the same whichever epochs are asked for; none where no
    epoch of the station shows a target, so that nothing else could calibrate it.
    """
    lit, shown = _lit_and_shown(project, {c.camera_id for c in project.survey.cameras if c.station_id == station})
    return sorted(lit - shown - set(epochs), key=natural_key) if shown else []


def chosen_times(epochs: Sequence[str], request: NavigateRequest) -> list[float] | None:
    """Time (s) of every epoch, None where nothing tells. Raises SurveyError."""
    if request.times is None:
        step = request.interval_s
        return None if step is None else [i * step for i in range(len(epochs))]
    if request.interval_s is not None:
        raise SurveyError("give either the interval between epochs or a table of their times, not both")
    found = _times(request.times)
    missing = [e for e in epochs if e not in found]
    if missing:
        raise SurveyError(f"{request.times}: no time for epoch {listed(missing, 5)}; add it, or leave it out")
    times = [found[e] for e in epochs]
    if len(set(times)) < len(times):
        raise SurveyError(f"{request.times}: two of the epochs to navigate have the same time; times must differ")
    return times


def _times(path: Path) -> dict[str, float]:
    """Time (s) by epoch, from a table that has both among its columns. Raises SurveyError."""
    (_, header), *rows = [*csv_rows(path, read_text(path))] or [(1, [""])]
    if not rows or not {"epoch_id", "time_s"} <= set(header):
        raise SurveyError(f"{path}:1: the columns epoch_id and time_s are needed")
    found: dict[str, float] = {}
    for line, cells in rows:
        row = dict.fromkeys(header, "") | dict(zip(header, cells, strict=False))
        epoch_id, text = row["epoch_id"], row["time_s"]
        try:
            seconds = float(text)
        except ValueError:
            seconds = float("nan")
        if not np.isfinite(seconds) or epoch_id in found:
            problem = "is there twice" if epoch_id in found else f"has the time {text!r}, give seconds"
            raise SurveyError(f"{path}:{line}: epoch {epoch_id!r} {problem}")
        found[epoch_id] = seconds
    return found


def require_one_time(survey: Survey, station_id: str) -> tuple[str, ...]:
    """Notes on clocks, for people: all that an epoch of a station is navigated from counts as seen at one time.

    Raises SurveyError where clocks say that it is not.
    """
    cameras = [c for c in survey.cameras if c.station_id == station_id]
    carried = survey.stations_by_id[station_id].table_id
    owners = {f"cameras.{c.camera_id}": c.clock for c in cameras}
    owners |= {f"tables.{t.table_id}": t.clock for t in survey.tables if t.table_id == carried}
    clocked = {name: clock for name, clock in owners.items() if clock is not None}
    if not clocked:
        return ()
    names = ", ".join(clocked)
    if len(owners) > 1 or any("line_time" in clock.parameters.names for clock in clocked.values()):
        raise SurveyError(
            f"station {station_id!r}: survey.toml gives {names} a clock, so that what its epochs show was seen at "
            "different times; navigation takes one pose an epoch: let it stand still at the epochs to navigate, and "
            "calibrate with a folder that has no such clock, or trigger the cameras together"
        )
    return (f"{names} has a clock: poses are those when it exposed, not when its epoch was",)


def calibrating(project: Project, station: str, epochs: Sequence[str]) -> Survey:
    """The survey that the navigated epochs have no part in, so that no spot is used twice."""
    survey, out = project.survey, set(epochs)
    own = {c.camera_id for c in survey.cameras if c.station_id == station}
    blocks = tuple(b for b in survey.image_blocks if not (b.camera_id in own and b.epoch_id in out))
    carried = survey.stations_by_id[station].table_id
    readings = tuple(r for r in survey.table_readings if not (r.table_id == carried and r.epoch_id in out))
    left = with_images_left(survey, replace(survey, image_blocks=blocks, table_readings=readings))
    return supported(with_known_points(left))[0]


def with_known_points(survey: Survey) -> Survey:
    """Without the points that the remaining observations do not determine: seen by fewer than two images, or given."""
    seen: dict[int, set[tuple[str, str]]] = {}
    for b in survey.image_blocks:
        if b.target_id is None:
            for i in (b.point_idx[b.mask]).tolist():
                seen.setdefault(i, set()).add((b.camera_id, b.epoch_id))
    given = {r.point_id for c in survey.coordinates if c.used for r in c.positions if r.frame is None}
    given |= points_read(survey)
    keep = [
        i for i, p in enumerate(survey.points)
        if len(seen.get(i, ())) >= 2 or p.point_id in given or p.x_in_world.treatment != "free"
    ]  # fmt: skip
    return with_points(survey, keep)


def observed_epochs(
    project: Project, station: str, epochs: Sequence[str], times: Sequence[float] | None, request: NavigateRequest,
    named: set[str],
) -> list[NavigationEpoch]:  # fmt: skip
    """Of each epoch its spots, named or not, and its table reading; what is not used is not navigated from."""
    survey = in_use(project.survey)
    own = {c.camera_id for c in survey.cameras if c.station_id == station}
    spots: dict[str, list[Spots]] = {e: [] for e in epochs}
    for s in project.spots:
        if s.camera_id in own and s.epoch_id in spots:
            spots[s.epoch_id].append(Spots(s.camera_id, s.uv, s.cov))
    for b in survey.image_blocks:
        if b.target_id is None and b.camera_id in own and b.epoch_id in spots:
            spots[b.epoch_id].append(_spots_of(b, survey, None if request.unnamed else named))
    carried = survey.stations_by_id[station].table_id
    readings = {r.epoch_id: (r.angles, r.cov) for r in reversed(survey.table_readings) if r.table_id == carried}
    return [
        NavigationEpoch(e, tuple(spots[e]), time_s, *readings.get(e, (None, None)))
        for e, time_s in zip(epochs, times or repeat(None, len(epochs)), strict=True)
    ]


def _spots_of(b: ImageBlock, survey: Survey, named: set[str] | None) -> Spots:
    """The image points of these names; of all, and without names, where it is None."""
    if named is None:
        return Spots(b.camera_id, b.uv, b.cov)
    ids = [survey.points[i].point_id for i in b.point_idx.tolist()]
    rows = [i for i, p in enumerate(ids) if p in named]
    return Spots(b.camera_id, b.uv[rows], b.cov[rows], tuple(ids[i] for i in rows))
