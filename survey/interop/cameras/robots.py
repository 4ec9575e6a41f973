"""Fixed frames for robots: URDF and SDF, links of stations and cameras joined by fixed joints.

``origin`` (URDF) and ``pose`` (SDF) are parent from child: xyz in metres and rpy in radians, R = Rz(y) Ry(p) Rx(r).
Cameras are written as their optical frames (x right, y down, z forward), ``<camera_id>_optical_frame``. Neither format
holds lenses, moving poses or covariances.
"""

import xml.sax.saxutils
from pathlib import Path

import numpy as np
from gtsam import Pose3, Rot3
from scipy.spatial.transform import Rotation

from adjust.model.errors import SurveyError, listed
from adjust.model.frozen import frozen
from adjust.model.observations import FrameRef
from adjust.model.survey import FloatArray, PoseParameter, Station, Survey
from survey.folder.text import id_problem
from survey.interop.cameras.ros import FRAME
from survey.interop.cameras.values import CameraValues
from survey.interop.networks.foreign import ForeignNetwork, Where, number
from survey.interop.safe_xml import Element, read_xml

_WORLD = "world"
_MOST_LINKS = 10_000


@frozen(eq=False)
class Link:
    """A frame fixed to its parent: ``parent_from_link``."""

    name: str
    parent: str
    pose: Pose3
    where: Where


def read_urdf(path: Path) -> ForeignNetwork:
    """Links on fixed joints as stations. Raises SurveyError with file and line for what cannot be read."""
    root = read_xml(path, "robot")
    links = []
    skipped = 0
    for joint in root.all("joint"):
        if joint.get("type") != "fixed":
            skipped += 1
            continue
        origin = next(iter(joint.all("origin")), None)
        xyz, rpy = (_numbers(origin, name, 3) if origin is not None else np.zeros(3) for name in ("xyz", "rpy"))
        child, parent = (joint.one(tag).get("link") for tag in ("child", "parent"))
        links.append(Link(child, parent, _pose(xyz, rpy), joint.where))
    return _network(path, links, (f"left out, joints that move: {skipped}",) if skipped else ())


def read_sdf(path: Path) -> ForeignNetwork:
    """Links and frames of a model as stations. Raises SurveyError with file and line for what cannot be read."""
    root = read_xml(path, "sdf")
    models = [*root.all("model"), *(model for world in root.all("world") for model in world.all("model"))]
    if len(models) != 1:
        raise root.error(f"found {len(models)} models; one is expected")
    links = []
    for entry in models[0].children:
        if entry.tag not in ("link", "frame"):
            continue
        pose, numbers, parent = next(iter(entry.all("pose")), None), np.zeros(6), _WORLD
        if pose is not None:
            words = pose.text.split()
            if len(words) != 6:
                raise pose.error(f"found {len(words)} numbers; a pose is x y z roll pitch yaw")
            numbers = np.array([number(w, "pose", pose.where) for w in words])
            parent = pose.attributes.get("relative_to") or entry.attributes.get("attached_to") or _WORLD
        parent = _WORLD if parent == "__model__" else parent
        if entry.get("name") != _WORLD:
            links.append(Link(entry.get("name"), parent, _pose(numbers[:3], numbers[3:]), entry.where))
    return _network(path, links, ())


def _numbers(origin: Element, name: str, count: int) -> FloatArray:
    words = origin.attributes.get(name, "0 0 0").split()
    if len(words) != count:
        raise origin.error(f"{name}: found {len(words)} numbers, expected {count}")
    return np.array([number(w, name, origin.where) for w in words])


def _pose(xyz: FloatArray, rpy: FloatArray) -> Pose3:
    return Pose3(Rot3(Rotation.from_euler("xyz", rpy).as_matrix()), xyz)


def _network(path: Path, links: list[Link], notes: tuple[str, ...]) -> ForeignNetwork:
    """Every link as a fixed station at its place below the root, which is the world."""
    if not links or len(links) > _MOST_LINKS:
        raise SurveyError(f"{path}: found {len(links)} fixed links; 1 to {_MOST_LINKS} are read")
    by_name: dict[str, Link] = {}
    for link in links:
        if (problem := id_problem(link.name)) is not None:
            raise link.where.error(problem)
        if link.name in by_name:
            raise link.where.error(f"link {link.name!r} has two parents; remove one")
        by_name[link.name] = link
    places: dict[str, Pose3] = {}
    for link in links:
        chain = [link]
        while chain[-1].parent in by_name and chain[-1].parent not in places:
            chain.append(by_name[chain[-1].parent])
            if len(chain) > len(links):
                raise link.where.error(f"link {link.name!r} hangs on itself; open the loop")
        for each in reversed(chain):
            places[each.name] = places.get(each.parent, Pose3()) * each.pose
    roots = list(dict.fromkeys(link.parent for link in links if link.parent not in by_name))
    if len(roots) > 1:
        raise links[0].where.error(f"found several roots, {listed(roots, 5)}; join them by fixed joints")
    stations = tuple(Station(n, world_from_station=PoseParameter(p)) for n, p in places.items() if n != _WORLD)
    return ForeignNetwork(Survey(stations=stations), path.stem, notes=notes)


