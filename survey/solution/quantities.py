"""How an estimate is written down: people's units in the names of keys, sigmas scaled in one place.

Everything that a report or a result file says about the precision of an unknown passes through :class:`Scale`.
"""

import re
from dataclasses import dataclass
from typing import Any

import numpy as np
from gtsam import Pose3

from adjust.model.errors import SurveyError
from adjust.model.result import Adjustment, Estimate
from adjust.model.survey import FloatArray
from adjust.model.tables import harmonic
from adjust.testing.distributions import chi2, fisher
from survey.project.project import SIGMA_KINDS
from survey.project.project import SigmaKind as SigmaKind

USUAL: SigmaKind = "a_posteriori"
"""Of results, where the project does not say."""
ARCSEC_PER_RAD = 180.0 * 3600.0 / np.pi
PROBABILITY = 0.95


@dataclass(frozen=True)
class Scale:
    """What covariances of unknowns are multiplied with: ``factor`` is 1 (a priori) or sigma0 (a posteriori).

    ellipsoid: semi-axes of the 95 % confidence ellipsoid of a position, in sigmas along its axes.
    """

    sigmas: SigmaKind
    factor: float
    ellipsoid: float


def scale_of(adjustment: Adjustment, sigmas: SigmaKind | None) -> Scale:
    """The scale asked for, ``USUAL`` where None; without redundancy there is no sigma0, and sigmas stay a priori.

    Raises SurveyError for a word that is none of ``SIGMA_KINDS``.

    The ellipsoid follows the chi-square distribution with 3 degrees of freedom for a known, Fisher's F(3, r) for an
    estimated sigma0 (Koch 1999, Parameter Estimation and Hypothesis Testing in Linear Models, section 4.3).
    """
    if sigmas not in (None, *SIGMA_KINDS):
        raise SurveyError(f"there are no sigmas {sigmas!r}; write {' or '.join(SIGMA_KINDS)}")
    known = (sigmas or USUAL) == "a_priori" or adjustment.redundancy <= 0 or not np.isfinite(adjustment.sigma0)
    if known:
        return Scale("a_priori", 1.0, float(np.sqrt(chi2.ppf(PROBABILITY, 3))))
    ellipsoid = float(np.sqrt(3.0 * fisher.ppf(PROBABILITY, 3, adjustment.redundancy)))
    return Scale("a_posteriori", float(adjustment.sigma0), ellipsoid)


SMALL_ANGLES = {
    "non_orthogonality", "tilt_1", "tilt_2", "vertical_index", "inclination", "across_1", "across_2",
}  # fmt: skip

PARTS_PER_MILLION = {"distance_scale", "scale_x", "scale_y", "shear"}


def unit_for_people(component: str, unit: str) -> tuple[str, float]:
    """Unit and factor in which a person reads a value: mm, deg (arcsec for what is always small), ppm, px."""
    if unit == "m":
        return "mm", 1e3
    if unit == "rad":
        small = component in SMALL_ANGLES or harmonic(component) is not None
        return ("arcsec", ARCSEC_PER_RAD) if small else ("deg", 180.0 / np.pi)
    if component in PARTS_PER_MILLION:
        return "ppm", 1e6
    if unit == "1/K":
        return "ppm_per_K", 1e6
    return ("" if unit in ("1", "") else unit.replace("/K", "_per_K")), 1.0


def sigma_unit_for_people(unit: str, component: str = "") -> tuple[str, float]:
    """Unit and factor in which a person reads a residual or a sigma: mm, arcsec, ppm, px."""
    return ("arcsec", ARCSEC_PER_RAD) if unit == "rad" else unit_for_people(component, unit)


def key_of(component: str, unit: str) -> str:
    """``component_unit``, with powers spelt: ``K1_per_mm2``."""
    power = re.fullmatch(r"(?:1/)?([A-Za-z]+)\^?(-?\d*)", unit)
    if power and (unit.startswith("1/") or power[2].startswith("-")):
        exponent = power[2].lstrip("-")
        unit = f"per_{power[1]}{'' if exponent == '1' else exponent}"
    return f"{component}_{unit}" if unit else component


def sigmas_of(estimate: Estimate, scale: Scale) -> FloatArray:
    """Sigmas (n,) in the tangent, units inside."""
    return scale.factor * np.sqrt(np.clip(np.diag(estimate.cov), 0.0, None))


