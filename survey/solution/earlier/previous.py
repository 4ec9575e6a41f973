"""What an earlier adjustment of a project left in its results: values to start from, and sigmas to compare with."""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
from gtsam import Pose3

from adjust.model.errors import SurveyError
from adjust.model.result import Adjustment, ParameterName
from adjust.model.survey import FloatArray
from adjust.spatial.averaging import mean_pose
from survey.folder.locking import settled
from survey.folder.text import NOT_OURS, read_bytes
from survey.project import Project
from survey.project.declared.poses import rotation_from_quaternion
from survey.project.project import RESULTS
from survey.solution.covariances import read_covariances
from survey.solution.quantities import ARCSEC_PER_RAD, SigmaKind, key_of, sigmas_in, unit_for_people

# what damaged or foreign content makes the readers below raise
_MOST_MOVES, _MOST_SHOWN = 200, 8
_POSES = {
    "cameras": ("station_from_camera",),
    "stations": ("world_from_station", "mount_from_station"),
    "tables": ("world_from_table",),
    "targets": ("world_from_target", "station_from_target"),
}


@dataclass(frozen=True, eq=False)
class Previous:
    """A solution that was written: poses and points by parameter name; covs as written, by the same names.

    factor: by which sigmas were multiplied. vectors: components as
    ``solution.json`` has them, of lenses (with ``model``) and their changes, table angles and geometry, warps and
    clocks, by parameter name.
    """

    poses: Mapping[ParameterName, Pose3]
    points: Mapping[str, FloatArray]
    covs: Mapping[ParameterName, FloatArray]
    factor: float
    summary: Mapping[str, Any]
    vectors: Mapping[ParameterName, Mapping[str, Any]] = field(default_factory=dict)

    def vector(self, name: ParameterName, names: Sequence[str], units: Sequence[str]) -> FloatArray | None:
        """The components (n,) of a lens, a table, angles or a warp, in units inside; None where they are not there."""
        entry, out = self.vectors.get(name, {}), []
        for component, unit in zip(names, units, strict=True):
            unit_shown, factor = unit_for_people(component, unit)
            value = entry.get(key_of(component, unit_shown))
            if not isinstance(value, int | float) or not np.isfinite(value):
                return None
            out.append(value / factor)
        return np.array(out)


@dataclass(frozen=True)
class Move:
    """How far a station or point went: mm, arcsec, and the largest component in its sigmas of before."""

    name: str
    mm: float
    arcsec: float
    sigmas: float


def change_dict(before: Previous | None, after: Mapping[str, Any], moved: Sequence[Move]) -> dict[str, Any]:
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
    before: Previous, after: Mapping[str, Any], moved: Sequence[Move], how: str = "", what: str = "stations and points"
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


def read_previous(project: Project) -> Previous:
    """The results of a project. Raises SurveyError where it was not adjusted, or has changed since."""
    with settled(project.folder):
        return _read_previous(project)


def _read_previous(project: Project) -> Previous:
    path = project.folder / RESULTS / "solution.json"
    again = f"run 'labsurvey adjust {project.folder}' first"
    archive = path.with_name("covariance.npz")
    for file in (path, archive):
        if not file.is_file():
            raise SurveyError(f"{file}: is not there, the project is not adjusted yet; {again}")
    try:
        found = json.loads(read_bytes(path)[0])
        previous = _previous(found, read_covariances(archive))
        hashes = {str(name): str(digest) for name, digest in found["inputs"]["hashes"].items()}
    except NOT_OURS as error:
        raise SurveyError(f"{path}: cannot be read as a solution ({error}); {again}") from error
    changed = sorted(k for k in {*hashes, *project.inputs} if hashes.get(k) != project.inputs.get(k))
    if changed:
        raise SurveyError(f"{project.folder}: {', '.join(changed)} changed since the project was adjusted; {again}")
    return previous


def _previous(found: Mapping[str, Any], covs: Mapping[str, FloatArray]) -> Previous:
    """What the files say; raises what a file that is not one of ours makes it raise."""
    summary = found["summary"]
    points = {p: 1e-3 * _numbers([e[f"{a}_mm"] for a in "xyz"], 3) for p, e in found["points"].items()}
    by_name = {tuple(k.split("/")): v for k, v in covs.items()}
    sizes = {"point": 3, "world_from_station": 6}
    if any(len(cov) != sizes.get(name[0], len(cov)) for name, cov in by_name.items()):
        raise ValueError("a covariance has not the size of its parameter")
    int(summary["redundancy"]), float(summary["sigma0"] or 0.0)
    factor = float(_numbers([summary["sigma_factor"]], 1)[0])
    return Previous(dict(_poses(found)), points, by_name, factor, summary, dict(_vectors(found)))


