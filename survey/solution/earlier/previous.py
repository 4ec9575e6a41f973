"""What an earlier adjustment of a project left in its results: values to start from, and sigmas to compare with."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from gtsam import Pose3

from adjust.epochs.states import differences_of
from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.result import Adjustment, ParameterName
from adjust.spatial.averaging import mean_pose
from survey.folder.locking import settled
from survey.folder.plain import differing
from survey.folder.shapes import POSITIVE, WHOLE, Either, misfit
from survey.folder.text import NOT_OURS, read_bytes
from survey.project import Project
from survey.project.project import OBSERVATIONS_FOLDER, RESULTS
from survey.solution.covariances import read_estimates
from survey.solution.earlier.changes import Snapshot
from survey.solution.quantities import ARCSEC_PER_RAD, SigmaKind, sigmas_in
from survey.solution.records import sections

_MOST_MOVES, _MOST_SHOWN = 200, 8
_SUMMARY = {"redundancy": WHOLE, "sigma0": Either((POSITIVE, None)), "sigma_factor": POSITIVE}
_PLACED = ("world_from_station", "point")


@frozen
class Move:
    """How far a station or point went: mm, arcsec, and the largest component in its sigmas of before."""

    name: str
    mm: float
    arcsec: float
    sigmas: float


def change_dict(before: Snapshot | None, after: Mapping[str, Any], moved: Sequence[Move]) -> dict[str, Any]:
    """The summary of a solution beside that of before, and the first moves, the largest first."""
    was = {} if before is None else before.summary
    return {
        "redundancy_before": was.get("redundancy"),
        "redundancy_after": after["redundancy"],
        "sigma0_before": was.get("sigma0"),
        "sigma0_after": after["sigma0"],
        "n_moved_over_one_sigma": sum(m.sigmas > 1.0 for m in moved),
        "moved": [
            {"name": m.name, "moved_mm": m.mm, "moved_arcsec": m.arcsec, "moved_sigmas": m.sigmas}
            for m in moved[:_MOST_MOVES]
        ],
    }


def change_lines(
    before: Snapshot, after: Mapping[str, Any], moved: Sequence[Move], how: str = "", what: str = "stations and points"
) -> list[str]:
    """The same for people."""
    was, far = before.summary, [m for m in moved if m.sigmas > 1.0]
    return [
        f"redundancy {was['redundancy']} -> {after['redundancy']}, sigma0 {_sigma0(was)} -> {_sigma0(after)}{how}",
        f"{len(far)} of {len(moved)} {what} moved by more than one of their sigmas"
        + ("; the most" if moved and not far else ""),
        *(f"  {m.name:<20}{m.mm:>10.3f} mm{m.arcsec:>9.1f} arcsec{m.sigmas:>8.2f} sigmas"
          for m in (far or moved)[:_MOST_SHOWN]),
    ]  # fmt: skip


def _sigma0(summary: Mapping[str, Any]) -> str:
    return "-" if summary["sigma0"] is None else f"{summary['sigma0']:.3f}"


def read_previous(project: Project) -> Snapshot:
    """The results of a project. Raises SurveyError where it was not adjusted, or has changed since."""
    return previous_solution(project.folder, project.inputs)


def previous_solution(folder: Path, inputs: Mapping[str, str] | None = None) -> Snapshot:
    """The results in a folder; inputs: hashes of what was read, None: of the files as they are. Raises SurveyError."""
    with settled(folder):
        return _previous_solution(folder, inputs)


def input_hashes(folder: Path, names: Iterable[str]) -> dict[str, str]:
    """By its path, sha256 of every file of these that is there, and of every table. Raises SurveyError."""
    there = {name for name in names if (folder / name).is_file()}
    return {name: read_bytes(folder / name)[1] for name in sorted({*there, *tables_in(folder)})}


def tables_in(folder: Path) -> set[str]:
    """Paths of the tables of observations that a reader of the folder would take."""
    place = folder / OBSERVATIONS_FOLDER
    return {p.relative_to(folder).as_posix() for p in (place.iterdir() if place.is_dir() else ())
            if p.suffix in (".csv", ".parquet") and not p.name.startswith(".")}  # fmt: skip


def _previous_solution(folder: Path, inputs: Mapping[str, str] | None) -> Snapshot:
    path = folder / RESULTS / "solution.json"
    again = f"run 'labsurvey adjust {folder}' first"
    archive = path.with_name("covariance.npz")
    for file in (path, archive):
        if not file.is_file():
            raise SurveyError(f"{file}: is not there, the project is not adjusted yet; {again}")
    try:
        found = sections(read_bytes(path)[0], "summary", "inputs")
        if (problem := misfit(found["summary"], _SUMMARY)) is not None:
            raise ValueError(problem)
        previous = Snapshot(read_estimates(archive), found["summary"])
        hashes = {str(name): str(digest) for name, digest in found["inputs"]["hashes"].items()}
    except NOT_OURS as error:
        raise SurveyError(f"{path}: cannot be read as a solution ({error}); {again}") from error
    now = input_hashes(folder, hashes) if inputs is None else inputs
    changed = differing(hashes, now)
    if changed:
        raise SurveyError(f"{folder}: {', '.join(changed)} changed since the project was adjusted; {again}")
    return previous


def moves(before: Snapshot, adjustment: Adjustment, sigmas: SigmaKind | None = None) -> tuple[Move, ...]:
    """How far stations and points went since, most sigmas first; those that were held are left out.

    sigmas: those of before, as the project asks for; None: a priori.
    In a free network the datum may have moved too: the new solution is first laid onto the old one.
    """
    old, new = before.estimates, adjustment.estimates
    names = [n for kind in _PLACED for n in old if n[0] == kind and n in new]
    onto = _fit(before, adjustment, names) if adjustment.survey.datum.kind == "inner" else Pose3()
    factor = float(before.summary["sigma_factor"]) if sigmas == "a_posteriori" else 1.0
    out = []
    for name in names:
        value, sigma = new[name].value, factor * sigmas_in(old[name].cov)
        now = onto.compose(value) if isinstance(value, Pose3) else onto.transformFrom(np.asarray(value))
        d, known = differences_of(old[name].value, now), sigma > 0.0
        if known.any():
            text = "@".join(name[1:]) if name[0] == "world_from_station" else f"point {name[1]}"
            turn, shift = (float(np.linalg.norm(part)) for part in (d[:-3], d[-3:]))
            out.append(Move(text, 1e3 * shift, ARCSEC_PER_RAD * turn, float(np.abs(d[known] / sigma[known]).max())))
    return tuple(sorted(out, key=lambda m: -m.sigmas))


def _fit(before: Snapshot, adjustment: Adjustment, names: Sequence[ParameterName]) -> Pose3:
    """What takes the new world to the old one."""
    both = ((before.estimates[n].value, adjustment.estimates[n].value) for n in names)
    offers = [a.compose(b.inverse()).matrix() for a, b in both if isinstance(a, Pose3) and isinstance(b, Pose3)]
    return Pose3(mean_pose(np.array(offers), 1.0)[0]) if offers else Pose3()
