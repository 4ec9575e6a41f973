"""What stands in the files of each example folder, images aside; the truth as JSON, which no command reads."""

from collections.abc import Callable, Iterable

import numpy as np
from gtsam import Pose3
from scipy.spatial.transform import Rotation

from adjust.model.result import ParameterName
from adjust.model.survey import TABLE_GEOMETRY, Camera, FloatArray, Survey, Target
from survey.folder.text import json_text
from survey.project.targets import Charuco, Checkerboard, MarkerGrid, TargetKind
from survey.simulate.draft import Draft
from survey.simulate.labs import (
    BEACON_SIGMA_MM,
    DISTANCE_SIGMA_MM,
    TABLE_SIGMA_ARCSEC,
    WITHOUT_COORDINATES,
    full_lab_draft,
    observed,
    single_camera_draft,
    stereo_draft,
)
from survey.simulate.scene import BROWN, Truth

Files = dict[str, str]
_LENS = """
[cameras.{name}.lens]
model = "brown"
free = ["fx", "fy", "u0", "v0", "k1", "k2", "p1", "p2"]
"""
GIVEN = """
[sigmas]
image_px = 0.1                                     # where the detector gives none

[datum]
kind = "given"                                     # the board is held

[adjustment]
alpha = 0.05
"""


def one_camera(seed: int) -> tuple[Draft, Files]:
    """One camera and a board held by hand."""
    draft = single_camera_draft(seed, 12)
    text = """# One camera and a checkerboard held by hand.
format = 1
title = "One camera"

[cameras.C1]
station = "tripod"
image_size_px = [1280, 1024]
station_from_camera = { treatment = "held" }       # the camera is the frame of its station
"""
    text += _LENS.format(name="C1")
    text += """
[stations.tripod]
motion = "fixed"
world_from_station = { treatment = "held" }        # and the station that of the world
"""
    return draft, {"survey.toml": text + _targets(draft), "truth.json": truth_json(draft.truth, seed)}


def stereo(seed: int) -> tuple[Draft, Files]:
    """Two cameras and a board held by hand."""
    draft = stereo_draft(seed, 12)
    text = """# Two cameras on a bar and a checkerboard held by hand; what is asked for is right to left.
format = 1
title = "Stereo"

[cameras.left]
station = "bar"
image_size_px = [1280, 1024]
station_from_camera = { treatment = "held" }       # the left camera is the frame of the bar
"""
    text += _LENS.format(name="left")
    text += """
[cameras.right]
station = "bar"
image_size_px = [1280, 1024]
"""
    text += _LENS.format(name="right")
    text += """
[stations.bar]
motion = "fixed"
world_from_station = { treatment = "held" }        # and the bar that of the world
"""
    return draft, {"survey.toml": text + _targets(draft), "truth.json": truth_json(draft.truth, seed)}


def _targets(draft: Draft) -> str:
    text = ""
    for target in draft.targets:
        seen_by = dict.fromkeys(s.camera_id for s in draft.shots if target.target_id in s.target_ids)
        text += target_text(target, draft.kinds[target.target_id])
        if len(seen_by) < len(draft.cameras):
            names = ", ".join(f'"{name}"' for name in seen_by)
            text += f"cameras = [{names}]    # only their images are searched for it\n"
    return text


