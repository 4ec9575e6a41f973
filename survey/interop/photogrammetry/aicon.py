"""AICON's files of a bundle adjustment, as JAiCov reads them: .phc .ior and, where they are there, .eor .obc .scale.

Image coordinates are mm from the image's centre, y up; images and points have numbers. A report (.htm) beside the
files tells the a priori deviations of the image points, which of them were adjusted and which lens parameters were
free; without it every deviation is ``SIGMA_MM`` and A3, C1 and C2 keep their values. Where the report itself is given
to read, its image coordinates are taken too, which it rounds to 1e-6 mm.
"""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from adjust.lenses.models import MODELS
from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.observations import Distance, PositionRef
from adjust.model.survey import Datum, LensParameter, Point, PointParameter, PoseParameter, Survey
from survey.interop.cameras.rig import image_blocks, moving_camera, world_from_camera
from survey.interop.networks.foreign import MM, ForeignNetwork, Line, lines_of, number, positive, text_of

SIGMA_MM = 0.0005
ENDINGS = (".phc", ".ior", ".eor", ".obc", ".scale")
_NAMES = MODELS["aicon"].names
_USUALLY_FREE = tuple(n for n in _NAMES if n not in ("A3", "C1", "C2"))
_OBSERVED = re.compile(r"\s*(\d+)\s+(\d+)((?:\s+-?\d+\.\d+){10})\s*")
_REPORT_NAMES = {"Ck": "ck", "Xh": "xh", "Yh": "yh"}
_PARAMETER = re.compile(r"\s*(Ck|Xh|Yh|A1|A2|A3|B1|B2|C1|C2)\s*:\s*\S+\s+(\S+)\s*")


@frozen
class _Camera:
    """One camera of the .ior file; image size in mm and pixels."""

    lens: LensParameter
    size: tuple[int, int]
    pixel_mm: float


@frozen
class _Report:
    """What the report adds: x, y and their deviations (mm) by (image, point), the free parameters."""

    rows: dict[tuple[str, str], tuple[float, float, float, float]]
    free: tuple[str, ...]


def read_aicon(path: Path) -> ForeignNetwork:
    """A network from the files beside ``path`` that have its name. Raises SurveyError with file and line.

    path: of any of the files; of the report where its image coordinates are to be taken.
    """
    files = {ending: path.with_suffix(ending) for ending in ENDINGS}
    for ending in (".phc", ".ior"):
        if not files[ending].is_file():
            raise SurveyError(f"{files[ending]}: is not there; image points (.phc) and cameras (.ior) are needed")
    there = {ending for ending, file in files.items() if file.is_file()}
    report = next((p for p in (path.with_suffix(e) for e in (".htm", ".html")) if p.is_file()), None)
    said = _report(report) if report else _Report({}, _USUALLY_FREE)
    cameras = _cameras(files[".ior"], said.free)
    images = _images(files[".eor"], cameras) if ".eor" in there else {}
    points = _points(files[".obc"]) if ".obc" in there else {}
    from_report = path.suffix in (".htm", ".html")
    survey = _survey(files[".phc"], cameras, images, points, said, from_report)
    distances = _distances(files[".scale"], {p.point_id for p in survey.points}) if ".scale" in there else ()
    notes = () if report else (f"no report beside the files: image points have {SIGMA_MM} mm, A3, C1, C2 are held",)
    survey = replace(survey, distances=distances, datum=Datum("inner"))
    return ForeignNetwork(survey, path.stem, SIGMA_MM, "a_posteriori", notes=notes)


def _report(path: Path) -> _Report:
    rows: dict[tuple[str, str], tuple[float, float, float, float]] = {}
    free: list[str] = []
    seen: set[str] = set()
    for line in text_of(path).splitlines():
        if (row := _OBSERVED.fullmatch(line)) is not None:
            x, y, _, _, sigma_x, sigma_y, *_ = (float(word) for word in row[3].split())
            rows[row[2], row[1]] = (x, y, sigma_x, sigma_y)
        elif (parameter := _PARAMETER.fullmatch(line)) is not None and parameter[1] not in seen:
            seen.add(parameter[1])
            free += [] if parameter[2] == "fest" else [_REPORT_NAMES.get(parameter[1], parameter[1])]
    if not rows or not free:
        raise SurveyError(f"{path}: is no report of a bundle adjustment; remove it or give the right one")
    return _Report(rows, tuple(free))


