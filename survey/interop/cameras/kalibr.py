"""Kalibr's results: the chain of cameras (camchain) and the target, both YAML.

Pixels as here: the centre of the first one is (0, 0). ``T_cn_cnm1`` is ``camera_n from camera_(n-1)``; ``T_cam_imu``,
where cameras have no such chain, ``camera from imu``. An aprilgrid counts from its lower left tag, x right and y up, as
a block of markers can; its tags carry a double black frame.
"""

from pathlib import Path

import numpy as np
from gtsam import Pose3

from adjust.model.errors import SurveyError
from adjust.model.survey import LensParameter, Survey, Target
from survey.interop.cameras.rig import Rig, RigCamera, lens_of, pose_of, rig_network
from survey.interop.cameras.values import BROWN_4, FISHEYE_4, RigValues
from survey.interop.networks.foreign import ForeignNetwork, Where
from survey.interop.safe_yaml import Entry, read_yaml, yaml_text
from survey.project.targets import Checkerboard, MarkerBlock, PointList, TargetKind

CHOICES = {"brown": BROWN_4, "fisheye": FISHEYE_4}
_RADTAN = ("k1", "k2", "p1", "p2")
_EQUIDISTANT = ("k1", "k2", "k3", "k4")
_DICTIONARY = "APRILTAG_36H11"


def read_kalibr(path: Path) -> ForeignNetwork:
    """A camchain or a target. Raises SurveyError with file and line for what cannot be read."""
    root = read_yaml(path)
    if "target_type" in root:
        return _target_network(root, path)
    names = [n for n in root.mapping if n.startswith("cam") and n[3:].isdigit()]
    if not names:
        raise root.error("holds neither cam0 nor target_type; give a camchain or a target of Kalibr")
    names.sort(key=lambda n: int(n[3:]))
    cameras: list[RigCamera] = []
    chained = all("T_cn_cnm1" in root.get(n) for n in names[1:])
    notes: tuple[str, ...] = ()
    for name in names:
        entry = root.get(name)
        pose: Pose3 | None = None
        if chained:
            pose = Pose3() if not cameras else (cameras[-1].rig_from_camera or Pose3()) * _motion(entry, "T_cn_cnm1")
        elif "T_cam_imu" in entry:
            pose = _motion(entry, "T_cam_imu")
        else:
            raise entry.error("has neither T_cn_cnm1 nor T_cam_imu; every camera after the first needs one")
        cameras.append(RigCamera(name, entry.get("resolution").size(), _lens(entry), pose))
    if any("T_cam_imu" in root.get(n) for n in names) and chained:
        notes = ("left out: the IMU and its time shifts",)
    return rig_network(Rig("rig", tuple(cameras), notes), path)


def _motion(entry: Entry, key: str) -> Pose3:
    """The inverse of what the file gives: previous camera (or imu) from this one."""
    found = entry.get(key)
    return pose_of(found.numbers(4, 4), found.where).inverse()


def _lens(entry: Entry) -> LensParameter:
    model = entry.get("camera_model")
    if model.text != "pinhole":
        raise model.error(f"found {model.text!r}; only pinhole is read: omni, ds and eucm have no such lens here")
    fu, fv, pu, pv = entry.get("intrinsics").numbers(4).tolist()
    kind = entry.get("distortion_model")
    plain = {"fx": fu, "fy": fv, "u0": pu, "v0": pv}
    if kind.text == "none":
        return lens_of("brown", entry, **plain)
    if kind.text not in ("radtan", "equidistant"):
        raise kind.error(f"found {kind.text!r}; radtan, equidistant and none are read: fov has no such lens here")
    names, name = (_RADTAN, "brown") if kind.text == "radtan" else (_EQUIDISTANT, "fisheye")
    k = entry.get("distortion_coeffs").numbers(4).tolist()
    return lens_of(name, entry, **plain, **dict(zip(names, k, strict=True)))


def kalibr_files(found: RigValues) -> dict[str, str]:
    """The camchain: cameras in order as cam0, cam1 ..., their own names as topics."""
    chain: dict[str, object] = {}
    before: Pose3 | None = None
    for i, (camera, lens) in enumerate(zip(found.rig.cameras, found.lenses, strict=True)):
        pose = camera.rig_from_camera or Pose3()
        chain[f"cam{i}"] = {
            "cam_overlaps": [k for k in range(len(found.lenses)) if k != i], "camera_model": "pinhole",
            "distortion_coeffs": lens.distortion()[:4].tolist(),
            "distortion_model": "equidistant" if lens.model == "fisheye" else "radtan",
            "intrinsics": lens.array("fx", "fy", "u0", "v0").tolist(), "resolution": list(camera.image_size),
            "rostopic": f"/{camera.camera_id}/image_raw",
            **({} if before is None else {"T_cn_cnm1": (pose.inverse() * before).matrix().tolist()}),
        }  # fmt: skip
        before = pose
    return {"": yaml_text(chain)}