def target_text(target: Target, kind: TargetKind) -> str:
    """A target, the world where it is held."""
    lines = [f"\n[targets.{target.target_id}]"]
    if isinstance(kind, Checkerboard):
        lines += ['kind = "checkerboard"', f"columns = {kind.columns}       # inner corners", f"rows = {kind.rows}"]
        lines += [f"square_mm = {1e3 * kind.square_m:.1f}"]
    elif isinstance(kind, Charuco):
        lines += ['kind = "charuco"', f"squares_x = {kind.squares_x}", f"squares_y = {kind.squares_y}"]
        lines += [f"square_mm = {1e3 * kind.square_m:.1f}", f"marker_mm = {1e3 * kind.marker_m:.1f}"]
        lines += [f'dictionary = "{kind.dictionary.removeprefix("DICT_")}"']
    elif isinstance(kind, MarkerGrid):
        lines += ['kind = "marker_grid"', f"columns = {kind.columns}", f"rows = {kind.rows}"]
        lines += [f"marker_mm = {1e3 * kind.marker_m:.1f}", f"gap_mm = {1e3 * kind.gap_m:.1f}"]
        lines += [f'dictionary = "{kind.dictionary.removeprefix("DICT_")}"', f"first_id = {kind.first_id}"]
    if target.motion == "epoch":
        lines.append('motion = "epoch"    # held by hand: another place in every image')
    elif target.carrier_from_target.treatment == "held":
        lines.append('pose = { treatment = "held" }    # this target is the world')
    return "\n".join(lines) + "\n"


def full_lab(seed: int) -> tuple[Draft, Files]:
    """Everything in one survey."""
    draft = full_lab_draft(seed)
    survey = observed(draft, seed, 0.1, TABLE_SIGMA_ARCSEC)
    surveyed = ((str(row.positions[0].point_id), row.values[0]) for row in survey.coordinates)
    return draft, {
        "survey.toml": _full_lab_toml(draft),
        "observations/table_angles.csv": _table_angles(survey),
        "observations/coordinates.csv": coordinates_text(surveyed, BEACON_SIGMA_MM),
        "observations/distances.csv": _distances(survey),
        "truth.json": truth_json(draft.truth, seed),
    }


def _full_lab_toml(draft: Draft) -> str:
    text = """# A laboratory: a head with three cameras on a two-axis table before a fixed board, plates of markers
# on the walls, beacons on walls and ceiling, and a relay station of four cameras that looks at all four walls.
# Images t..: the head on the table, board; h..: the head held by hand, board; w..: the head on the table, wall
# plates; n..: the head on the table, beacons in the dark; c..: ChArUco board before a relay camera; r01, q01: the
# relay station, wall plates by day and beacons in the dark.
format = 1
title = "Full lab"
"""
    text += "".join(map(camera_text, draft.cameras)) + head_on_table(_RELAY)
    return text + _targets(draft) + _points(draft) + _spots(draft)


_RELAY = """
[stations.relay]
motion = "fixed"
"""


def head_on_table(others: str = "") -> str:
    """A head on a table of two axes. others: stations between the two."""
    return f"""
[stations.head]
motion = "table"
table = "turntable"
mount_from_station = {{ treatment = "held" }}        # the frame of the head is that of the table's inner axis
{others}
[tables.turntable]
axes = ["x", "z"]                                  # outermost first
sigma_arcsec = {TABLE_SIGMA_ARCSEC:.1f}
world_from_table = {{ treatment = "free" }}
geometry = {{ free = ["non_orthogonality", "axis_offset"] }}
"""


def camera_text(camera: Camera) -> str:
    """A camera and its lens."""
    name = camera.camera_id
    columns, rows = camera.image_size
    text = f'\n[cameras.{name}]\nstation = "{camera.station_id}"\nimage_size_px = [{columns}, {rows}]\n'
    if camera.station_from_camera.treatment == "held":
        text += 'station_from_camera = { treatment = "held" }       # this camera is the frame of its station\n'
    return text + _LENS.format(name=name)


def _points(draft: Draft) -> str:
    text = "\n# Beacons; most have been surveyed (coordinates.csv), two are known roughly, by a folding rule.\n"
    for point in draft.points:
        text += f"[points.{point.point_id}]\n"
        if point.point_id in WITHOUT_COORDINATES:
            rough = ", ".join(f"{10.0 * round(100.0 * float(x)):.1f}" for x in _true_point(draft, point.point_id))
            text += f"x_mm = [{rough}]\n"
    return text


def _true_point(draft: Draft, point_id: str) -> FloatArray:
    return draft.scene().vector("point", point_id)


