"""Pose networks in the g2o text format (SE(3) with quaternions), as read by GTSAM, g2o, SE-Sync and others.

An edge ``i j`` holds ``i_from_j``, so j is the frame on the right. Its information matrix, upper triangle by rows, is
ordered translation, rotation. g2o itself means by the rotation part the vector part of the quaternion (half the
rotation vector); GTSAM, SE-Sync and the authors of most published files mean the rotation vector itself. The argument
``information`` chooses.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from adjust.errors import SurveyError
from adjust.model import FloatArray
from adjust.pose_network.network import PoseNetwork, pose_network
from survey.files.text import atomic_write

Information = Literal["tangent", "quaternion"]
_UPPER = np.triu_indices(6)
_SWAP = np.array([3, 4, 5, 0, 1, 2])  # translation-rotation to rotation-translation and back


def read_g2o(path: Path, information: Information = "tangent", use_vertices: bool = False) -> PoseNetwork:
    """The network of a file. What ``FIX`` names is held at its vertex, else the first station at its vertex.

    use_vertices: take the other vertices as a start; by default the program finds its own. Raises SurveyError with
    file and line for what cannot be read.
    """
    stations: dict[str, FloatArray] = {}
    edges: list[tuple[str, str, FloatArray]] = []
    fixed: list[str] = []
    with Path(path).open(encoding="utf-8-sig", errors="replace") as lines:
        for number, line in enumerate(lines, 1):
            words = line.split()
            if not words or words[0].startswith("#"):
                continue
            where = f"{path}, line {number}"
            if words[0] == "VERTEX_SE3:QUAT":
                stations[_id(words, where)] = _numbers(words[2:], 7, where)
            elif words[0] == "EDGE_SE3:QUAT":
                if len(words) < 3:
                    raise SurveyError(f"{where}: an edge needs two vertices")
                edges.append((words[1], words[2], _numbers(words[3:], 28, where)))
            elif words[0] == "FIX":
                fixed += words[1:]
            else:
                raise SurveyError(f"{where}: {words[0]!r} is not supported; VERTEX_SE3:QUAT, EDGE_SE3:QUAT and FIX are")
    return _network(path, stations, edges, fixed, information, use_vertices)


def _id(words: Sequence[str], where: str) -> str:
    if len(words) < 2:
        raise SurveyError(f"{where}: a vertex needs an id")
    return words[1]


def _numbers(words: Sequence[str], n: int, where: str) -> FloatArray:
    try:
        out = np.array(words, dtype=float)
    except ValueError:
        raise SurveyError(f"{where}: expected {n} numbers, found {' '.join(words)[:60]!r}") from None
    if len(out) != n or not (np.abs(out) < 1e100).all():
        raise SurveyError(f"{where}: expected {n} finite numbers, found {len(out)}")
    if np.linalg.norm(out[3:7]) < 1e-9:
        raise SurveyError(f"{where}: the quaternion is zero")
    return out


def _poses(rows: FloatArray) -> FloatArray:
    out = np.tile(np.eye(4), (len(rows), 1, 1))
    out[:, :3, :3], out[:, :3, 3] = Rotation.from_quat(rows[:, 3:7]).as_matrix(), rows[:, :3]
    return out


def _network(
    path: Path, stations: dict[str, FloatArray], edges: list[tuple[str, str, FloatArray]], fixed: list[str],
    information: Information, use_vertices: bool,
) -> PoseNetwork:  # fmt: skip
    if not edges:
        raise SurveyError(f"{path}: no EDGE_SE3:QUAT in it")
    ids = list(dict.fromkeys([*stations, *(x for i, j, _ in edges for x in (i, j))]))
    index = {s: k for k, s in enumerate(ids)}
    unknown = next((f for f in fixed if f not in stations), None)
    if unknown is not None:
        raise SurveyError(f"{path}: FIX {unknown} names a vertex that the file does not hold")
    given = dict(zip(stations, _poses(np.array(list(stations.values())).reshape(-1, 7)), strict=True))
    held = {index[s]: given[s] for s in fixed} or {0: given.get(ids[0], np.eye(4))}
    rows = np.array([row for _, _, row in edges])
    info = np.zeros((len(rows), 6, 6))
    info[:, _UPPER[0], _UPPER[1]] = info[:, _UPPER[1], _UPPER[0]] = rows[:, 7:]
    info = info[:, _SWAP][:, :, _SWAP]
    if information == "quaternion":  # the vector part of the quaternion is half the rotation vector
        info[:, :3] *= 0.5
        info[:, :, :3] *= 0.5
    bad = np.linalg.eigvalsh(info).min(axis=1) <= 0.0
    if bad.any():
        i, j, _ = edges[int(np.argmax(bad))]
        raise SurveyError(f"{path}: the information matrix of edge {i} {j} is not positive definite")
    poses = _poses(rows)
    return pose_network(
        ids, _edge_names(edges), [index[j] for _, j, _ in edges], [index[i] for i, _, _ in edges],
        poses[:, :3, :3], poses[:, :3, 3], np.asarray(np.linalg.inv(info), dtype=float), held=held,
        start={index[s]: p for s, p in given.items()} if use_vertices else None,
    )  # fmt: skip


def _edge_names(edges: list[tuple[str, str, FloatArray]]) -> list[str]:
    """``i-j``, with a running number where two stations were joined more than once."""
    seen: dict[str, int] = {}
    out = []
    for i, j, _ in edges:
        name = f"{i}-{j}"
        seen[name] = seen.get(name, 0) + 1
        out.append(name if seen[name] == 1 else f"{name}#{seen[name]}")
    return out


def write_g2o(
    path: Path, network: PoseNetwork, rotations: FloatArray, translations: FloatArray,
    information: Information = "tangent",
) -> None:  # fmt: skip
    """Write stations at ``rotations`` (N, 3, 3), ``translations`` (N, 3) and the pairs in use.

    Station ids that are no whole numbers are written as their positions, since g2o knows only numbers. Raises
    SurveyError for pairs of rotations, which the format cannot hold.
    """
    if not network.is_pose[network.used].all():
        raise SurveyError("g2o's SE3 edges need a translation; this network has pairs that are rotations only")
    plain = all(s.isascii() and s.isdigit() for s in network.station_ids)
    ids = network.station_ids if plain else tuple(str(i) for i in range(network.n_stations))
    rows = np.flatnonzero(network.used)
    info = np.linalg.inv(network.cov[rows])
    if information == "quaternion":
        info[:, :3] *= 2.0
        info[:, :, :3] *= 2.0
    info = info[:, _SWAP][:, :, _SWAP][:, _UPPER[0], _UPPER[1]]
    vertices = np.hstack([translations, Rotation.from_matrix(rotations).as_quat()])
    edges = np.hstack([network.translations[rows], Rotation.from_matrix(network.rotations[rows]).as_quat(), info])
    lines = [f"VERTEX_SE3:QUAT {s} {_text(row)}" for s, row in zip(ids, vertices, strict=True)]
    lines += [f"FIX {ids[i]}" for i in network.held]
    lines += [
        f"EDGE_SE3:QUAT {ids[network.b_idx[e]]} {ids[network.a_idx[e]]} {_text(row)}"
        for e, row in zip(rows, edges, strict=True)
    ]
    atomic_write(Path(path), "\n".join(lines) + "\n")


def _text(row: FloatArray) -> str:
    return " ".join(repr(float(x)) for x in row)
