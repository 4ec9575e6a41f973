"""The job ``convert``: files of other programs to project folders, and projects or their results to other formats.

>>> outcome = convert_job(Path("garage.g2o"), Path("garage"))  # a project; adjust it
>>> outcome = convert_job(Path("garage"), Path("adjusted.g2o"))
>>> outcome = convert_job(Path("tunnel.gkf"), Path("tunnel"))
>>> outcome = convert_job(Path("tunnel"), Path("tunnel.snx"))
>>> outcome = convert_job(Path("head"), Path("head.yaml"), format="kalibr", station="head")
"""

from collections.abc import Callable
from dataclasses import field
from pathlib import Path
from typing import Any

import numpy as np

from adjust.graph.assembly import values_of
from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray
from survey.folder.replacing import filling
from survey.folder.text import read_bytes, suggestion
from survey.interop.cameras import formats as camera_formats
from survey.interop.cameras.values import CameraValues, camera_values
from survey.interop.networks.foreign import ForeignNetwork, is_utf8, with_safe_ids
from survey.interop.networks.g2o import Information
from survey.interop.networks.gama import read_gama
from survey.interop.networks.gama_writer import gama_text
from survey.interop.networks.json_document import network_json
from survey.interop.networks.krumm import read_krumm
from survey.interop.networks.lgc import read_lgc
from survey.interop.networks.plain_csv import correlated, plain_csv, read_plain_csv
from survey.interop.networks.sinex import sinex_text
from survey.interop.networks.values import NetworkValues, counted, left_out, require_network
from survey.interop.photogrammetry.aicon import ENDINGS as AICON_ENDINGS
from survey.interop.photogrammetry.aicon import read_aicon
from survey.interop.photogrammetry.dbat import read_dbat
from survey.jobs.adjusting.steps import adjust_project
from survey.jobs.converting_g2o import AS_IN_THE_FILE, project_to_g2o, survey_from_g2o
from survey.project import AdjustmentOptions, Project, atomic_write, read, write_project
from survey.project.project import DEFINITION_FILE, RESULTS
from survey.solution.earlier.previous import read_previous
from survey.solution.quantities import scale_of

READERS: dict[str, Callable[[Path], ForeignNetwork]] = {
    "gama": read_gama,
    "krumm": read_krumm,
    "lgc": read_lgc,
    "csv": read_plain_csv,
    "dbat": read_dbat,
    "aicon": read_aicon,
    **camera_formats.READERS,
}
_TEXTS = ("gama", "krumm", "lgc", "csv", "dbat", "aicon")
WRITERS = ("g2o", "gama", "csv", "json", "sinex", *camera_formats.WRITERS)
_ENDINGS = {
    ".g2o": "g2o",
    ".gkf": "gama",
    ".dat": "krumm",
    ".lgc": "lgc",
    ".csv": "csv",
    ".xml": "dbat",
    ".htm": "aicon",
    **dict.fromkeys(AICON_ENDINGS, "aicon"),
    ".json": "json",
    ".snx": "sinex",
    **camera_formats.ENDINGS,
}


@frozen
class ConvertOutcome:
    """What was written. counts: by what they count. values: which poses or coordinates. left_out: for people."""

    source: Path
    target: Path
    format: str
    counts: dict[str, int] = field(default_factory=dict)
    values: str = ""
    left_out: tuple[str, ...] = ()

    def summary(self) -> dict[str, Any]:
        """As plain values."""
        return {
            "from": str(self.source),
            "to": str(self.target),
            "format": self.format,
            **self.counts,
            "poses": self.values,
            "left_out": list(self.left_out),
        }

    def text(self) -> str:
        """For people."""
        named = [(n, what.replace("_", " ")) for what, n in self.counts.items()]
        first, *rest = (f"{n} {what[:-1] if n == 1 else what}" for n, what in named)
        counts = f"{first} ({self.values})" + "".join(f" and {r}" if r == rest[-1] else f", {r}" for r in rest)
        return "\n".join([*(f"  ! {line}" for line in self.left_out), f"{self.target}: {counts} from {self.source}"])


