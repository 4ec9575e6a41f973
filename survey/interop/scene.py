"""The survey as a scene for viewers: PLY (points, ellipsoids as a mesh) and GLB (binary glTF 2.0).

Metres in the survey's world; in GLB a node above all turns z up into glTF's y up. Ellipsoids are those of 95 %
confidence of beacons, enlarged by a factor that the file states; cameras are glTF cameras (x right, y up, looking
along -z) and stand where the first epoch has them.
"""

import json
import struct
from collections.abc import Mapping

import numpy as np
from gtsam import Pose3

from adjust.lenses.models import MODELS, camera_constants, focal_length_px
from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.observations import FrameRef
from adjust.model.survey import Camera, FloatArray, IntArray
from survey.interop.cameras.values import CameraValues

CHI2_95 = 7.814727903251179
"""The 95 % quantile of chi-square with 3 degrees of freedom: semi-axes are its root times sigma."""
_SHARE = 0.02
_COLORS = {"beacon": (214, 39, 40), "target": (31, 119, 180), "camera": (44, 160, 44)}
_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


@frozen(eq=False)
class Scene:
    """What is drawn, in the world. ellipsoids: by beacon, (4, 4) of the unit sphere, not enlarged; its cov (3, 3)."""

    title: str
    beacons: dict[str, FloatArray]
    targets: dict[str, FloatArray]
    cameras: dict[str, tuple[Camera, Pose3, float]]
    ellipsoids: dict[str, tuple[FloatArray, FloatArray]]
    enlarged: float


def scene(values: CameraValues) -> Scene:
    """The places of a survey. Raises SurveyError where it has none."""
    beacons = {p.point_id: x for p in values.survey.points if (x := values.point(p.point_id)) is not None}
    targets: dict[str, FloatArray] = {}
    for target in values.survey.targets:
        epochs = [b.epoch_id for b in values.survey.image_blocks if b.target_id == target.target_id]
        pose = values.frames.world_from(FrameRef("target", target.target_id, epochs[0] if epochs else None))
        if pose is not None:
            targets[target.target_id] = np.asarray(pose.transformFrom(values.x_in_target(target).T)).T
    cameras = {}
    for camera in values.survey.cameras:
        seen = [b.epoch_id for b in values.survey.image_blocks if b.camera_id == camera.camera_id]
        pose = values.frames.world_from(FrameRef("camera", camera.camera_id, seen[0] if seen else None))
        if pose is not None:
            lens = values.lens(camera)
            focal = focal_length_px(MODELS[camera.lens.model], lens, camera_constants(camera))
            cameras[camera.camera_id] = (camera, pose, focal)
    if not (beacons or targets or cameras):
        has_any = values.survey.points or values.survey.targets or values.survey.cameras
        raise SurveyError("nothing of the project has a place yet; adjust it first" if has_any else
                          "the project has no points, targets or cameras; scenes hold nothing else")  # fmt: skip
    ellipsoids = {}
    for name, x in beacons.items():
        cov = values.cov("point", name)
        if cov is not None and cov.any():
            ellipsoids[name] = (_ellipsoid(x, cov), cov)
    return Scene(values.title, beacons, targets, cameras, ellipsoids, _enlarged(beacons, targets, cameras, ellipsoids))


def _ellipsoid(x: FloatArray, cov: FloatArray) -> FloatArray:
    """The unit sphere's map (4, 4) to an ellipsoid of 95 %; no axis is quite zero, so that viewers can invert it."""
    variances, axes = np.linalg.eigh(cov)
    axes = axes * np.sign(np.linalg.det(axes))
    semi = np.sqrt(CHI2_95 * np.maximum(variances, 1e-9 * variances[-1]))
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = axes * semi, x
    return out


def _enlarged(
    beacons: Mapping[str, FloatArray], targets: Mapping[str, FloatArray],
    cameras: Mapping[str, tuple[Camera, Pose3, float]], ellipsoids: Mapping[str, tuple[FloatArray, FloatArray]],
) -> float:  # fmt: skip
    """1, 2 or 5 times a power of ten that makes the middle ellipsoid a fiftieth of the scene."""
    if not ellipsoids:
        return 1.0
    places = [*beacons.values(), *(x for xs in targets.values() for x in xs)]
    places += [np.asarray(pose.translation()) for _, pose, _ in cameras.values()]
    size = float(np.ptp(np.array(places), axis=0).max()) or 1.0
    longest = float(np.median([np.linalg.norm(m[:3, :3], axis=0).max() for m, _ in ellipsoids.values()]))
    wanted = _SHARE * size / longest
    power = 10.0 ** np.floor(np.log10(wanted))
    return float(max(1.0, power * max(f for f in (1.0, 2.0, 5.0) if f * power <= wanted * (1.0 + 1e-12))))


