"""The job ``convert``: pose networks between g2o files and project folders.

>>> outcome = convert_job(Path("garage.g2o"), Path("garage"))  # a project; adjust it
>>> outcome = convert_job(Path("garage"), Path("adjusted.g2o"))
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from gtsam import Pose3

from adjust.errors import SurveyError
from adjust.model import PoseParameter, Station, Survey
from adjust.observations import FrameRef, Pair
from adjust.pair_screen import is_pure
from adjust.pose_network.from_survey import network_from_survey
from survey.files import read, write_project
from survey.files.project import DEFINITION_FILE
from survey.files.text import id_problem
from survey.interop.g2o import Information, read_g2o, write_g2o
from survey.previous import read_previous
from survey.results import RESULTS
from survey.warm_start import network_start

Format = Literal["g2o", "project"]
FORMATS: tuple[Format, ...] = ("g2o", "project")


@dataclass(frozen=True)
class ConvertOutcome:
    """What was written. left_out: what the format cannot hold, for people."""

    source: Path
    target: Path
    format: Format
    n_stations: int
    n_pairs: int
    poses: str
    left_out: tuple[str, ...] = ()

    def summary(self) -> dict[str, Any]:
        """As plain values."""
        return {
            "from": str(self.source),
            "to": str(self.target),
            "format": self.format,
            "stations": self.n_stations,
            "pairs": self.n_pairs,
            "poses": self.poses,
            "left_out": list(self.left_out),
        }

    def text(self) -> str:
        """For people."""
        head = f"{self.target}: {self.n_stations} stations ({self.poses}) and {self.n_pairs} pairs from {self.source}"
        return "\n".join([*(f"  ! {line}" for line in self.left_out), head])


def convert_job(
    source: Path, target: Path, *, format: Format | None = None, information: Information = "tangent"
) -> ConvertOutcome:
    """Write the network of ``source`` to ``target``, the one a g2o file, the other a project folder.

    format: of ``target``; by default g2o where its name ends so, else a project. information: what the rotation part
    of g2o's information matrices refers to. Raises SurveyError for what the other format cannot hold, and where there
    is something at ``target`` already.
    """
    source, target = Path(source), Path(target)
    to = format or ("g2o" if target.suffix.lower() == ".g2o" else "project")
    if to == "g2o":
        if not source.is_dir():
            raise SurveyError(f"{source}: is no project folder; only a project is converted to g2o")
        if target.exists():
            raise SurveyError(f"{target}: is there already; give another name")
        return _to_g2o(source, target, information)
    if source.is_dir():
        raise SurveyError(f"{source}: is a folder; end the name of the new file with .g2o, or give a g2o file")
    if not source.is_file():
        raise SurveyError(f"{source}: there is no such file; give a g2o file")
    return _to_project(source, target, information)


def _to_project(source: Path, target: Path, information: Information) -> ConvertOutcome:
    if target.exists() and not target.is_dir():
        raise SurveyError(f"{target}: is a file; give the name of a new folder")
    if (target / DEFINITION_FILE).exists():
        raise SurveyError(f"{target}: there is a project already; choose another folder")
    network = read_g2o(source, information, use_vertices=True)
    for station in network.station_ids:
        if (problem := id_problem(station)) is not None:
            raise SurveyError(f"{source}: vertex {station}: {problem}")
    held = set(network.held.tolist())
    stations = []
    for i, station in enumerate(network.station_ids):
        known = bool(np.isfinite(network.station_translations[i]).all())
        value = _pose(network.station_rotations[i], network.station_translations[i]) if known else None
        pose = PoseParameter(value, "held" if i in held else "free")
        stations.append(Station(station, world_from_station=pose))
    frames = [FrameRef("station", s) for s in network.station_ids]
    pairs = tuple(
        Pair(network.pair_ids[e], frames[int(network.a_idx[e])], frames[int(network.b_idx[e])],
             _pose(network.rotations[e], network.translations[e]), network.cov[e])
        for e in range(network.n_pairs)
    )  # fmt: skip
    write_project(target, Survey(stations=tuple(stations), pairs=pairs), title=source.stem)
    return ConvertOutcome(source, target, "project", len(stations), len(pairs), "as in the file")


def _pose(rotation: Any, translation: Any) -> Pose3:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, translation
    return Pose3(matrix)


def _to_g2o(source: Path, target: Path, information: Information) -> ConvertOutcome:
    project = read(source)
    survey = project.survey
    if not is_pure(survey):
        raise SurveyError(
            f"{source}: g2o holds nothing but poses of fixed stations and pairs between them; this project has more, "
            "or has no pairs"
        )
    network = network_from_survey(survey, any_datum=True)
    adjusted = (source / RESULTS / "solution.json").is_file()
    known = dict(read_previous(project).poses) if adjusted else _given(survey)
    start = network_start(survey, known)
    if start is None:
        raise SurveyError(f"{source}: pairs leave stations without a pose; give them a start")
    write_g2o(target, network, *start, information=information)
    poses = "adjusted" if adjusted else "start values, not adjusted"
    left_out = _left_out(survey, network.station_ids)
    return ConvertOutcome(source, target, "g2o", network.n_stations, int(network.used.sum()), poses, left_out)


def _given(survey: Survey) -> dict[tuple[str, ...], Pose3]:
    """Poses that survey.toml gives."""
    return {
        ("world_from_station", s.station_id): s.world_from_station.value
        for s in survey.stations
        if s.world_from_station.value is not None
    }


def _left_out(survey: Survey, ids: tuple[str, ...]) -> tuple[str, ...]:
    """What the file does not say, for people."""
    out = []
    priors = [s.station_id for s in survey.stations if s.world_from_station.treatment == "prior"]
    unused = [p.pair_id for p in survey.pairs if not p.used]
    alone = [s.station_id for s in survey.stations if s.station_id not in ids]
    for what, names in (("priors of stations", priors), ("pairs not in use", unused), ("stations without pair", alone)):
        if names:
            out.append(f"left out, {what}: {', '.join(names[:8])}{' and more' if len(names) > 8 else ''}")
    if not all(s.isascii() and s.isdigit() for s in ids):
        out.append(f"g2o knows only numbers: stations are written as 0 to {len(ids) - 1}, in the order {_order(ids)}")
    return tuple(out)


def _order(ids: tuple[str, ...]) -> str:
    return ", ".join(ids[:12]) + (", ..." if len(ids) > 12 else "")
