"""DBAT's script files (.xml) with the PhotoModeler-like tables that they name: a self-calibration.

Image coordinates are pixels with the origin at the corner of the first pixel, as the lens model ``brown_backward_dbat``
has them. Paths are taken relative to the script's folder and may not leave it.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from adjust.lenses.models import MODELS
from adjust.model.frozen import frozen
from adjust.model.survey import Camera, Datum, LensParameter, Point, PointParameter, Station
from survey.folder.text import suggestion
from survey.interop.cameras.rig import image_blocks, moving_camera
from survey.interop.networks.foreign import ForeignNetwork, Line, lines_of, number, positive
from survey.interop.safe_xml import Element, read_xml

_MODEL = MODELS["brown_backward_dbat"]
_FREE = {"cc": ("c",), "pp": ("px", "py"), "aspect": ("as",)}
_COLUMNS = ("id", "label", "im", "path", "x", "y", "z", "sx", "sy", "sz", "sxy", "sxyz", "ignored")


@frozen
class _Row:
    """One line of a table by the names in its format."""

    line: Line
    words: dict[str, str]

    def number(self, name: str) -> float:
        return number(self.words[name], name, self.line.where)


def read_dbat(path: Path) -> ForeignNetwork:
    """A network from a DBAT script. Raises SurveyError with file and line for what cannot be read."""
    root = read_xml(path, "document")
    source = root.one("input")
    listed = _table(source, "images", "id path")
    images = {row.words["id"]: Path(row.words["path"].replace("\\", "/")).stem for row in listed}
    camera = _camera(source, root.one("operations"))
    control = [_control(row) for row in _table(source, "ctrl_pts", "id x y z", optional=True)]
    points = {p.point_id: p for p in control}
    rows: dict[tuple[str, str], list[tuple[str, float, float, float]]] = {}
    for row in _table(source, "image_pts", "im id x y"):
        image, point = row.words["im"], row.words["id"]
        if image not in images:
            raise row.line.where.error(f"image {image!r} is not in the list of images; {suggestion(image, images)}")
        sigma = positive(row.words.get("sxy", "1"), "sxy", row.line.where)
        rows.setdefault(("camera", images[image]), []).append((point, row.number("x"), row.number("y"), sigma))
    least = _least_rays(root)
    counts: dict[str, int] = {}
    for block in rows.values():
        for point in dict.fromkeys(row[0] for row in block):
            counts[point] = counts.get(point, 0) + 1
    keep = {p for p, n in counts.items() if n >= least or p in points}
    rows = {key: [row for row in block if row[0] in keep] for key, block in rows.items()}
    ordered = [points.get(p, Point(p)) for p in counts if p in keep]
    dropped = len(counts) - len(keep)
    notes = (f"left out, points seen in fewer than {least} images: {dropped}",) if dropped else ()
    survey = replace(image_blocks(rows, ordered), cameras=(camera[0],), stations=(camera[1],), datum=_datum(ordered))
    return ForeignNetwork(survey, _title(root, path), 1.0, "a_posteriori", notes=notes)


def _datum(points: list[Point]) -> Datum:
    given = any(p.x_in_world.treatment != "free" for p in points)
    return Datum() if given else Datum("inner")


def _title(root: Element, path: Path) -> str:
    names = [e.text.strip() for meta in root.all("meta") for e in meta.all("name")]
    return names[0] if names else path.stem


def _text(parent: Element, tag: str, default: str | None = None) -> str:
    if default is not None and not parent.all(tag):
        return default
    return parent.one(tag).text.strip()


def _table(source: Element, tag: str, needed: str, optional: bool = False) -> list[_Row]:
    """The rows of all files that <tag> names, by the columns of their format."""
    if optional and not source.all(tag):
        return []
    rows = []
    for file in source.one(tag).all("file"):
        columns = [c.strip() for c in file.get("format").split(",")]
        for column in columns:
            if column not in _COLUMNS:
                raise file.error(f"format: unknown column {column!r}; {suggestion(column, _COLUMNS)}")
        missing = [c for c in needed.split() if c not in columns]
        if missing:
            raise file.error(f"format: the columns {', '.join(missing)} are missing; add them")
        for line in lines_of(_inside(file), "#"):
            words = [w.strip() for w in line.text.split(",")]
            if len(words) != len(columns):
                raise line.where.error(f"found {len(words)} fields, the format has {len(columns)}")
            rows.append(_Row(line, dict(zip(columns, words, strict=True))))
    return rows


def _inside(file: Element) -> Path:
    folder = file.where.path.parent
    path = folder / file.text.strip()
    if not path.resolve().is_relative_to(folder.resolve()):
        raise file.error(f"{file.text.strip()!r} is not inside the script's folder; move it there")
    return path


def _control(row: _Row) -> Point:
    """Held where no deviation is given or it is zero, else with a prior."""
    own = [n for n in ("sx", "sy", "sz") if n in row.words]
    names: list[str] = [*own] or ["sxyz"] * (3 if "sxyz" in row.words else 0)
    sigma = np.array([row.number(n) for n in names])
    if (sigma < 0.0).any() or len(sigma) not in (0, 3) or (sigma.any() and not sigma.all()):
        raise row.line.where.error("a control point has three deviations above zero, or none; correct it")
    value = np.array([row.number(n) for n in "xyz"])
    if not sigma.any():
        return Point(row.words["id"], PointParameter(value, "held"))
    return Point(row.words["id"], PointParameter(value, "prior", np.diag(sigma**2)))


def _camera(source: Element, operations: Element) -> tuple[Camera, Station]:
    cameras = source.one("cameras").all("camera")
    if len(cameras) != 1:
        raise source.error(f"expected one <camera> written out in the script, found {len(cameras)}")
    camera = cameras[0]
    model = _text(camera, "model", "3")
    if model != "3" or _text(camera, "unit", "mm") != "mm" or _text(camera, "aspect", "1") != "1":
        raise camera.error("only lens model 3 in mm with square pixels (aspect 1) is read")
    width, height = _pair(camera, "image")
    size = (int(number(width, "image", camera.where)), int(number(height, "image", camera.where)))
    pixel = _pixel_mm(camera, size)
    values = np.zeros(_MODEL.n)
    values[0] = positive(_text(camera, "focal"), "focal", camera.where)
    values[1:3] = size[0] / 2 * pixel, size[1] / 2 * pixel
    lens = LensParameter(_MODEL.name, _free(camera, operations), values, pixel_size_mm=pixel)
    return moving_camera("camera", size, lens)


def _pair(camera: Element, tag: str) -> tuple[str, str]:
    words = _text(camera, tag).split(",")
    if len(words) != 2:
        raise camera.error(f"{tag} has two numbers, found {len(words)}")
    return words[0].strip(), words[1].strip()


def _pixel_mm(camera: Element, size: tuple[int, int]) -> float:
    sensor = _pair(camera, "sensor")
    if min(size) < 1:
        raise camera.error(f"the image has {size[0]} x {size[1]} pixels; correct it")
    found = [positive(s, "sensor", camera.where) / n for s, n in zip(sensor, size, strict=True) if s != "auto"]
    if not found or max(found) / min(found) > 1.0 + 1e-4:
        raise camera.error(f"sensor {', '.join(sensor)} gives no square pixels; correct it")
    return found[-1]


def _free(camera: Element, operations: Element) -> tuple[str, ...]:
    """The lens parameters that the script estimates."""
    wanted = [p for o in operations.children for p in o.all("set_bundle_estimate_params")]
    flags = {e.tag: e.text.strip() for p in wanted for io in p.all("io") for e in io.children}
    names = dict(_FREE)
    for tag, letter in (("nK", "K"), ("nP", "P")):
        n = int(number(_text(camera, tag, "0"), tag, camera.where))
        names[letter] = tuple(f"{letter}{k + 1}" for k in range(n))
        if not set(names[letter]) <= set(_MODEL.names):
            raise camera.error(f"{tag} is {n}, more than the lens model has")
    default = flags.get("all", "false")
    if "skew" in flags and flags["skew"] == "true":
        raise camera.error("skew is to be estimated, which this lens model does not have; set it to false")
    free = {n for key, group in names.items() if flags.get(key, default) == "true" for n in group}
    return tuple(n for n in _MODEL.names if n in free)


def _least_rays(root: Element) -> int:
    for operation in root.one("operations").children:
        if operation.text.strip() == "check_ray_count":
            return max(2, int(operation.number("min_rays", 2.0)))
    return 2
