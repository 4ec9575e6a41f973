"""Single decisions written into the text of ``survey.toml``: everything else, comments too, stays to the letter.

What a text says after that is for the readers to judge; here only the place of a key is known.
"""

import tomllib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import tomlkit
from gtsam import Pose3

from adjust.lenses.models import MODELS
from adjust.model.errors import SurveyError
from adjust.model.result import Estimate, ParameterName
from adjust.model.survey import Survey
from survey.folder.units import from_si
from survey.project.declared.owners import geometry_units
from survey.project.declared.poses import quaternion_wxyz
from survey.project.declared.vectors import key_of

LENGTHS = ("square_mm", "marker_mm", "gap_mm", "markers")
"""The keys of a target that say how large it is."""
_OF_POSE = ("rotation_euler_xyz_deg", "held", "sigma_rotation_arcsec", "sigma_translation_mm", "covariance")


def with_value(text: str, path: Sequence[str], value: object) -> str:
    """With another value of the key at a path, which is made where it is not there. Raises SurveyError."""
    def change(at: Any) -> None:
        before = at.get(path[-1])
        n = len(before) if isinstance(before, list) and any(isinstance(x, float | int) for x in before) else None
        at[path[-1]] = list(value)[:n] if isinstance(value, tuple) else value

    return _with_change(text, path[:-1], change)


def with_product(text: str, path: Sequence[str], factor: float) -> str:
    """With the number, or every length of the target, at a path multiplied; a scale that is not there was 1.

    Raises SurveyError where no number stands there: points of a target in a file of their own.
    """
    owner = tomllib.loads(text)
    for key in path:
        owner = owner.get(key, {}) if isinstance(owner, dict) else owner
    keys = [key for key in LENGTHS if isinstance(owner, dict) and key in owner]
    if path[:2] == ("sigmas", "scale") or not isinstance(owner, dict):
        number = 1.0 if isinstance(owner, dict) else owner
        return with_value(text, path, _times(number, factor))
    if not keys:
        raise SurveyError(f"no length of {'.'.join(path)} stands there; its points are in a file: multiply them by "
                          f"{factor:.9g}")  # fmt: skip

    def change(at: Any) -> None:
        for key in keys:
            at[key] = _times(owner[key], factor)

    return _with_change(text, path, change)


def _times(value: Any, factor: float) -> Any:
    """A number, or every number of a list or table, multiplied."""
    if isinstance(value, Mapping):
        return {key: _times(one, factor) for key, one in value.items()}
    if isinstance(value, list):
        return [_times(one, factor) for one in value]
    return float(f"{factor * value:.9g}")


def _with_change(text: str, path: Sequence[str], change: Callable[[Any], None]) -> str:
    """With the table at a path changed, and nothing else; raises SurveyError where the text does not allow that."""
    wanted = tomllib.loads(text)
    at = wanted
    for key in path:
        at = at.setdefault(key, {})
    change(at)
    document: Any = tomlkit.parse(text)
    change(_table(document, *path))
    new = tomlkit.dumps(document)
    if tomllib.loads(new) != wanted:
        raise SurveyError(f"{'.'.join(path)} cannot be changed by a program here; edit it yourself")
    return new


def with_sigma_scale(text: str, group: str, factor: float) -> str:
    """With the factor on all sigmas of a group ([sigmas.scale]); 1 takes it out. Raises SurveyError."""
    if not (np.isfinite(factor) and factor > 0.0):
        raise SurveyError(f"group {group}: the factor of its sigmas is {factor:g}; it must be positive")
    return _with_keys(text, ("sigmas", "scale"), {group: None if factor == 1.0 else float(factor)})


def with_datum(text: str, kind: str, points: Sequence[str] = (), stations: Sequence[str] = ()) -> str:
    """With this datum ([datum]): ``given``, or ``inner`` over these points and stations, over all where none."""
    named = {key: list(names) or None for key, names in (("points", points), ("stations", stations))}
    return _with_keys(text, ("datum",), {"kind": kind, **(named if kind == "inner" else dict.fromkeys(named))})


def _with_keys(text: str, path: Sequence[str], keys: Mapping[str, object]) -> str:
    """With these keys in the table at a path, without those that are None."""
    document: Any = tomlkit.parse(text)
    table = _table(document, *path)
    for key, value in keys.items():
        if value is None:
            table.pop(key, None)
        else:
            table[key] = value
    return tomlkit.dumps(document)