def convert_job(
    source: Path,
    target: Path,
    *,
    format: str | None = None,
    information: Information = "tangent",
    block_diagonal: bool = False,
    station: str | None = None,
) -> ConvertOutcome:
    """Write ``source`` in another format at ``target``: the one a project folder, the other a file.

    format: of the file; by default by its ending. information: what the rotation part of g2o's information matrices
    refers to. block_diagonal: only their blocks of translation and rotation are read. station: whose cameras or poses
    are written, for the formats that hold those of one. Raises SurveyError for what the other format cannot hold, and
    where there is something at ``target``.
    """
    source, target = Path(source), Path(target)
    if source.is_dir() and not (format in camera_formats.FOLDERS and not (source / DEFINITION_FILE).exists()):
        return _to_file(source, target, _file_format(target, format, WRITERS), information, station)
    if format in (None, "project") and target.suffix.lower() in _ENDINGS and not target.is_dir():
        known = _ENDINGS[target.suffix.lower()]
        if known in WRITERS:
            raise SurveyError(f"{source}: is no project folder; only a project is converted to {known}")
    if not source.exists():
        raise SurveyError(f"{source}: there is no such file; give a file of another program, or a project folder")
    if format in ("json", "sinex"):
        raise SurveyError(f"{source}: the format {format} is only written; give a project folder")
    chosen = None if format == "project" else format
    return _to_project(source, target, _file_format(source, chosen, (*READERS, "g2o")), information, block_diagonal)


def _file_format(path: Path, given: str | None, known: tuple[str, ...]) -> str:
    ending = path.suffix.lower()
    found = given or _ENDINGS.get(ending)
    possible = [f for f in camera_formats.AMBIGUOUS.get(ending, ()) if f in known]
    if len(possible) == 1 and found is None:
        found = possible[0]
    if possible and given in (None, "project") and found not in known:
        raise SurveyError(f"{path}: the ending tells no format, {ending} belongs to several; say which with --format: "
                          f"{', '.join(possible)}")  # fmt: skip
    if found == "project" or found is None:
        endings = ", ".join(sorted(e for e, f in _ENDINGS.items() if f in known))
        raise SurveyError(f"{path}: the ending tells no format; end the name with {endings} or give --format")
    if found not in known:
        raise SurveyError(f"{path}: the format {found!r} does not go this way; {suggestion(found, known)}")
    return found


def _to_project(
    source: Path, target: Path, format: str, information: Information, block_diagonal: bool
) -> ConvertOutcome:
    if target.exists() and not target.is_dir():
        raise SurveyError(f"{target}: is a file; give the name of a new folder")
    if (target / DEFINITION_FILE).exists():
        raise SurveyError(f"{target}: there is a project already; choose another folder")
    if format == "g2o":
        survey, notes = survey_from_g2o(source, information, block_diagonal)
        with filling(target) as place:
            write_project(place, survey, title=source.stem, options=AS_IN_THE_FILE)
        counts = {"stations": len(survey.stations), "pairs": len(survey.pairs)}
        return ConvertOutcome(source, target, "project", counts, "as in the file", notes)
    network = READERS[format](source)
    survey, renamed = with_safe_ids(network.survey)
    reject = network.reject
    alpha = network.alpha or AdjustmentOptions.alpha
    options = AdjustmentOptions(alpha, reject, reject, reject, sigmas=network.sigmas)
    title = network.title or source.stem
    with filling(target) as place:
        write_project(place, survey, title=title, options=options, target_kinds=network.target_kinds)
    counts = {
        "points": len(survey.points),
        "readings": len(survey.readings),
        "baselines": sum(len(o.to) for o in survey.coordinate_differences),
        "coordinates": sum(len(o.positions) for o in survey.coordinates),
        "image_points": sum(len(b.uv) for b in survey.image_blocks),
        "distances": len(survey.distances),
        "cameras": len(survey.cameras),
        "targets": len(survey.targets),
        "stations": len(survey.stations),
    }
    shown = {what: n for what, n in counts.items() if n} or {"points": 0}
    notes = (*network.notes, *renamed, *_encoding(source, format))
    return ConvertOutcome(source, target, "project", shown, "as in the file", notes)