def _spots(draft: Draft) -> str:
    shots = [s for s in draft.shots if s.beacons]
    return spots_text((s.camera_id for s in shots), (s.epoch_id for s in shots), 2.0) + GIVEN


def spots_text(cameras: Iterable[str], epochs: Iterable[str], least_px: float) -> str:
    """Where beacons are looked for, and the size of their images at least."""
    names, times = (", ".join(f'"{name}"' for name in dict.fromkeys(x)) for x in (cameras, epochs))
    return f"""
[spots]                                            # images in which beacons are looked for
cameras = [{names}]
epochs = [{times}]
diameter_px = [{least_px}, 12.0]
gate_px = 15.0
"""


def _table_angles(survey: Survey) -> str:
    lines = ["epoch_id,table_id,axis1_deg,axis2_deg"]
    for reading in survey.table_readings:
        a1, a2 = np.degrees(reading.angles)
        lines.append(f"{reading.epoch_id},{reading.table_id},{a1:.6f},{a2:.6f}")
    return "\n".join(lines) + "\n"


def coordinates_text(found: Iterable[tuple[str, FloatArray]], sigma_mm: float) -> str:
    """The table of coordinates: points by name, (3,) m each."""
    lines, sigma = ["point_id,x_mm,y_mm,z_mm,sigma_x_mm,sigma_y_mm,sigma_z_mm"], f"{sigma_mm:.1f}"
    for name, x_in_world in found:
        x, y, z = 1e3 * x_in_world
        lines.append(f"{name},{x:.3f},{y:.3f},{z:.3f},{sigma},{sigma},{sigma}")
    return "\n".join(lines) + "\n"


def _distances(survey: Survey) -> str:
    lines = ["distance_id,from_id,to_id,value_mm,sigma_mm"]
    for row in survey.distances:
        lines.append(
            f"{row.distance_id},{row.a.point_id},{row.b.point_id},{1e3 * row.value:.3f},{DISTANCE_SIGMA_MM:.1f}"
        )
    return "\n".join(lines) + "\n"


MAKERS: dict[str, Callable[[int], tuple[Draft, Files]]] = {
    "full-lab": full_lab,
    "stereo": stereo,
    "one-camera": one_camera,
}


_NOTE = "true values of the simulation; nothing reads this file"
_ARCSEC = 180.0 / np.pi * 3600.0


def truth_json(truth: Truth, seed: int) -> str:
    """Every parameter by ``kind/id[/epoch]``, with units in the key names."""
    parameters = {"/".join(name): _value(name, value) for name, value in truth.items()}
    return json_text({"note": _NOTE, "seed": seed, "parameters": parameters})


def _value(name: ParameterName, value: Pose3 | FloatArray) -> dict[str, object]:
    if isinstance(value, Pose3):
        x, y, z, w = Rotation.from_matrix(value.rotation().matrix()).as_quat(canonical=True)
        return {
            "translation_mm": _listed(1e3 * value.translation()),
            "rotation_quaternion_wxyz": _listed(np.array([w, x, y, z])),
        }
    if name[0] == "lens":
        return dict(zip(BROWN, _listed(value), strict=True))
    if name[0] == "table_angles":
        return {"axis1_deg": float(np.degrees(value[0])), "axis2_deg": float(np.degrees(value[1]))}
    if name[0] == "table_geometry":
        factors = dict(zip(TABLE_GEOMETRY, (_ARCSEC, 1e3, 180.0 / np.pi, 180.0 / np.pi), strict=True))
        units = dict(zip(TABLE_GEOMETRY, ("arcsec", "mm", "deg", "deg"), strict=True))
        return {f"{n}_{units[n]}": float(v * factors[n]) for n, v in zip(TABLE_GEOMETRY, value, strict=True)}
    return {"x_mm": _listed(1e3 * value)}


def _listed(values: FloatArray) -> list[float]:
    return [float(value) for value in values]
