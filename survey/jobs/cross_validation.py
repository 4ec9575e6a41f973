"""The job behind ``labsurvey cross-validate``: the epochs in two halves, each adjusted by itself, the lenses compared.

Two halves that agree to within their uncertainties are the best evidence that the sigmas of a calibration can be
believed; a lens model that lacks something makes them disagree by more (as in mrcal's cross-validation, see the page of
that name in its tour).
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from gtsam import Rot3
from scipy.stats import chi2

from adjust.graph.assembly import values_of
from adjust.lenses.compared import (
    Difference,
    compared_pixels,
    lens_difference,
    optics_of,
    projection_covariance,
    worst_sigma,
)
from adjust.model.arrays import FloatArray
from adjust.model.errors import SurveyError, listed
from adjust.model.frozen import frozen
from adjust.model.result import Adjustment
from adjust.model.survey import Camera, Survey
from survey.jobs.adjusting.steps import adjust_project
from survey.project import Project
from survey.project.exclusions import Exclusion, Name
from survey.project.reading import leaving_out
from survey.solution.quantities import scale_of


@frozen(eq=False)
class LensHalves:
    """One camera's two lenses. difference: of the second to the first, at ``Difference.uv``.

    sigma: (n,) px in the worst direction, of the difference so fitted, by the covariances of both halves. rms_px,
    expected_px: root mean squares of the length of the shift over the pixels that have observations near, as found and
    as the covariances expect it. components, in_sigmas: of the lens values free in both. statistic, dof, p_value: of
    the chi-square test that the lenses are one.
    """

    camera_id: str
    n_images: tuple[int, int]
    difference: Difference
    sigma: FloatArray
    rms_px: float
    expected_px: float
    components: tuple[str, ...]
    in_sigmas: FloatArray
    statistic: float
    p_value: float

    @property
    def rotation_deg(self) -> float:
        """Angle of the motion of the camera frame that was fitted."""
        return float(np.degrees(np.linalg.norm(Rot3.Logmap(self.difference.second_from_first.rotation()))))

    @property
    def translation_mm(self) -> float:
        """Length of the motion that was fitted; 0 for points at infinity."""
        return 1e3 * float(np.linalg.norm(self.difference.second_from_first.translation()))

    def summary(self) -> dict[str, object]:
        """Plain values."""
        worst = int(np.argmax(np.abs(self.in_sigmas)))
        return {
            "camera": self.camera_id, "n_images": list(self.n_images), "rms_px": self.rms_px,
            "expected_px": self.expected_px, "ratio": self.rms_px / self.expected_px,
            "rotation_deg": self.rotation_deg, "translation_mm": self.translation_mm, "largest": self.components[worst],
            "largest_in_sigmas": float(self.in_sigmas[worst]), "statistic": self.statistic,
            "dof": len(self.components), "p_value": self.p_value,
        }  # fmt: skip

    def pixels(self) -> dict[str, object]:
        """Over the image: pixels, shifts and sigmas (px), and which have observations near."""
        return {"uv": self.difference.uv, "shift": self.difference.shift, "sigma": self.sigma,
                "covered": self.difference.fitted}  # fmt: skip


@frozen(eq=False)
class CrossValidation:
    """A project's epochs in two halves. epochs: of each. sigma0: of each. distance: m, of the points compared."""

    folder: Path
    distance: float
    epochs: tuple[tuple[str, ...], tuple[str, ...]]
    sigma0: tuple[float, float]
    cameras: tuple[LensHalves, ...]
    notes: tuple[str, ...] = ()

    def summary(self) -> dict[str, object]:
        """Plain values, cameras with the largest ratio first; nothing pixel by pixel."""
        return {
            "folder": str(self.folder), "distance_m": None if np.isinf(self.distance) else self.distance,
            "epochs": [list(e) for e in self.epochs], "sigma0": list(self.sigma0),
            "cameras": [c.summary() for c in self.cameras], "notes": list(self.notes),
        }  # fmt: skip

    def text(self) -> str:
        """A line for every camera."""
        first, second = self.epochs
        where = "at infinity" if np.isinf(self.distance) else f"at {self.distance:g} m"
        lines = [
            f"{self.folder}: halves of {len(first)} and {len(second)} epochs, sigma0 {self.sigma0[0]:.4f} and "
            f"{self.sigma0[1]:.4f}; lenses {where}, the motion of the camera taken out",
            "",
            f"  {'camera':<14}{'images':>9}{'differ px':>11}{'expected':>10}{'ratio':>7}{'turned deg':>12}"
            f"{'largest':>16}{'p':>8}",
        ]
        for c in self.cameras:
            d = c.summary()
            largest = f"{d['largest']} {d['largest_in_sigmas']:+.1f} sigma"
            lines.append(f"  {c.camera_id:<14}{f'{c.n_images[0]}+{c.n_images[1]}':>9}{c.rms_px:>11.4f}"
                         f"{c.expected_px:>10.4f}{d['ratio']:>7.2f}{c.rotation_deg:>12.5f}{largest:>16}"
                         f"{c.p_value:>8.2g}")  # fmt: skip
        return "\n".join((*lines, *(f"  ! {note}" for note in self.notes)))