def with_treatment(
    text: str, survey: Survey, estimates: Mapping[ParameterName, Estimate], name: str, treatment: str
) -> str:
    """With a parameter ``free``, or ``held`` at its adjusted value.

    name: as in results, such as ``lens/X/k1``, ``lens/X``, ``point/B07``, ``station_from_camera/X``. Raises SurveyError
    for what has no place of its own in survey.toml.
    """
    if treatment not in ("free", "held"):
        raise SurveyError(f"{name}: a parameter is made free or held, not {treatment!r}")
    kind, owner, *rest = (*name.split("/"), "")[:3]
    estimate = estimates.get((kind, owner))
    if estimate is None:
        raise SurveyError(f"{name}: no parameter of the solution has this name; take it from the list of parameters")
    document: Any = tomlkit.parse(text)
    component = rest[0] if rest else ""
    if kind in ("lens", "table_geometry"):
        _of_vector(document, estimate, component, treatment, survey)
    elif component:
        raise SurveyError(f"{name}: single epochs, and components of a pose or point, are edited in survey.toml")
    elif kind == "point":
        entry = _table(document, "points", owner)
        entry["treatment"] = treatment
        _drop(entry, ("held", "sigma_mm", "covariance_mm2"))
        if treatment == "held":
            entry["x_mm"] = (1e3 * np.asarray(estimate.value)).tolist()
    else:
        _of_pose(_pose_table(document, survey, kind, owner, name), estimate, treatment)
    return tomlkit.dumps(document)


def _of_vector(document: Any, estimate: Estimate, component: str, treatment: str, survey: Survey) -> None:
    kind, owner = estimate.name[:2]
    place = ("cameras", owner, "lens") if kind == "lens" else ("tables", owner, "geometry")
    entry, names = _table(document, *place), estimate.components
    declared = {**{("lens", c.camera_id): c.lens.free for c in survey.cameras},
                **{("table_geometry", t.table_id): t.geometry.free for t in survey.tables}}  # fmt: skip
    wanted = (component,) if component else names
    if component and component not in names:
        raise SurveyError(f"{'/'.join(estimate.name)}: has no {component!r}; its components are {', '.join(names)}")
    before = set(declared[kind, owner])
    after = before | set(wanted) if treatment == "free" else before - set(wanted)
    entry["free"] = [n for n in names if n in after]
    if kind == "table_geometry":
        _table(document, "tables", owner).pop("harmonics", None)  # they stand in free now
    if treatment == "free":
        return
    values = dict(zip(names, np.asarray(estimate.value, dtype=float).tolist(), strict=True))
    if kind == "table_geometry":
        units = geometry_units(wanted)
        for key, unit in units.items():
            entry[key_of(key, units)] = float(from_si(values[key], unit))
        return
    known = _table(entry, "values")
    for key in values if not known else wanted:
        known[key] = values[key]
    for key in wanted:
        if "prior" in entry:
            entry["prior"].pop(key, None)
    model = next(c.lens.model for c in survey.cameras if c.camera_id == owner)
    if set(values) != set(MODELS[model].names):
        raise SurveyError(f"camera {owner}: the solution has a lens of another model than {model}")


def _of_pose(entry: Any, estimate: Estimate, treatment: str) -> None:
    entry["treatment"] = treatment
    _drop(entry, [key for key in entry if key in _OF_POSE or key.startswith(("sigma", "covariance"))])
    if treatment == "held" and isinstance(estimate.value, Pose3):
        entry["translation_mm"] = (1e3 * np.asarray(estimate.value.translation())).tolist()
        entry["rotation_quaternion_wxyz"] = quaternion_wxyz(estimate.value.rotation())


def _pose_table(document: Any, survey: Survey, kind: str, owner: str, name: str) -> Any:
    places = {"station_from_camera": "cameras", "world_from_station": "stations", "mount_from_station": "stations",
              "world_from_table": "tables"}  # fmt: skip
    if kind in places:
        return _table(document, places[kind], owner, kind)
    if kind == "carrier_from_target":
        on_station = next(t.station_id for t in survey.targets if t.target_id == owner) is not None
        return _table(document, "targets", owner, "station_from_target" if on_station else "world_from_target")
    raise SurveyError(f"{name}: cannot be held from here; write that into survey.toml")


def _drop(entry: Any, keys: Sequence[str]) -> None:
    for key in keys:
        entry.pop(key, None)


def _table(document: Any, *path: str) -> Any:
    """The table at a path, made where it is not there: inside an inline table as one, else with a header of its own."""
    at = document
    for i, key in enumerate(path):
        if key not in at:
            inline = isinstance(at, tomlkit.items.InlineTable)
            at[key] = tomlkit.inline_table() if inline else tomlkit.table(is_super_table=i + 1 < len(path))
        at = at[key]
    return at