def status_of(estimate: Estimate) -> Any:
    """One word where all components share it, else a word per component."""
    if len(set(estimate.status)) == 1:
        return estimate.status[0]
    return dict(zip(estimate.components, estimate.status, strict=True))


def vector_entry(estimate: Estimate, scale: Scale) -> dict[str, Any]:
    """Value, sigma and status of every component of a lens, a table, a warp or angles."""
    entry: dict[str, Any] = {}
    values = np.asarray(estimate.value, dtype=float)
    for name, unit, value, sigma in zip(
        estimate.components, estimate.units, values, sigmas_of(estimate, scale), strict=True
    ):
        value_unit, value_factor = unit_for_people(name, unit)
        sigma_unit, sigma_factor = sigma_unit_for_people(unit, name)
        entry[key_of(name, value_unit)] = float(value * value_factor)
        entry[key_of(f"sigma_{name}", sigma_unit)] = float(sigma * sigma_factor)
    return entry | {"status": dict(zip(estimate.components, estimate.status, strict=True))}


def pose_dict(pose: Pose3) -> dict[str, Any]:
    """Translation, unit quaternion with w >= 0, and Euler angles with R = Rz(z) Ry(y) Rx(x)."""
    rotation = pose.rotation()
    q: Any = rotation.toQuaternion()  # a class that the stubs leave out
    wxyz = np.array([q.w(), q.x(), q.y(), q.z()])
    return {
        "translation_mm": (1e3 * np.asarray(pose.translation())).tolist(),
        "rotation_quaternion_wxyz": (wxyz if wxyz[0] >= 0.0 else -wxyz).tolist(),
        "rotation_euler_xyz_deg": np.degrees(rotation.xyz()).tolist(),
    }


def pose_entry(estimate: Estimate, scale: Scale) -> dict[str, Any]:
    """A pose ``a_from_b``: sigmas of its origin along the axes of a, sigmas of its rotation about the axes of b.

    The tangent of the covariance is in b; the translation part is turned into a: ``R cov R'``.
    """
    pose = estimate.value
    if not isinstance(pose, Pose3):
        raise TypeError(f"{'/'.join(estimate.name)} is not a pose")
    R = pose.rotation().matrix()
    translation_cov = R @ estimate.cov[3:, 3:] @ R.T
    translation_sigmas = scale.factor * np.sqrt(np.clip(np.diag(translation_cov), 0.0, None))
    rotation_sigmas = sigmas_of(estimate, scale)[:3]
    return pose_dict(pose) | {
        "sigma_translation_mm": (1e3 * translation_sigmas).tolist(),
        "sigma_rotation_arcsec": (ARCSEC_PER_RAD * rotation_sigmas).tolist(),
        "status": status_of(estimate),
    }


def point_entry(estimate: Estimate, scale: Scale) -> dict[str, Any]:
    """Coordinates, sigmas and the 95 % confidence ellipsoid (semi-axes, and their directions as rows)."""
    entry: dict[str, Any] = {}
    values, sigmas = np.asarray(estimate.value, dtype=float), sigmas_of(estimate, scale)
    for axis, value, sigma in zip("xyz", values, sigmas, strict=True):
        entry[f"{axis}_mm"], entry[f"sigma_{axis}_mm"] = float(1e3 * value), float(1e3 * sigma)
    semi_axes, directions = ellipsoid(estimate.cov, scale)
    entry["ellipsoid_95_semi_axes_mm"] = (1e3 * semi_axes).tolist()
    entry["ellipsoid_95_directions"] = directions.tolist()
    return entry | {"status": status_of(estimate)}


def ellipsoid(cov: FloatArray, scale: Scale) -> tuple[FloatArray, FloatArray]:
    """Semi-axes (3,) m of the 95 % confidence ellipsoid, largest first, and their directions, one per row."""
    variances, vectors = np.linalg.eigh(cov)
    semi_axes = scale.ellipsoid * scale.factor * np.sqrt(np.clip(variances, 0.0, None))[::-1]
    directions = vectors.T[::-1]
    # the sign of an axis is arbitrary: its largest component points forward, so that equal input gives equal bytes
    largest = directions[np.arange(3), np.abs(directions).argmax(axis=1)]
    return semi_axes, directions * np.where(largest < 0.0, -1.0, 1.0)[:, None]