def _vectors(found: Mapping[str, Any]) -> Iterator[tuple[ParameterName, Mapping[str, Any]]]:
    for kind, section in (("camera_clock", "cameras"), ("table_clock", "tables"), ("pose_clock", "stations")):
        for owner, entry in found[section].items():
            if isinstance(clock := entry.get("clock"), dict):
                yield (kind, owner), clock
                own = clock.get("epochs", {}).items()
                yield from (((kind, owner, epoch), time) for epoch, time in own if isinstance(time, dict))
    for camera, entry in found["cameras"].items():
        if isinstance(entry.get("lens"), dict):
            yield ("lens", camera), entry["lens"]
        for block, change in entry.get("lens_drift", {}).get("changes", {}).items():
            if isinstance(change, dict):
                yield ("lens_drift", camera, *(() if block == "per_kelvin" else (block,))), change
    for table, entry in found["tables"].items():
        if isinstance(entry.get("geometry"), dict):
            yield ("table_geometry", table), entry["geometry"]
        for epoch, angles in entry.get("epochs", {}).items():
            if isinstance(angles, dict):
                yield ("table_angles", table, epoch), angles
    for target, entry in found["targets"].items():
        if isinstance(entry.get("warp"), dict):
            yield ("warp", target), entry["warp"]


def _numbers(values: npt.ArrayLike, n: int) -> FloatArray:
    out = np.array(values)
    if out.shape != (n,) or out.dtype.kind not in "if" or not np.isfinite(out).all():
        raise ValueError(f"expected {n} numbers")
    return np.asarray(out, dtype=float)


def _poses(found: Mapping[str, Any]) -> list[tuple[ParameterName, Pose3]]:
    out: list[tuple[ParameterName, Pose3]] = []
    for section, names in _POSES.items():
        for owner, entry in found[section].items():
            for name in names:
                kind = "carrier_from_target" if section == "targets" else name
                if name in entry:
                    out.append(((kind, owner), _pose(entry[name])))
                for epoch, moved in entry.get("epochs", {}).items():
                    if name in moved:
                        out.append(((kind, owner, epoch), _pose(moved[name])))
    return out


def _pose(entry: Mapping[str, Any]) -> Pose3:
    rotation = rotation_from_quaternion(_numbers(entry["rotation_quaternion_wxyz"], 4))
    if rotation is None:
        raise ValueError("a quaternion is not of unit length")
    return Pose3(rotation, 1e-3 * _numbers(entry["translation_mm"], 3))


def moves(previous: Previous, adjustment: Adjustment, sigmas: SigmaKind | None = None) -> tuple[Move, ...]:
    """How far stations and points went since, most sigmas first; those that were held are left out.

    sigmas: those of before, as the project asks for; None: a priori.
    In a free network the datum may have moved too: the new solution is first laid onto the old one.
    """
    old, new = previous.poses, adjustment.estimates
    names = [n for n in old if n[0] == "world_from_station" and n in new]
    onto = _fit(previous, adjustment, names) if adjustment.survey.datum.kind == "inner" else Pose3()
    factor = 1.0 if sigmas == "a_posteriori" else previous.factor
    out = []
    for name in names:
        value = new[name].value
        if isinstance(value, Pose3):
            d = np.asarray(Pose3.Logmap(old[name].between(onto.compose(value))))
            out.append(_move(previous, name, factor, d, float(ARCSEC_PER_RAD * np.linalg.norm(d[:3])), d[3:]))
    for point, x in previous.points.items():
        estimate = new.get(("point", point))
        if estimate is not None and not isinstance(estimate.value, Pose3):
            d = np.asarray(onto.transformFrom(np.asarray(estimate.value))) - x
            out.append(_move(previous, ("point", point), factor, d, 0.0, d))
    return tuple(sorted((m for m in out if m is not None), key=lambda m: -m.sigmas))


def _move(
    previous: Previous, name: ParameterName, factor: float, d: FloatArray, arcsec: float, shift: FloatArray
) -> Move | None:
    cov = previous.covs.get(name)
    if cov is None:
        return None
    sigma = sigmas_in(cov) / factor
    known = sigma > 0.0
    if not known.any():
        return None
    text = "@".join(name[1:]) if name[0] == "world_from_station" else f"point {name[1]}"
    return Move(text, float(1e3 * np.linalg.norm(shift)), arcsec, float(np.abs(d[known] / sigma[known]).max()))


def _fit(previous: Previous, adjustment: Adjustment, names: list[ParameterName]) -> Pose3:
    """What takes the new world to the old one."""
    offers = [previous.poses[n].compose(v.inverse()).matrix() for n in names
              if isinstance(v := adjustment.estimates[n].value, Pose3)]  # fmt: skip
    return Pose3(mean_pose(np.array(offers), 1.0)[0]) if offers else Pose3()