def _encoding(source: Path, format: str) -> tuple[str, ...]:
    if format not in _TEXTS or not source.is_file() or is_utf8(read_bytes(source)[0]):
        return ()
    return ("the text is not UTF-8; unless the file names its encoding it was read as Latin-1",)


def adjusted_values(project: Project) -> CameraValues:
    """The values of a project. One with results is adjusted again, because its files do not hold every covariance."""
    if not (project.folder / RESULTS / "solution.json").is_file():
        return camera_values(project)
    return camera_values(project, adjust_project(project, progress=False))


def _to_file(
    source: Path, target: Path, format: str, information: Information, station: str | None
) -> ConvertOutcome:
    if target.exists():
        raise SurveyError(f"{target}: is there already; give another name")
    if format == "g2o":
        n_stations, n_pairs, poses, rest = project_to_g2o(source, target, information)
        return ConvertOutcome(source, target, "g2o", {"stations": n_stations, "pairs": n_pairs}, poses, rest)
    project = read(source)
    if format in camera_formats.WRITERS:
        values = adjusted_values(project)
        counts, notes = camera_formats.write_cameras(values, target, format, station)
        said = "adjusted" if values.adjusted else "start values, not adjusted"
        return ConvertOutcome(source, target, format, counts, said, notes)
    require_network(project.survey, str(source), format)
    network = _adjusted(project) if format == "sinex" else _as_it_stands(project)
    rest = left_out(project.survey, unused=format != "json")
    if format == "csv":
        rest += correlated(network)
    text = {"gama": gama_text, "csv": plain_csv, "json": network_json, "sinex": sinex_text}[format](network)
    atomic_write(target, text)
    counts = {"points": len(project.survey.points)} if format == "sinex" else counted(project.survey)
    said = "adjusted" if network.adjusted else "start values, not adjusted"
    return ConvertOutcome(source, target, format, counts, said, () if format == "sinex" else rest)


def _as_it_stands(project: Project) -> NetworkValues:
    """Adjusted points where the project has results, else its start values."""
    start = {p.point_id: p.x_in_world.value for p in project.survey.points if p.x_in_world.value is not None}
    if not (project.folder / RESULTS / "solution.json").is_file():
        return NetworkValues(project.survey, project.title, start, **_options(project))
    before = read_previous(project)
    factor = float(before.summary["sigma_factor"])
    covs = {name[1]: factor**2 * e.cov for name, e in before.estimates.items() if name[0] == "point"}
    x = start | dict(values_of(before).points)
    return NetworkValues(project.survey, project.title, x, True, covs, factor, **_options(project))


def _options(project: Project) -> dict[str, Any]:
    return {"sigmas": project.options.sigmas, "alpha": project.options.alpha}


def _adjusted(project: Project) -> NetworkValues:
    """The project adjusted anew, because its result files hold no covariances between points."""
    result = adjust_project(project, progress=False)
    scale = scale_of(result, project.options.sigmas)
    x: dict[str, FloatArray] = {}
    names: list[tuple[str, str]] = []
    points = []
    for point in project.survey.points:
        estimate = result.estimates[("point", point.point_id)]
        x[point.point_id] = np.asarray(estimate.value)
        free = [a for a, s in zip("xyz", estimate.status, strict=True) if s != "held"]
        names += [(point.point_id, a) for a in free]
        points += [estimate.name] if free else []
    joint = result.precision.joint(points) if points else np.zeros((0, 0))
    place = {name[1]: k for k, name in enumerate(points)}
    rows = [3 * place[point] + "xyz".index(axis) for point, axis in names]
    return NetworkValues(
        project.survey, project.title, x, True, {}, scale.factor, tuple(names),
        scale.factor**2 * joint[np.ix_(rows, rows)], result.n_observations, result.n_unknowns, result.redundancy,
        result.omega, **_options(project),
    )  # fmt: skip
