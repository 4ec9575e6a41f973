"""The example ``relay``: thirty stations through four rooms and a corridor, joined by measured pairs."""

import itertools

import numpy as np
from gtsam import Pose3, Rot3

from adjust.model.result import ParameterName
from adjust.model.survey import FloatArray
from adjust.spatial.rotation_forms import quaternion_wxyz
from survey.examples.folders import truth_json

Files = dict[str, str]
_ROOMS = "ABCD"
_NEW = ("E1", "E2", "E3")
_HEADER = "pair_id,a_id,b_id,qw,qx,qy,qz,tx_mm,ty_mm,tz_mm,sigma_rotation_arcsec,sigma_translation_mm"
_TANGENT = ("rx", "ry", "rz", "tx", "ty", "tz")


def relay_files(seed: int) -> Files:
    """What stands in the folder; ``more`` is a room that is measured later, for ``labsurvey add``."""
    rng = np.random.default_rng(seed)
    world_from = _stations(rng)
    pairs, later = _lists()
    truth: dict[ParameterName, Pose3 | FloatArray] = {("world_from_station", s): p for s, p in world_from.items()}
    return {
        "survey.toml": _toml([s for s in world_from if s not in _NEW]),
        "observations/pairs.csv": _pairs_csv(pairs, world_from, rng),
        "more/survey.toml": "# A fifth room, measured later: labsurvey add FOLDER FOLDER/more\n"
        + "".join(f"[stations.{s}]\n" for s in _NEW),
        "more/observations/pairs.csv": _pairs_csv(later, world_from, rng),
        "truth.json": truth_json(truth, seed),
    }


def _stations(rng: np.random.Generator) -> dict[str, Pose3]:
    """``world_from_station``: a corridor of ten along x, rooms of five on its sides; the first is the world."""
    places: dict[str, tuple[float, float]] = {}
    for i in range(10):
        places[f"K{i + 1:02d}"] = (3.5 * i, 0.5 * (-1) ** i)
    for k, room in enumerate(_ROOMS):
        x, side = 4.0 + 14.0 * (k // 2), 1.0 if k % 2 == 0 else -1.0
        for j, (dx, dy) in enumerate([(0.0, 4.0), (5.0, 4.0), (5.5, 8.0), (2.5, 9.5), (-0.5, 8.0)]):
            places[f"{room}{j + 1}"] = (x + dx, side * dy)
    for name, place in zip(_NEW, [(36.0, 3.5), (39.0, 5.0), (36.5, 7.0)], strict=True):
        places[name] = place
    out = {}
    for name, (x, y) in places.items():
        spot = np.array([x, y, 1.5]) + rng.uniform(-0.3, 0.3, 3)
        turn = Rot3.Rz(rng.uniform(-np.pi, np.pi)) * Rot3.Rx(rng.uniform(-0.03, 0.03))
        out[name] = Pose3(turn, spot)
    first = out["K01"]
    return {name: first.between(pose) for name, pose in out.items()}


def _lists() -> tuple[list[tuple[str, str]], list[tuple[str, str]]]:
    """Which stations see each other: neighbours in the corridor, rings and a diagonal in rooms, through doors."""
    corridor = [f"K{i + 1:02d}" for i in range(10)]
    pairs = list(itertools.pairwise(corridor)) + list(zip(corridor[:-2], corridor[2:], strict=True))
    for k, room in enumerate(_ROOMS):
        ring = [f"{room}{j + 1}" for j in range(5)]
        pairs += list(zip(ring, ring[1:] + ring[:1], strict=True)) + [(ring[0], ring[2]), (ring[1], ring[4])]
        door = 1 + 4 * (k // 2)
        pairs += [(corridor[door], ring[0]), (corridor[door + 1], ring[0]), (corridor[door + 1], ring[1])]
    pairs += [("A3", "C5"), ("B3", "D5")]
    new = [("K10", "E1"), ("K09", "E1"), ("E1", "E2"), ("E2", "E3"), ("E1", "E3"), ("C2", "E3")]
    return pairs, new


def _pairs_csv(pairs: list[tuple[str, str]], world_from: dict[str, Pose3], rng: np.random.Generator) -> str:
    """Every fifth pair has a full covariance (of a resection from few points), the others sigmas."""
    upper = [(i, j) for i in range(6) for j in range(i, 6)]
    unit = {0: "rad2", 1: "rad_m", 2: "m2"}
    names = [f"cov_{_TANGENT[i]}_{_TANGENT[j]}_{unit[(i >= 3) + (j >= 3)]}" for i, j in upper]
    lines = [",".join([_HEADER, *names])]
    for n, (a, b) in enumerate(pairs):
        true = world_from[b].between(world_from[a])
        length = float(np.linalg.norm(true.translation()))
        rotation_arcsec, shift_mm = float(rng.choice([4.0, 6.0, 10.0])), round(0.05 + 0.02 * length, 2)
        cov = np.diag([np.radians(rotation_arcsec / 3600.0) ** 2] * 3 + [(1e-3 * shift_mm) ** 2] * 3)
        full = n % 5 == 4
        if full:
            cov = _correlated(cov, rng)
        measured = true.retract(np.linalg.cholesky(cov) @ rng.standard_normal(6))
        own = [""] * 2 + [f"{cov[i, j]:.9e}" for i, j in upper]
        if not full:
            own = [f"{rotation_arcsec:g}", f"{shift_mm:g}"] + [""] * len(upper)
        lines.append(",".join([f"{a}-{b}", a, b, *_motion(measured), *own]))
    return "\n".join(lines) + "\n"


def _correlated(cov: FloatArray, rng: np.random.Generator) -> FloatArray:
    """The same sigmas, with correlations as targets on one side give them."""
    sigma = np.sqrt(np.diag(cov))
    A = np.eye(6) + 0.5 * rng.standard_normal((6, 6))
    Q = A @ A.T
    d = np.sqrt(np.diag(Q))
    return np.asarray(Q / np.outer(d, d) * np.outer(sigma, sigma))


def _motion(pose: Pose3) -> list[str]:
    turn = [f"{x:.10f}" for x in quaternion_wxyz(pose.rotation())]
    return turn + [f"{1e3 * x:.4f}" for x in pose.translation()]


def _toml(stations: list[str]) -> str:
    text = """# Thirty stations through a corridor (K) and four rooms (A to D). Each measured its neighbours: pairs.csv.
format = 1
title = "Relay through four rooms"

[stations.K01]
world_from_station = { treatment = "held" }        # the first station of the corridor is the world

"""
    return text + "".join(f"[stations.{s}]\n" for s in stations if s != "K01")
