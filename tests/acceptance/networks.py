"""Every published network through ``convert`` and ``adjust``, held against what was published; for tests and the table.

Where GNU Gama stopped after its one linearisation before it had converged, ``dense_network`` repeats exactly that step
from Gama's own start values; ``gap`` fields are what remains then.
"""

import contextlib
import csv
import io
import json
import re
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from adjust.model.survey import FloatArray, Survey
from survey.cli import main
from survey.interop.networks.foreign import ForeignNetwork, with_safe_ids
from survey.interop.networks.gama import read_gama
from survey.interop.networks.krumm import read_krumm
from survey.interop.networks.lgc import read_lgc
from tests.acceptance.dense_network import DenseResult, dense_adjust, gradient_at, sparse_sigmas
from tests.acceptance.gama_results import GamaResult, gama_result

GAMA = (
    "2019-zeman", "2020-barta-phase_0-1TK", "2020-barta-phase_1-1TK", "cube-1", "local_3d", "tst-tetrahedron-3-gon",
    "zoltan-test_2d_gon",
)  # fmt: skip
DEFAULTS = (
    "krasovsky-1926", "zoltan-test_2d_dms", "stroner-levelling-a", "seq-dsuloha-d", "LotherStrehle_Direction7",
)  # fmt: skip
SYNTHETIC = ("net100", "free100")
LARGE = ("net1000", "free1000")
KRUMM = (
    "1D/Ghilani12_6_Height_fix", "1D/Niemeier_Height_fix1", "1D/Niemeier_Height_free",
    "2D/Benning83_DistanceDirection_fix", "2D/Carosio_DistanceDirection_fix", "2D/Ghilani15_4_Angle_fix",
    "2D/Ghilani16_2_DistanceAngleAzimuth_fix", "2D/Hoepke_Distance_free", "2D/Krumm_Traverse1",
    "3D/BlankenbachWillert3D_Distance_fix", "3D/Caspary", "3D/Ghilani_GNSS_Baselines",
    "3D/Wolf_SpatialPolygonTraverse_fix",
)  # fmt: skip
LGC = "MathisLGC_V1_20150709-141437"
LGC_SIGMA0 = 17.927129


# --- what a user gets: convert, adjust, and the files in results ------------------------------------------------------

_SI = {"mm": 1e-3, "arcsec": np.pi / 648000}


@dataclass(frozen=True, eq=False)
class UserRun:
    """What ``results`` of a converted and adjusted file says: ``solution.json`` and ``residuals_other.csv``.

    points, readings: ids in the project by those in the file.
    """

    solution: dict[str, Any]
    residuals: list[dict[str, str]]
    points: dict[str, str]
    readings: dict[str, str]

    def __getattr__(self, name: str) -> Any:
        """sigma0, redundancy, datum_defect and all else of the summary."""
        return self.solution["summary"][name]


def as_a_user(path: Path, survey: Survey) -> UserRun:
    """``labsurvey convert`` and ``labsurvey adjust``; ``survey``: the same file as a reader gives it, for its names."""
    safe, _ = with_safe_ids(survey)
    points = {a.point_id: b.point_id for a, b in zip(survey.points, safe.points, strict=True)}
    readings = {a.reading_id: b.reading_id for a, b in zip(survey.readings, safe.readings, strict=True)}
    with tempfile.TemporaryDirectory() as scratch, contextlib.redirect_stdout(io.StringIO()):
        project = Path(scratch) / path.stem
        assert main(["convert", str(path), str(project), "--quiet"]) == 0
        assert main(["adjust", str(project), "--quiet"]) in (0, 3)
        solution = json.loads((project / "results" / "solution.json").read_text(encoding="utf-8"))
        text = (project / "results" / "residuals_other.csv").read_text(encoding="utf-8")
    return UserRun(solution, list(csv.DictReader(io.StringIO(text))), points, readings)


@dataclass(frozen=True, eq=False)
class CoreRows:
    """Per component of every observation: observed, residual, its own variance, a priori sigma."""

    residual: FloatArray
    residual_var: FloatArray
    sigma: FloatArray
    standardized: FloatArray