def _cameras(path: Path, free: tuple[str, ...]) -> dict[str, _Camera]:
    """Blocks of five lines: ck xh yh A1 A2 r0 / A3 / B1 B2 / C1 C2 / size in mm and pixels; ck is negative."""
    lines = list(lines_of(path))
    if not lines or len(lines) % 5:
        raise SurveyError(f"{path}: found {len(lines)} lines; a camera has five")
    cameras = {}
    for k in range(0, len(lines), 5):
        counts = (8, 1, 2, 2, 4)
        for line, count in zip(lines[k : k + 5], counts, strict=True):
            if len(line.words) != count:
                raise line.where.error(f"found {len(line.words)} words, expected {count}")
        rows = [line.numbers(line.words, "camera") for line in lines[k : k + 5]]
        _, _, ck, xh, yh, a1, a2, r0 = rows[0]
        values = np.array([-ck, xh, yh, a1, a2, *rows[1], *rows[2], *rows[3]])
        width_mm, height_mm, width, height = rows[4]
        where = lines[k + 4].where
        if not (ck < 0.0 and min(rows[4]) > 0.0 and width == int(width) and height == int(height)):
            raise where.error("ck is negative, the sizes positive and in whole pixels; correct the camera")
        pixel = width_mm / width
        if abs(height_mm / height / pixel - 1.0) > 1e-4:
            raise where.error(f"pixels of {pixel:g} x {height_mm / height:g} mm are not square; correct the size")
        lens = LensParameter("aicon", free, values, pixel_size_mm=pixel, balance_radius_mm=r0)
        cameras[lines[k].words[0]] = _Camera(lens, (int(width), int(height)), pixel)
    return cameras


def _images(path: Path, cameras: dict[str, _Camera]) -> dict[str, tuple[str, PoseParameter]]:
    """By image number its camera and pose, a start value."""
    images = {}
    for line in lines_of(path):
        if len(line.words) < 8:
            raise line.where.error(f"found {len(line.words)} words; expected image, camera, X Y Z, omega phi kappa")
        image, camera, *words = line.words
        if camera not in cameras:
            raise line.where.error(f"camera {camera} is not in the .ior file")
        row = np.array(line.numbers(words[:6], f"image {image}"))
        images[image] = (camera, PoseParameter(world_from_camera(row[3:], row[:3] * MM)))
    return images


def _points(path: Path) -> dict[str, Point]:
    points = {}
    for line in lines_of(path):
        if len(line.words) < 4:
            raise line.where.error(f"found {len(line.words)} words; expected point, X Y Z")
        name = line.words[0]
        points[name] = Point(name, PointParameter(np.array(line.numbers(line.words[1:4], f"point {name}")) * MM))
    return points


def _survey(
    path: Path,
    cameras: dict[str, _Camera],
    images: dict[str, tuple[str, PoseParameter]],
    points: dict[str, Point],
    said: _Report,
    from_report: bool,
) -> Survey:
    rows: dict[tuple[str, str], list[tuple[str, float, float, float]]] = {}
    only = next(iter(cameras)) if len(cameras) == 1 else None
    for line in lines_of(path):
        image, point, x, y, used = _image_point(line)
        camera_id = images[image][0] if image in images else only
        if camera_id is None:
            raise line.where.error(f"image {image} is not in the .eor file, and there are several cameras; add it")
        row = said.rows.get((image, point), None if said.rows else (x, y, SIGMA_MM, SIGMA_MM))
        if not used or row is None:
            continue
        sigma = row[2]
        if not (sigma == row[3] > 0.0):
            raise line.where.error(f"the report's deviations {row[2:]} of x and y differ or are zero; make them equal")
        x, y = row[:2] if from_report else (x, y)
        camera = cameras[camera_id]
        u = x / camera.pixel_mm + (camera.size[0] - 1) / 2
        v = (camera.size[1] - 1) / 2 - y / camera.pixel_mm
        rows.setdefault((f"camera{camera_id}", image), []).append((point, u, v, sigma / camera.pixel_mm))
    if not rows:
        raise SurveyError(f"{path}: no image point is used; is this the file of image coordinates?")
    seen = list(dict.fromkeys(row[0] for block in rows.values() for row in block))
    survey = image_blocks(rows, [points.get(name, Point(name)) for name in seen])
    pairs = []
    for number_, camera in cameras.items():
        start = {image: pose for image, (own, pose) in images.items() if own == number_ and
                 (f"camera{number_}", image) in rows}  # fmt: skip
        pairs.append(moving_camera(f"camera{number_}", camera.size, camera.lens, start))
    return replace(survey, cameras=tuple(c for c, _ in pairs), stations=tuple(s for _, s in pairs))


def _image_point(line: Line) -> tuple[str, str, float, float, bool]:
    """Image, point, x, y (mm), whether it is used."""
    words = line.words
    if len(words) < 4:
        raise line.where.error(f"found {len(words)} words; expected image, point, x, y")
    x, y = line.numbers(words[2:4], "image coordinates")
    return words[0], words[1], x, y, len(words) < 10 or words[9] == "1"


def _distances(path: Path, points: set[str]) -> tuple[Distance, ...]:
    out: list[Distance] = []
    for line in lines_of(path):
        found = re.fullmatch(r"\S+\s+\"([^\"]*)\"\s+(\S+)\s+(\S+)\s+(\S+)\s+(\S+)(\s+\S+)?", line.text)
        if found is None:
            raise line.where.error('expected a number, "name", two points, the distance and its deviation (mm)')
        for name in (found[2], found[3]):
            if name not in points:
                raise line.where.error(f"point {name!r} has no image points; remove the distance")
        value, sigma = number(found[4], "distance", line.where), positive(found[5], "deviation", line.where)
        a, b = PositionRef(found[2]), PositionRef(found[3])
        used = (found[6] or "1").strip() != "0"
        out.append(Distance(f"scale{len(out) + 1}", a, b, value * MM, sigma * MM, used=used))
    return tuple(out)