def cross_validate(project: Project, distance: float = np.inf, progress: bool = False) -> CrossValidation:
    """Adjust the epochs of a project in two halves and compare the lenses for points at ``distance`` (m).

    What belongs to no epoch (tapes, given points, what is held) is in both. Raises SurveyError where there are no two
    halves, or one of them cannot be adjusted.
    """
    if not distance > 0.0:
        raise SurveyError(f"distance {distance:g} m: give one that is larger than zero")
    whole = adjust_project(project, progress)
    if project.spots:  # only the whole survey may tell their names
        project = replace(project, survey=whole.survey, spots=())
    epochs = halves(project.survey)
    every = dict.fromkeys(e for half in epochs for e in half)
    parts = [_half(project, whole, [e for e in every if e not in half], progress) for half in map(set, epochs)]
    factors = [scale_of(p, project.options.sigmas).factor for p in parts]
    both = sorted(set(epochs[0]) & set(epochs[1]))
    found, notes = [], [f"in both halves, being the only ones of their sort: {listed(both, 6)}"] if both else []
    for camera in project.survey.cameras:
        one = _lens(camera, parts, factors, distance)
        if isinstance(one, str):
            notes.append(one)
        else:
            found.append(one)
    if not found:
        raise SurveyError("\n".join((f"{project.folder}: there are no lenses to compare", *notes)))
    found.sort(key=lambda c: -c.rms_px / c.expected_px)
    return CrossValidation(project.folder, distance, epochs, (parts[0].sigma0, parts[1].sigma0), tuple(found),
                           tuple(notes))  # fmt: skip


def _half(project: Project, whole: Adjustment, out: Sequence[str], progress: bool) -> Adjustment:
    """The adjustment without these epochs, begun at the values of the whole."""
    free = project.survey.datum.kind == "inner" or project.survey.pair_form == "closed"  # where it begins would matter
    start = None if free else values_of(whole)
    half = leaving_out(project, [Exclusion(Name("epoch", e)) for e in out])
    try:
        return adjust_project(half, progress, lambda _: start)
    except SurveyError as error:
        raise SurveyError(f"{project.folder}: one half of the epochs, without {listed(out, 3)}, cannot be adjusted by "
                          f"itself: {error}") from error  # fmt: skip


def halves(survey: Survey) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Epochs with images, by turns to one half and the other among those that show the same targets alike.

    An epoch that is the only one of its sort may be all that joins two parts of a network: it is in both.
    Raises SurveyError where no epoch is in one half alone.
    """
    seen: dict[str, set[tuple[str, str]]] = {}
    for block in survey.image_blocks:
        seen.setdefault(block.epoch_id, set()).add((block.camera_id, block.target_id or ""))
    sorts: dict[frozenset[tuple[str, str]], list[str]] = {}
    for epoch, what in seen.items():
        sorts.setdefault(frozenset(what), []).append(epoch)
    side: dict[str, set[int]] = {}
    begin = 0
    for epochs in sorts.values():
        for k, epoch in enumerate(epochs):
            side[epoch] = {0, 1} if len(epochs) == 1 else {(begin + k) % 2}
        begin += len(epochs) % 2
    if all(len(sides) == 2 for sides in side.values()):
        raise SurveyError(f"{len(seen)} epochs with image points, no two of which show the same targets to the same "
                          "cameras: there are no two halves")  # fmt: skip
    return tuple(e for e in seen if 0 in side[e]), tuple(e for e in seen if 1 in side[e])


def _lens(camera: Camera, parts: Sequence[Adjustment], factors: Sequence[float], distance: float) -> LensHalves | str:
    """The two lenses of a camera compared, or why they cannot be."""
    name = ("lens", camera.camera_id)
    seen = [[b for b in p.survey.image_blocks if b.camera_id == camera.camera_id] for p in parts]
    if not all(seen) or any(name not in p.estimates for p in parts):
        return f"camera {camera.camera_id}: only one of the halves has images of it"
    first, second = (p.estimates[name] for p in parts)
    free = [k for k, (a, b) in enumerate(zip(first.status, second.status, strict=True)) if {a, b} <= {"free", "prior"}]
    if not free:
        return f"camera {camera.camera_id}: its lens is held"
    lenses = [optics_of(camera, p.estimates) for p in parts]
    uv, near = compared_pixels(lenses, camera.image_size, np.concatenate([b.uv for half in seen for b in half]))
    if near.sum() < 6:
        return f"camera {camera.camera_id}: its image points cover too little of the image"
    found = lens_difference(lenses[0], lenses[1], uv, distance, near)
    covs = [f**2 * p.estimates[name].cov for f, p in zip(factors, parts, strict=True)]
    cov = np.sum([projection_covariance(x, uv, distance, c, near) for x, c in zip(lenses, covs, strict=True)], axis=0)
    change = np.asarray(second.value, dtype=float)[free] - np.asarray(first.value, dtype=float)[free]
    of_change = np.sum(covs, axis=0)[np.ix_(free, free)]
    statistic = float(change @ np.linalg.solve(of_change, change))
    return LensHalves(
        camera.camera_id, (len({b.epoch_id for b in seen[0]}), len({b.epoch_id for b in seen[1]})), found,
        worst_sigma(cov), float(np.sqrt((found.shift[near] ** 2).sum(axis=1).mean())),
        float(np.sqrt(np.trace(cov[near], axis1=1, axis2=2).mean())), tuple(first.components[k] for k in free),
        change / np.sqrt(np.diag(of_change)), statistic, float(chi2.sf(statistic, len(free))),
    )  # fmt: skip