def core_rows(survey: Survey, result: UserRun) -> CoreRows:
    """Readings in the survey's order, then baselines, then coordinates."""
    readings = {row["ids"].split()[0]: row for row in result.residuals if row["kind"] not in _VECTORS}
    rows = [readings[result.readings[r.reading_id]] for r in survey.readings]
    rows += [row for kind in _VECTORS for row in result.residuals if row["kind"] == kind]
    numbers = [[float(row[n] or "nan") for row in rows] for n in ("residual", "sigma", "standardized")]
    unit = np.array([_SI[row["residual_unit"]] for row in rows])
    residual, sigma, standardized = unit * numbers[0], unit * numbers[1], np.array(numbers[2])
    with np.errstate(invalid="ignore", divide="ignore"):
        return CoreRows(residual, (residual / standardized) ** 2, sigma, standardized)


_VECTORS = ("coordinate_difference", "coordinates")


def core_points(result: UserRun) -> dict[str, FloatArray]:
    """m, by the names of the file."""
    return _by_point(result, "")


def core_sigmas(result: UserRun) -> dict[str, FloatArray]:
    """m, as the result file gives them: a priori or a posteriori, as the other program's file asks for."""
    return _by_point(result, "sigma_")


def _by_point(result: UserRun, what: str) -> dict[str, FloatArray]:
    entries = {name: result.solution["points"].get(own) for name, own in result.points.items()}
    return {name: np.array([1e-3 * e[f"{what}{a}_mm"] for a in "xyz"]) for name, e in entries.items() if e}


@dataclass(frozen=True, eq=False)
class Compared:
    """A network as adjusted and the largest differences from what was published, by what they are of."""

    name: str
    network: ForeignNetwork
    result: UserRun
    sigma0: float
    published_sigma0: float | None
    differences: dict[str, float] = field(default_factory=dict)
    limits: dict[str, float] = field(default_factory=dict)
    note: str = ""


# --- GNU Gama ---------------------------------------------------------------------------------------------------------


def gama_start(survey: Survey, published: GamaResult) -> dict[str, FloatArray]:
    """Gama's own approximate coordinates, to the micrometre that it prints."""
    start = {}
    for point in survey.points:
        value = point.x_in_world.value
        x = np.zeros(3) if value is None else np.nan_to_num(value)
        for i, axis in enumerate("xyz"):
            x[i] = published.start.get((point.point_id, axis), x[i])
        start[point.point_id] = x
    return start


@dataclass(frozen=True, eq=False)
class GamaCase:
    """A network of Gama with its own result, the package's, and the dense one after one step and converged."""

    name: str
    network: ForeignNetwork
    published: GamaResult
    result: UserRun
    one: DenseResult
    converged: DenseResult

    def scale(self, sigma0: float) -> float:
        return sigma0 if self.published.used == "aposteriori" else 1.0

    def coordinates(self, points: dict[str, FloatArray]) -> FloatArray:
        return np.array([points[p]["xyz".index(a)] for p, a in self.published.adjusted])

    def sigmas(self, sigmas: dict[str, FloatArray], sigma0: float) -> FloatArray:
        return self.scale(sigma0) * np.array([sigmas[p]["xyz".index(a)] for p, a in self.published.adjusted])

    def published_sigmas(self) -> FloatArray:
        return np.sqrt(np.diagonal(self.published.cov))[: len(self.published.adjusted)]


def gama_case(folder: Path, name: str) -> GamaCase:
    network = read_gama(folder / f"{name}.gkf")
    published = gama_result(folder / f"{name}.xml")
    start = gama_start(network.survey, published)
    one = dense_adjust(network.survey, start, steps=1)
    converged = dense_adjust(network.survey, start)
    return GamaCase(name, network, published, as_a_user(folder / f"{name}.gkf", network.survey), one, converged)


def gama_statistics(case: GamaCase, sigma: FloatArray, residual: FloatArray, residual_var: FloatArray, sigma0: float):
    """qrr, f (per cent) and the absolute standardized residual as Gama defines them; (m, 3).

    Of correlated observations Gama takes ``residual_var`` from rows that it has decorrelated first.
    """
    adjusted_var = np.clip(sigma**2 - residual_var, 0.0, None)
    qrr = residual_var / unit_of(case) ** 2 / case.published.apriori**2
    f = 100.0 * (1.0 - np.sqrt(adjusted_var) / sigma)
    with np.errstate(invalid="ignore", divide="ignore"):
        w = np.abs(residual) / np.sqrt(residual_var) / case.scale(sigma0)
    return np.column_stack([qrr, f, w])


def unit_of(case: GamaCase) -> FloatArray:
    """cc or mm of every observation, in rad or m."""
    angular = ("angle", "direction", "zenith-angle", "azimuth")
    return np.array([np.pi / 200 * 1e-4 if r.kind in angular else 1e-3 for r in case.published.rows])