def _target_network(root: Entry, path: Path) -> ForeignNetwork:
    kind = read_target(root)
    ids, x = kind.points()
    survey = Survey(targets=(Target("target", ids, x, motion="epoch"),))
    notes: tuple[str, ...] = ()
    if isinstance(kind, MarkerBlock):
        notes = ("Kalibr's tags have a black frame of two cells: pictures of them are found by its own detector",)
    return ForeignNetwork(survey, path.stem, notes=notes, target_kinds={"target": kind})


def read_target(root: Entry) -> TargetKind:
    """A target of Kalibr; grids of circles become lists of points, row by row as its detector counts them."""
    name = root.get("target_type")
    if name.text == "checkerboard":
        columns, rows = root.get("targetCols").count(1000), root.get("targetRows").count(1000)
        dy, dx = _length(root, "rowSpacingMeters"), _length(root, "colSpacingMeters")
        if dx == dy:
            return Checkerboard(columns, rows, dx)
        plain = Checkerboard(columns, rows, 1.0).points()
        return PointList(plain[0], plain[1] * np.array([dx, dy, 1.0]))
    if name.text == "aprilgrid":
        return _aprilgrid(root)
    if name.text == "circlegrid":
        columns, rows = root.get("targetCols").count(1000), root.get("targetRows").count(1000)
        spacing = _length(root, "spacingMeters")
        shifted = "asymmetricGrid" in root and root.get("asymmetricGrid").text.lower() in ("1", "true", "yes")
        x = [(2 * c + r % 2, r) if shifted else (c, r) for r in range(rows) for c in range(columns)]
        ids, _ = Checkerboard(columns, rows, 1.0).points()
        return PointList(ids, spacing * np.column_stack([np.array(x, dtype=float), np.zeros(len(x))]))
    raise name.error(f"found {name.text!r}; checkerboard, aprilgrid and circlegrid are read")


def _length(root: Entry, key: str) -> float:
    entry = root.get(key)
    if not 0.0 < entry.number < 1e3:
        raise entry.error("expected a length in metres above zero; correct it")
    return entry.number


def _aprilgrid(root: Entry) -> MarkerBlock:
    columns, rows = root.get("tagCols").count(100), root.get("tagRows").count(100)
    size = _length(root, "tagSize")
    step = size * (1.0 + _length(root, "tagSpacing"))
    first = 0
    for key in ("startCornerId", "startId"):
        first = root.get(key).count() if key in root and root.get(key).number > 0.0 else first
    if columns * rows + first > 587:
        raise root.error(f"{columns} x {rows} tags from {first} on are more than the family 36h11 has; correct it")
    corners = {}
    for r in range(rows):
        for c in range(columns):
            x, y = c * step, r * step  # of the lower left corner
            corners[first + r * columns + c] = np.array(
                [[x, y + size, 0.0], [x + size, y + size, 0.0], [x + size, y, 0.0], [x, y, 0.0]]
            )
    return MarkerBlock(corners, _DICTIONARY)


def target_text(kind: TargetKind) -> str:
    """A target as Kalibr's YAML. Raises SurveyError for what Kalibr does not know."""
    if isinstance(kind, Checkerboard):
        return yaml_text({"target_type": "checkerboard", "targetCols": kind.columns, "targetRows": kind.rows,
                          "rowSpacingMeters": kind.square_m, "colSpacingMeters": kind.square_m})  # fmt: skip
    if isinstance(kind, MarkerBlock) and (found := _as_aprilgrid(kind)) is not None:
        return yaml_text({"target_type": "aprilgrid", **found})
    raise SurveyError(
        f"a {type(kind).__name__} is no target of Kalibr; it has checkerboards, and aprilgrids of the family 36h11 "
        "that count from the lower left"
    )


def _as_aprilgrid(kind: MarkerBlock) -> dict[str, int | float] | None:
    """Columns, rows, size and ratio of spacing by their keys where the block is an aprilgrid, to rounding."""
    n, first = len(kind.corners), kind.corners.get(0)
    if first is None or kind.dictionary.upper().removeprefix("DICT_") != _DICTIONARY or n < 4:
        return None
    size = float(first[1, 0] - first[0, 0])
    lower_left = np.array([kind.corners[i][3] for i in sorted(kind.corners)])
    columns = 1 + int(np.argmax(lower_left[1:, 1] > size)) if (lower_left[1:, 1] > size).any() else n
    if size <= 0.0 or columns < 2 or n % columns:
        return None
    ratio = float((lower_left[1, 0] - size) / size)
    found = {"tagCols": columns, "tagRows": n // columns, "tagSize": size, "tagSpacing": ratio}
    where = Where(Path("target"), 1)  # as if it stood in a file
    again = _aprilgrid(Entry(where, "", {k: Entry(where, k, repr(v)) for k, v in found.items()}))
    same = again.corners.keys() == kind.corners.keys() and all(
        np.allclose(again.corners[i], kind.corners[i], rtol=0, atol=1e-12) for i in again.corners
    )
    return found if same else None