def enlarged(matrix: FloatArray, factor: float) -> FloatArray:
    """The map of the unit sphere with its axes times ``factor``."""
    out = matrix.copy()
    out[:3, :3] *= factor
    return out


def sphere(n: int = 12) -> tuple[FloatArray, IntArray]:
    """A unit sphere: vertices (m, 3) and triangles (k, 3), counter-clockwise from outside."""
    rings = np.pi * np.arange(1, n) / n
    turns = 2.0 * np.pi * np.arange(2 * n) / (2 * n)
    ring = [(np.sin(a) * np.cos(b), np.sin(a) * np.sin(b), np.cos(a)) for a in rings for b in turns]
    vertices = np.array([(0.0, 0.0, 1.0), *ring, (0.0, 0.0, -1.0)])
    m, last = 2 * n, len(vertices) - 1
    faces = [(0, 1 + k, 1 + (k + 1) % m) for k in range(m)]
    for r in range(n - 2):
        a, b = 1 + r * m, 1 + (r + 1) * m
        for k in range(m):
            j = (k + 1) % m
            faces += [(a + k, b + k, b + j), (a + k, b + j, a + j)]
    low = 1 + (n - 2) * m
    faces += [(last, low + (k + 1) % m, low + k) for k in range(m)]
    return vertices, np.array(faces, dtype=np.int64)


# ----------------------------------------------------------------------------------------------------------------- PLY


def ply_bytes(found: Scene) -> bytes:
    """Binary PLY, little endian: coloured vertices; the triangles are the ellipsoids."""
    points = [(x, _COLORS["beacon"]) for x in found.beacons.values()]
    points += [(x, _COLORS["target"]) for xs in found.targets.values() for x in xs]
    points += [(np.asarray(pose.translation()), _COLORS["camera"]) for _, pose, _ in found.cameras.values()]
    xyz = [np.array([x for x, _ in points]).reshape(-1, 3)]
    colors = [np.array([c for _, c in points], dtype=np.uint8).reshape(-1, 3)]
    unit, triangles = sphere()
    faces, start = [], len(points)
    for matrix, _ in found.ellipsoids.values():
        big = enlarged(matrix, found.enlarged)
        xyz.append(unit @ big[:3, :3].T + big[:3, 3])
        colors.append(np.tile(np.array(_COLORS["beacon"], dtype=np.uint8), (len(unit), 1)))
        faces.append(triangles + start)
        start += len(unit)
    vertices = np.zeros(start, dtype=[("xyz", "<f8", 3), ("rgb", "u1", 3)])
    vertices["xyz"], vertices["rgb"] = np.concatenate(xyz), np.concatenate(colors)
    joined = np.concatenate(faces) if faces else np.zeros((0, 3), dtype=np.int64)
    indices = np.zeros(len(joined), dtype=[("n", "u1"), ("idx", "<i4", 3)])
    indices["n"], indices["idx"] = 3, joined
    header = ["ply", "format binary_little_endian 1.0", f"comment labsurvey, metres; {_said(found)}"]
    header += [f"element vertex {len(vertices)}", *(f"property double {a}" for a in "xyz")]
    header += [*(f"property uchar {c}" for c in ("red", "green", "blue")), f"element face {len(indices)}"]
    header += ["property list uchar int vertex_indices", "end_header", ""]
    return "\n".join(header).encode("ascii") + vertices.tobytes() + indices.tobytes()


def _said(found: Scene) -> str:
    return f"ellipsoids of 95 % confidence, enlarged {found.enlarged:g} times" if found.ellipsoids else "no ellipsoids"


# ----------------------------------------------------------------------------------------------------------------- GLB


class _Buffer:
    """The binary part of a GLB with its views and accessors."""

    def __init__(self) -> None:
        self.data = b""
        self.views: list[dict[str, object]] = []
        self.accessors: list[dict[str, object]] = []

    def add(self, array: FloatArray | IntArray, target: int) -> int:
        """An array as an accessor: (n, 3) float positions (target 34962) or indices (34963); its number."""
        positions = target == 34962
        plain = np.ascontiguousarray(array, dtype="<f4" if positions else "<u4")
        self.views.append({"buffer": 0, "byteOffset": len(self.data), "byteLength": plain.nbytes, "target": target})
        self.data += plain.tobytes()
        entry: dict[str, object] = {"bufferView": len(self.views) - 1, "componentType": 5126 if positions else 5125,
                                 "count": len(plain) if positions else plain.size,
                                 "type": "VEC3" if positions else "SCALAR"}  # fmt: skip
        if positions:
            entry |= {"min": plain.min(axis=0).tolist(), "max": plain.max(axis=0).tolist()}
        self.accessors.append(entry)
        return len(self.accessors) - 1


