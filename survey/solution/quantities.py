"""How an estimate is written down: people's units in the names of keys, sigmas scaled in one place.

Everything that a report or a result file says about the precision of an unknown passes through :class:`Scale`.
"""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from gtsam import Pose3

from adjust.model.clocks import INTERVALS
from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.result import Adjustment, Estimate, ParameterName
from adjust.model.survey import FloatArray, IntArray
from adjust.model.tables import harmonic
from adjust.testing.distributions import chi2, fisher
from survey.project.project import SIGMA_KINDS
from survey.project.project import SigmaKind as SigmaKind

USUAL: SigmaKind = "a_posteriori"
"""Of results, where the project does not say."""
ARCSEC_PER_RAD = 180.0 * 3600.0 / np.pi
PROBABILITY = 0.95


@frozen
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

PARTS_PER_MILLION = {"distance_scale", "scale_x", "scale_y", "shear", "drift"}


def unit_for_people(component: str, unit: str) -> tuple[str, float]:
    """Unit and factor in which a person reads a value: mm, deg (arcsec for what is always small), ppm, px."""
    if unit == "m":
        return "mm", 1e3
    if unit == "rad":
        small = component in SMALL_ANGLES or harmonic(component) is not None
        return ("arcsec", ARCSEC_PER_RAD) if small else ("deg", 180.0 / np.pi)
    if component in PARTS_PER_MILLION:
        return "ppm", 1e6
    if unit == "s":
        return ("us", 1e6) if component == "line_time" else ("ms", 1e3)
    if unit == INTERVALS:
        return "intervals", 1.0
    if unit == "1/K":
        return "ppm_per_K", 1e6
    return ("" if unit in ("1", "") else unit.replace("/K", "_per_K")), 1.0


def sigma_unit_for_people(unit: str, component: str = "") -> tuple[str, float]:
    """Unit and factor in which a person reads a residual or a sigma: mm, arcsec, ppm, px."""
    return ("arcsec", ARCSEC_PER_RAD) if unit == "rad" else unit_for_people(component, unit)


@lru_cache
def units_for_people(component: str, unit: str) -> tuple[str, float, str, float]:
    """Both: of its value, and of its residuals and sigmas."""
    return *unit_for_people(component, unit), *sigma_unit_for_people(unit)


def key_of(component: str, unit: str) -> str:
    """``component_unit``, with powers spelt: ``K1_per_mm2``."""
    power = re.fullmatch(r"(?:1/)?([A-Za-z]+)\^?(-?\d*)", unit)
    if power and (unit.startswith("1/") or power[2].startswith("-")):
        exponent = power[2].lstrip("-")
        unit = f"per_{power[1]}{'' if exponent == '1' else exponent}"
    return f"{component}_{unit}" if unit else component


Status = str | dict[str, str]
"""A word for all components, or one for each."""


def sigmas_in(cov: FloatArray) -> FloatArray:
    """Sigmas (n,) of a covariance (n, n); 0 where rounding made a variance negative."""
    return np.asarray(np.sqrt(np.clip(np.diag(cov), 0.0, None)))


def correlations_in(cov: FloatArray) -> FloatArray:
    """Correlations (n, n) of a covariance; 0 where a sigma is 0."""
    s = sigmas_in(cov)
    safe = np.where(s > 0.0, s, np.inf)
    return np.asarray(cov / np.outer(safe, safe))


def sigmas_of(estimate: Estimate, scale: Scale) -> FloatArray:
    """Sigmas (n,) in the tangent, units inside."""
    return scale.factor * sigmas_in(estimate.cov)


def estimated(estimate: Estimate) -> tuple[str, ...]:
    """The components of an estimate that are not held or tied to others."""
    return tuple(c for c, s in zip(estimate.components, estimate.status, strict=True) if s in ("free", "prior"))


def in_joint(estimate: Estimate) -> tuple[str, ...]:
    """The components that stand in a joint covariance: all of a pose or point, the estimated ones of a vector."""
    whole = isinstance(estimate.value, Pose3) or estimate.name[0] == "point"
    return estimate.components if whole else estimated(estimate)


def status_of(estimate: Estimate) -> Status:
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


class Written(NamedTuple):
    """A component as it is written down."""

    name: str
    value: float | None
    unit: str
    sigma: float | None
    sigma_unit: str
    status: str


def components_of(entry: Mapping[str, Any]) -> Iterator[Written]:
    """The components of a :func:`vector_entry`, their units read off its keys."""
    keys = iter(entry)  # in the order of the components, each followed by that of its sigma
    for name, status in entry["status"].items():
        key = next(k for k in keys if k == name or k.startswith(f"{name}_"))
        of_sigma = next(keys)
        yield Written(name, entry[key], key[len(name) + 1 :], entry[of_sigma], of_sigma[len(name) + 7 :], status)