def printed_statistics(case: GamaCase) -> FloatArray:
    rows = case.published.rows
    return np.array([[r.qrr, r.f, np.nan if r.standardized is None else r.standardized] for r in rows])


def compare_gama(folder: Path, name: str) -> Compared:
    case = gama_case(folder, name)
    published, result = case.published, case.result
    xyz = np.array(list(published.adjusted.values()))
    sigma = case.published_sigmas()
    ours = case.coordinates(core_sigmas(result))
    rows = core_rows(case.network.survey, result)
    statistics = gama_statistics(case, rows.sigma, rows.residual, rows.residual_var, result.sigma0)
    one = gama_statistics(case, case.one.sigma, case.one.residuals, case.one.decorrelated, case.one.sigma0)
    printed = printed_statistics(case)
    differences = {
        "coordinate_m": float(np.abs(case.coordinates(core_points(result)) - xyz).max()),
        "coordinate_gap_m": float(np.abs(case.coordinates(case.one.points) - xyz).max()),
        "sigma_relative": float(np.abs(ours / sigma - 1.0).max()),
        "sigma_gap": float(np.abs(case.sigmas(case.one.sigmas, case.one.sigma0) / sigma - 1.0).max()),
        "standardized": float(np.nanmax(np.abs(statistics - printed)[:, 2])),
        "standardized_gap": float(np.nanmax(np.abs(one - printed)[:, 2])),
    }
    step = case.one.last_step
    note = f"Gama's one step from its start was {1e3 * step:.3g} mm" if step > 1e-6 else ""
    return Compared(
        name, case.network, result, result.sigma0 * published.apriori, published.aposteriori, differences, {}, note
    )


def compare_large(folder: Path, name: str) -> Compared:
    """Networks of 1000 points: coordinates, and deviations at Gama's linearisation and at the solution."""
    network, published = read_gama(folder / f"{name}.gkf"), gama_result(folder / f"{name}-variances.xml")
    result = as_a_user(folder / f"{name}.gkf", network.survey)
    points, sigmas = core_points(result), core_sigmas(result)
    known = np.sqrt(np.diagonal(published.cov))[: len(published.adjusted)]
    ours = np.array([sigmas[p]["xyz".index(a)] for p, a in published.adjusted])
    xyz = np.array([points[p]["xyz".index(a)] for p, a in published.adjusted])
    names = [(p, "xyz".index(a)) for p, a in published.adjusted]
    some = list(range(0, len(names), 31))
    start = sparse_sigmas(network.survey, gama_start(network.survey, published), [names[i] for i in some])
    end = sparse_sigmas(network.survey, points, [names[i] for i in some])
    differences = {
        "coordinate_m": float(np.abs(xyz - np.array(list(published.adjusted.values()))).max()),
        "sigma_relative": float(np.abs(ours / known - 1.0).max()),
        "sigma_gap": float(np.abs(start / known[some] - 1.0).max()),
        "sigma_dense": float(np.abs(ours[some] / end - 1.0).max()),
    }
    return Compared(name, network, result, result.sigma0, published.aposteriori, differences)


# --- Krumm ------------------------------------------------------------------------------------------------------------

_WORD = re.compile(r"[-−+]?\d+\.(\d+)")
# corrections and deviations are printed in cm, but for the heights, which have mm; Ghilani's baselines mix them
_UNITS = {"1D": (1e-3, 1e-3), "2D": (1e-2, 1e-2), "3D": (1e-2, 1e-2), "3D/Ghilani_GNSS_Baselines": (1e-3, 1e-2)}


@dataclass(frozen=True, eq=False)
class KrummRow:
    """One adjusted coordinate: ours minus published, in half units of the last printed digit."""

    point: str
    axis: str
    coordinate: float
    correction: float
    sigma: float


def krumm_rows(
    folder: Path, name: str, points: dict[str, FloatArray], sigmas: dict[str, FloatArray], network: ForeignNetwork
) -> list[KrummRow]:
    """``sigmas`` a posteriori."""
    units = _UNITS.get(name, _UNITS[name[:2]])
    survey = network.survey
    start = {p.point_id: p.x_in_world.value for p in survey.points}
    axes = [i for i in range(3) if any("xyz"[i] not in p.x_in_world.held for p in survey.points
                                       if p.x_in_world.treatment != "held")]  # fmt: skip
    out = []
    for point, printed in _printed(folder / f"{name}.adj").items():
        for k, axis in enumerate(axes):
            (x, correction, sigma), digits = zip(*printed[3 * k : 3 * k + 3], strict=True)
            half = [0.5 * 10.0**-d for d in digits]
            ours = points[point][axis]
            out.append(
                KrummRow(
                    point, "xyz"[axis], (ours - x) / half[0],
                    ((ours - start[point][axis]) / units[0] - correction) / half[1],
                    (sigmas[point][axis] / units[1] - sigma) / half[2],
                )
            )  # fmt: skip
    return out


