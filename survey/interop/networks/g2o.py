"""Pose networks in the g2o text format (SE(3) with quaternions), as read by GTSAM, g2o, SE-Sync and others.

An edge ``i j`` holds ``i_from_j``, so j is the frame on the right. Its information matrix, upper triangle by rows, is
ordered translation, rotation. g2o itself means by the rotation part the vector part of the quaternion (half the
rotation vector); GTSAM, SE-Sync and the authors of most published files mean the rotation vector itself. The argument
``information`` chooses. In some published files (those that were marginalised from images) the matrix is not positive
definite as a whole although its blocks of translation and of rotation are; ``block_diagonal`` reads these alone.
"""

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from gtsam import Pose3, Rot3
from scipy.spatial.transform import Rotation

from adjust.model.errors import SurveyError, listed
from adjust.model.frozen import frozen
from adjust.model.observations import FrameRef, Pair
from adjust.model.survey import BoolArray, FloatArray, PoseParameter, Station, Survey
from adjust.pose_network.from_survey import network_from_survey
from adjust.pose_network.network import PoseNetwork
from survey.folder.text import atomic_write

Information = Literal["tangent", "quaternion"]
_UPPER = np.triu_indices(6)
_SWAP = np.array([3, 4, 5, 0, 1, 2])  # translation-rotation to rotation-translation and back
_MOST_NAMED = 4


class _Edge(NamedTuple):
    """``i_from_j``: seven numbers of the pose, 21 of the information matrix, and the line they stand in."""

    i: str
    j: str
    row: list[float]
    line: int


@frozen(eq=False)
class G2oFile:
    """What a file was read as. notes: what was not taken as it stands, for people."""

    survey: Survey
    notes: tuple[str, ...] = ()


def read_g2o_file(path: Path, information: Information = "tangent", block_diagonal: bool = False) -> G2oFile:
    """Stations and pairs of a file. What ``FIX`` names is held at its vertex, else the first station at its vertex.

    The other vertices are start values. block_diagonal: of all information matrices only the 3 x 3 blocks of
    translation and rotation count, what stands between them is dropped. Raises SurveyError with file and line for what
    cannot be read, and for information matrices that are not positive definite.
    """
    vertices: dict[str, tuple[list[float], int]] = {}
    edges: list[_Edge] = []
    fixed: list[str] = []
    with Path(path).open(encoding="utf-8-sig", errors="replace") as lines:
        for number, line in enumerate(lines, 1):
            words = line.split()
            if not words or words[0].startswith("#"):
                continue
            if words[0] == "EDGE_SE3:QUAT":
                if len(words) < 3:
                    raise SurveyError(f"{path}, line {number}: an edge needs two vertices")
                edges.append(_Edge(words[1], words[2], _numbers(words[3:], 28, path, number), number))
            elif words[0] == "VERTEX_SE3:QUAT":
                if len(words) < 2:
                    raise SurveyError(f"{path}, line {number}: a vertex needs an id")
                vertices[words[1]] = _numbers(words[2:], 7, path, number), number
            elif words[0] == "FIX":
                fixed += words[1:]
            else:
                known = "VERTEX_SE3:QUAT, EDGE_SE3:QUAT and FIX are"
                raise SurveyError(f"{path}, line {number}: {words[0]!r} is not supported; {known}")
    stations = dict(zip(vertices, _rows(vertices.values(), 7, path), strict=True))
    rows = _rows([(edge.row, edge.line) for edge in edges], 28, path)
    info, notes = _information(path, edges, rows[:, 7:], information, block_diagonal)
    survey = _survey(path, stations, edges, rows, fixed, np.asarray(np.linalg.inv(info), dtype=float))
    network_from_survey(survey)  # which checks it
    return G2oFile(survey, notes)


def _numbers(words: Sequence[str], n: int, path: Path, line: int) -> list[float]:
    try:
        out = [float(word) for word in words]
    except ValueError:
        found = " ".join(words)[:60]
        raise SurveyError(f"{path}, line {line}: expected {n} numbers, found {found!r}") from None
    if len(out) != n:
        raise SurveyError(f"{path}, line {line}: expected {n} finite numbers, found {len(out)}")
    return out


def _rows(found: Collection[tuple[list[float], int]], n: int, path: Path) -> FloatArray:
    """Numbers (k, n) of lines; raises for the first line that holds no pose."""
    rows, lines = np.array([row for row, _ in found]).reshape(-1, n), [line for _, line in found]
    for wrong, what in (
        (~(np.abs(rows) < 1e100).all(axis=1), f"expected {n} finite numbers, found {n}"),
        (np.linalg.norm(rows[:, 3:7], axis=1) < 1e-9, "the quaternion is zero"),
    ):
        if wrong.any():
            raise SurveyError(f"{path}, line {lines[int(np.argmax(wrong))]}: {what}")
    return rows