def glb_bytes(found: Scene) -> bytes:
    """Binary glTF 2.0. Points are primitives of mode POINTS, relative to a node in their middle for float32."""
    buffer, meshes, nodes = _Buffer(), [], []
    materials = [_material(name) for name in _COLORS]
    for name, xs in {"beacons": found.beacons, **found.targets}.items():
        x = np.array(list(xs.values()) if isinstance(xs, dict) else xs).reshape(-1, 3)
        if len(x):
            middle = x.mean(axis=0)
            kind = 0 if name == "beacons" else 1
            attributes = {"POSITION": buffer.add(x - middle, 34962)}
            meshes.append({"name": name, "primitives": [{"attributes": attributes, "mode": 0, "material": kind}]})
            node: dict[str, object] = {"name": name, "mesh": len(meshes) - 1, "translation": middle.tolist()}
            nodes.append(node | ({"extras": {"ids": list(found.beacons)}} if name == "beacons" else {}))
    if found.ellipsoids:
        vertices, triangles = sphere()
        primitive = {"attributes": {"POSITION": buffer.add(vertices, 34962), "NORMAL": buffer.add(vertices, 34962)},
                     "indices": buffer.add(triangles, 34963), "mode": 4, "material": 0}  # fmt: skip
        meshes.append({"name": "unit sphere", "primitives": [primitive]})
        for name, (matrix, cov) in found.ellipsoids.items():
            big = enlarged(matrix, found.enlarged)
            extras = {"covariance_mm2": (1e6 * cov).ravel().tolist(), "confidence": 0.95, "enlarged": found.enlarged}
            nodes.append({"name": f"ellipsoid {name}", "mesh": len(meshes) - 1, "matrix": big.T.ravel().tolist(),
                          "extras": extras})  # fmt: skip
    cameras = []
    for name, (camera, pose, focal) in found.cameras.items():
        width, height = camera.image_size
        field_of_view = 2.0 * float(np.arctan(0.5 * height / focal))
        perspective = {"yfov": field_of_view, "aspectRatio": width / height, "znear": 0.01}
        cameras.append({"name": name, "type": "perspective", "perspective": perspective})
        nodes.append({"name": f"camera {name}", "camera": len(cameras) - 1,
                      "matrix": (pose.matrix() @ _OPENGL).T.ravel().tolist()})  # fmt: skip
    # z up to glTF's y up: a quarter turn about x
    root = {"name": "world, z up", "rotation": [-np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)],
            "children": list(range(1, len(nodes) + 1))}  # fmt: skip
    document: dict[str, object] = {
        "asset": {"version": "2.0", "generator": "labsurvey", "extras": {"about": f"metres; {_said(found)}"}},
        "scene": 0, "scenes": [{"name": found.title or "survey", "nodes": [0]}], "nodes": [root, *nodes],
        "meshes": meshes, "materials": materials, "cameras": cameras, "accessors": buffer.accessors,
        "bufferViews": buffer.views, "buffers": [{"byteLength": len(buffer.data)}] if buffer.data else [],
    }  # fmt: skip
    return _container({k: v for k, v in document.items() if v not in ([], {})}, buffer.data)


def _material(name: str) -> dict[str, object]:
    color = [c / 255.0 for c in _COLORS[name]]
    surface = {"baseColorFactor": [*color, 1.0], "metallicFactor": 0.0, "roughnessFactor": 0.8}
    return {"name": name, "pbrMetallicRoughness": surface}


def _container(document: dict[str, object], data: bytes) -> bytes:
    """Header and the two chunks, each padded to four bytes (glTF 2.0, section 4)."""
    text = json.dumps(document, allow_nan=False, separators=(",", ":")).encode("utf-8")
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    if data:
        data += b"\0" * (-len(data) % 4)
        chunks += struct.pack("<I4s", len(data), b"BIN\0") + data
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def ply_files(values: CameraValues, station: str | None) -> tuple[dict[str, bytes], tuple[str, ...]]:
    """The scene as PLY, and how much its ellipsoids are enlarged."""
    found = scene(values)
    return {"": ply_bytes(found)}, (_said(found),)


def glb_files(values: CameraValues, station: str | None) -> tuple[dict[str, bytes], tuple[str, ...]]:
    """The scene as GLB, and how much its ellipsoids are enlarged."""
    found = scene(values)
    return {"": glb_bytes(found)}, (_said(found),)