def motion_columns(rotations: FloatArray, translations: FloatArray) -> dict[str, FloatArray]:
    """Of n poses (n, 3, 3), (n, 3) m what :func:`pose_dict` says, by columns (n, 3) or (n, 4)."""
    signs = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    squares = 1.0 + np.diagonal(rotations, axis1=1, axis2=2) @ signs.T  # 4 w^2, 4 x^2, 4 y^2, 4 z^2
    q = np.zeros((len(rotations), 4, 4))  # four times its products; the row of the largest is the best conditioned
    q[:, range(4), range(4)] = squares
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        q[:, 0, i + 1] = q[:, i + 1, 0] = rotations[:, k, j] - rotations[:, j, k]
        q[:, j + 1, k + 1] = q[:, k + 1, j + 1] = rotations[:, k, j] + rotations[:, j, k]
    wxyz = q[np.arange(len(q)), np.argmax(squares, axis=1)]
    wxyz *= np.where(wxyz[:, :1] < 0.0, -1.0, 1.0) / np.linalg.norm(wxyz, axis=1)[:, None]
    R = np.moveaxis(rotations, 0, 2)
    x = np.arctan2(R[2, 1], R[2, 2])
    y = np.arctan2(-R[2, 0], np.hypot(R[2, 1], R[2, 2]))
    # of the first two turns alone, which a quarter turn about y does not hide
    z = np.arctan2(np.sin(x) * R[0, 2] - np.cos(x) * R[0, 1], np.cos(x) * R[1, 1] - np.sin(x) * R[1, 2])
    turns = {"rotation_quaternion_wxyz": wxyz, "rotation_euler_xyz_deg": np.degrees(np.column_stack([x, y, z]))}
    return {"translation_mm": 1e3 * translations} | turns


def pose_dict(pose: Pose3) -> dict[str, Any]:
    """Translation, unit quaternion with w >= 0, and Euler angles with R = Rz(z) Ry(y) Rx(x)."""
    return first_row(motion_columns(pose.rotation().matrix()[None], pose.translation()[None]))


@frozen(eq=False)
class PoseColumns:
    """Poses ``a_from_b`` by columns (n, 3) or (n, 4). rows: by name. status: of each."""

    rows: dict[ParameterName, int]
    columns: dict[str, FloatArray]
    status: list[Status]

    def entry(self, name: ParameterName) -> dict[str, Any]:
        """What is said of one."""
        row = self.rows[name]
        return {key: column[row].tolist() for key, column in self.columns.items()} | {"status": self.status[row]}

    def trees(self, names: Sequence[ParameterName]) -> list[tuple[IntArray, dict[str, Any]]]:
        """Of these, which by number have a word as their status, or one for each component, and their columns."""
        rows = np.array([self.rows[name] for name in names], dtype=np.int64)
        whole = np.array([isinstance(self.status[row], str) for row in rows.tolist()], dtype=np.bool_)
        out = []
        for alike in (np.flatnonzero(whole), np.flatnonzero(~whole)):
            said = [self.status[row] for row in rows[alike].tolist()]
            words = {c: [s[c] for s in said] for c in said[0]} if said and isinstance(said[0], dict) else said
            out.append((alike, {key: column[rows[alike]] for key, column in self.columns.items()} | {"status": words}))
        return out


def pose_columns(estimates: Iterable[Estimate], scale: Scale) -> PoseColumns:
    """Of poses ``a_from_b``: sigmas of their origins along the axes of a, of their rotations about those of b.

    The tangent of the covariance is in b; the translation part is turned into a: ``R cov R'``.
    """
    found = [(e, e.value) for e in estimates if isinstance(e.value, Pose3)]
    R = np.array([pose.rotation().matrix() for _, pose in found]).reshape(-1, 3, 3)
    t = np.array([pose.translation() for _, pose in found]).reshape(-1, 3)
    cov = np.array([e.cov for e, _ in found]).reshape(-1, 6, 6)
    shift = 1e3 * scale.factor * np.sqrt(_variances(R @ cov[:, 3:, 3:] @ np.swapaxes(R, 1, 2)))
    turn = ARCSEC_PER_RAD * scale.factor * np.sqrt(_variances(cov[:, :3, :3]))
    columns = motion_columns(R, t) | {"sigma_translation_mm": shift, "sigma_rotation_arcsec": turn}
    return PoseColumns({e.name: i for i, (e, _) in enumerate(found)}, columns, [status_of(e) for e, _ in found])


def _variances(cov: FloatArray) -> FloatArray:
    """Diagonals (n, k) of covariances (n, k, k)."""
    return np.clip(np.diagonal(cov, axis1=1, axis2=2), 0.0, None)


def pair_sigmas(rotations: FloatArray, covs: FloatArray, factor: float = 1.0) -> dict[str, FloatArray]:
    """Sigmas (n, 3) of n ``b_from_a`` times factor: rotation about the axes of a, translation along the axes of b.

    rotations: (n, 3, 3) of ``b_from_a``. covs: (n, 6, 6) or (n, 3, 3) in the tangent in frame a.
    """
    out = {"sigma_rotation_arcsec": ARCSEC_PER_RAD * factor * np.sqrt(_variances(covs[:, :3, :3]))}
    if covs.shape[1] == 6:
        turned = rotations @ covs[:, 3:, 3:] @ np.swapaxes(rotations, 1, 2)
        out["sigma_translation_mm"] = 1e3 * factor * np.sqrt(_variances(turned))
    return out


def first_row(columns: Mapping[str, FloatArray]) -> dict[str, Any]:
    """What columns say of the first of their rows."""
    return {name: column[0].tolist() for name, column in columns.items()}


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