def _poses(rows: FloatArray) -> list[Pose3]:
    turns = Rotation.from_quat(rows[:, 3:7]).as_matrix()
    return [Pose3(Rot3(R), t) for R, t in zip(turns, rows[:, :3], strict=True)]


def _survey(
    path: Path, stations: dict[str, FloatArray], edges: list[_Edge], rows: FloatArray, fixed: list[str], cov: FloatArray
) -> Survey:
    ids = list(dict.fromkeys([*stations, *(x for e in edges for x in (e.i, e.j))]))
    unknown = next((f for f in fixed if f not in stations), None)
    if unknown is not None:
        raise SurveyError(f"{path}: FIX {unknown} names a vertex that the file does not hold")
    given = dict(zip(stations, _poses(np.array(list(stations.values())).reshape(-1, 7)), strict=True))
    held = {s: PoseParameter(given.get(s, Pose3()), "held") for s in fixed or ids[:1]}
    frames = {s: FrameRef("station", s) for s in ids}
    return Survey(
        stations=tuple(Station(s, world_from_station=held.get(s, PoseParameter(given.get(s)))) for s in ids),
        pairs=tuple(Pair(name, frames[e.j], frames[e.i], i_from_j, Q) for name, e, i_from_j, Q
                    in zip(_edge_names(edges), edges, _poses(rows), cov, strict=True)),
    )  # fmt: skip


def _information(
    path: Path, edges: list[_Edge], upper: FloatArray, information: Information, block_diagonal: bool
) -> tuple[FloatArray, tuple[str, ...]]:
    """Information matrices (E, 6, 6), rotation first, in the tangent; what was dropped of them."""
    if not edges:
        raise SurveyError(f"{path}: no EDGE_SE3:QUAT in it")
    info = np.zeros((len(edges), 6, 6))
    info[:, _UPPER[0], _UPPER[1]] = info[:, _UPPER[1], _UPPER[0]] = upper
    info = info[:, _SWAP][:, :, _SWAP]
    if information == "quaternion":  # the vector part of the quaternion is half the rotation vector
        info[:, :3] *= 0.5
        info[:, :, :3] *= 0.5
    blocks = info.copy()
    blocks[:, :3, 3:] = blocks[:, 3:, :3] = 0.0
    bad, bad_blocks = _indefinite(info), _indefinite(blocks)
    if bad_blocks.any() if block_diagonal else bad.any():
        raise SurveyError(_not_definite(path, edges, bad_blocks if block_diagonal else bad, bool(bad_blocks.any())))
    if not block_diagonal:
        return info, ()
    coupled = int(np.count_nonzero((info[:, :3, 3:] != 0.0).any(axis=(1, 2))))
    if not coupled:
        return blocks, ()
    told = (
        f"information between translation and rotation of {coupled} of {len(edges)} edges was dropped (block-diagonal "
        "reading)"
    )
    if not bad.any():
        return blocks, (told,)
    n = int(bad.sum())
    verb = "is" if n == 1 else "are"
    return blocks, (f"{told}; as a whole {n} of the matrices {verb} not positive definite: {_lines(edges, bad)}",)


def _indefinite(info: FloatArray) -> BoolArray:
    return np.asarray(np.linalg.eigvalsh(info)[:, 0] <= 0.0)


def _not_definite(path: Path, edges: list[_Edge], bad: BoolArray, blocks_too: bool) -> str:
    n = int(bad.sum())
    first = edges[int(np.argmax(bad))]
    remedy = (
        "correct the file" if blocks_too
        else "where the file means its blocks of translation and rotation alone, read it with --block-diagonal"
    )  # fmt: skip
    return (
        f"{path}, line {first.line}: the information matrix of edge {first.i} {first.j} is not positive definite"
        + (f"; of {len(edges)} these {n} are not: {_lines(edges, bad)}" if n > 1 else "") + f"; {remedy}"
    )  # fmt: skip


def _lines(edges: list[_Edge], bad: BoolArray) -> str:
    rows = np.flatnonzero(bad).tolist()
    return listed([f"{edges[k].i} {edges[k].j} (line {edges[k].line})" for k in rows], _MOST_NAMED)


def _edge_names(edges: list[_Edge]) -> list[str]:
    """``i-j``, with a running number where two stations were joined more than once."""
    seen: dict[str, int] = {}
    out = []
    for e in edges:
        name = f"{e.i}-{e.j}"
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