def fixed_links(values: CameraValues, station: str | None) -> tuple[list[Link], tuple[str, ...]]:
    """Stations that stand still below the world with their cameras; what has no fixed place, for people."""
    links, left = [], []
    where = Where(Path("survey"), 1)
    shown = [s for s in values.survey.stations if station in (None, s.station_id)]
    if station is not None and not shown:
        raise SurveyError(f"station {station!r} is not known; choose one of the project's")
    moving = [s for s in shown if s.motion != "fixed"]
    if len(moving) > 1 or (moving and len(shown) > 1):
        left = [f"left out, station {s.station_id}: it moves; its own file: --station {s.station_id}" for s in moving]
        moving = []
    for s in shown:
        if s.motion == "fixed":
            links.append(Link(s.station_id, _WORLD, values.world_from(FrameRef("station", s.station_id)), where))
        elif s in moving:
            left.append(f"station {s.station_id} moves: its link is the root, without a place in the world")
        else:
            continue
        links += [Link(f"{c.camera_id}{FRAME}", s.station_id, values.station_from_camera(c), where)
                  for c in values.survey.cameras if c.station_id == s.station_id]  # fmt: skip
    if not links:
        raise SurveyError("nothing of the project stands still; choose a station with --station")
    return links, tuple(left)


def _roots(links: list[Link]) -> list[str]:
    names = {link.name for link in links}
    return list(dict.fromkeys(link.parent for link in links if link.parent not in names))


def _rpy(pose: Pose3) -> FloatArray:
    return np.asarray(pose.rotation().rpy())


def _words(values: FloatArray) -> str:
    return " ".join(repr(float(v)) for v in values)


def _quoted(text: str) -> str:
    return xml.sax.saxutils.quoteattr(text)


def urdf_files(values: CameraValues, station: str | None) -> tuple[dict[str, str], tuple[str, ...]]:
    """A URDF with fixed joints, and what was left out."""
    links, left = fixed_links(values, station)
    lines = ['<?xml version="1.0"?>', f"<robot name={_quoted(values.title or 'survey')}>"]
    lines += [f"  <link name={_quoted(n)}/>" for n in (*_roots(links), *(link.name for link in links))]
    for link in links:
        lines += [f'  <joint name={_quoted(f"{link.name}_joint")} type="fixed">']
        lines += [f"    <parent link={_quoted(link.parent)}/>", f"    <child link={_quoted(link.name)}/>"]
        xyz, rpy = _words(link.pose.translation()), _words(_rpy(link.pose))
        lines += [f'    <origin xyz="{xyz}" rpy="{rpy}"/>', "  </joint>"]
    return {"": "\n".join([*lines, "</robot>", ""])}, left


def sdf_files(values: CameraValues, station: str | None) -> tuple[dict[str, str], tuple[str, ...]]:
    """An SDF model of links and fixed joints, and what was left out."""
    links, left = fixed_links(values, station)
    roots = _roots(links)
    lines = ['<?xml version="1.0"?>', '<sdf version="1.9">', f"  <model name={_quoted(values.title or 'survey')}>"]
    lines += [f"    <link name={_quoted(n)}/>" for n in roots if n != _WORLD]
    for link in links:
        relative = "__model__" if link.parent == _WORLD else link.parent
        pose = f"{_words(link.pose.translation())} {_words(_rpy(link.pose))}"
        lines += [f"    <link name={_quoted(link.name)}>"]
        lines += [f"      <pose relative_to={_quoted(relative)}>{pose}</pose>", "    </link>"]
    for link in links:
        parent = f"<parent>{xml.sax.saxutils.escape(link.parent)}</parent>"
        child = f"<child>{xml.sax.saxutils.escape(link.name)}</child>"
        lines += [f'    <joint name={_quoted(f"{link.name}_joint")} type="fixed">{parent}{child}</joint>']
    return {"": "\n".join([*lines, "  </model>", "</sdf>", ""])}, left