def _printed(path: Path) -> dict[str, list[tuple[float, int]]]:
    """Every number with its printed decimals, by point: coordinate, correction and deviation of each axis."""
    lines = [line.split() for line in path.read_text(encoding="utf-8").splitlines() if not line.startswith("#")]
    return {w[0]: [(float(x.replace("−", "-")), len(_WORD.fullmatch(x)[1])) for x in w[1:]] for w in lines if w}


def compare_krumm(folder: Path, name: str) -> Compared:
    """In half units of the last printed digit; ``gap``: the same for Gauss-Newton stopped at steps of 1e-6 m."""
    network = read_krumm(folder / f"{name}.dat")
    survey = network.survey
    result = as_a_user(folder / f"{name}.dat", survey)
    rows = krumm_rows(folder, name, core_points(result), core_sigmas(result), network)
    start = {p.point_id: np.asarray(p.x_in_world.value) for p in survey.points}
    stopped = dense_adjust(survey, start, tolerance=1e-6)
    theirs = {p: stopped.sigma0 * s for p, s in stopped.sigmas.items()}
    gaps = krumm_rows(folder, name, stopped.points, theirs, network)
    keys = ("coordinate", "correction", "sigma")
    differences = {key: float(max(abs(getattr(row, key)) for row in rows)) for key in keys}
    differences |= {f"{key}_gap": float(max(abs(getattr(row, key)) for row in gaps)) for key in keys}
    return Compared(name, network, result, result.sigma0 * network.sigma0, None, differences)


# --- LGC --------------------------------------------------------------------------------------------------------------


def lgc_published(path: Path) -> dict[str, FloatArray]:
    """Adjusted points of an LGC output: x y z (m) and their deviations (m)."""
    out = {}
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        words = line.split()
        if len(words) == 10 and all(re.fullmatch(r"-?\d+\.\d+", w) for w in words[1:]):
            out[words[0]] = np.array([float(w) for w in words[1:7]]) * [1, 1, 1, 1e-3, 1e-3, 1e-3]
    return out


def compare_lgc(folder: Path) -> Compared:
    network = read_lgc(folder / f"{LGC}.lgc")
    result = as_a_user(folder / f"{LGC}.lgc", network.survey)
    published = lgc_published(folder / f"{LGC}.output")
    points, sigmas = core_points(result), core_sigmas(result)
    differences = {
        "coordinate_m": max(float(np.abs(points[p] - row[:3]).max()) for p, row in published.items()),
        "sigma_m": max(float(np.abs(sigmas[p] - row[3:]).max()) for p, row in published.items()),
        "points": float(len(published)),
    }
    return Compared("HIE-ISOLDE", network, result, result.sigma0, LGC_SIGMA0, differences)


# --- the railway: 833 points, no published result ---------------------------------------------------------------------

RAILWAY = "railway-survey-with-aproximate-xy"


def compare_railway(folder: Path) -> Compared:
    """Whether v'Pv is at its minimum (steps left, in sigmas) and the datum's points have not moved as a whole (m)."""
    network = read_gama(folder / f"{RAILWAY}.gkf")
    survey = network.survey
    result = as_a_user(folder / f"{RAILWAY}.gkf", survey)
    points = core_points(result)
    setups = result.solution["setups"]
    turned = {name: np.radians(entry["orientation"]["orientation_deg"]) for name, entry in setups.items()}
    gradient, diagonal = gradient_at(survey, points, turned)
    start = np.array([p.x_in_world.value for p in survey.points if p.point_id in survey.datum.points])
    moved = np.array([points[p] for p in survey.datum.points]) - start
    centred = start - start.mean(axis=0)
    turn = (centred[:, 0] * moved[:, 1] - centred[:, 1] * moved[:, 0]).sum() / np.linalg.norm(centred)
    differences = {
        "gradient": float(np.abs(gradient / np.sqrt(diagonal)).max()),
        "datum_m": float(max(np.abs(moved.sum(axis=0)).max(), abs(turn))),
    }
    return Compared(RAILWAY, network, result, result.sigma0 * network.sigma0, None, differences)
