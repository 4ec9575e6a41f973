"""The job ``compare``: two epochs of the same points and stations, adjusted each by itself, and what moved between."""

import math
import os
from functools import cached_property
from pathlib import Path

import numpy as np

from adjust.diagnosis.between import Between, causes_between
from adjust.epochs.congruence import CongruenceOptions, congruence
from adjust.epochs.congruence_result import Congruence, CongruenceTest, Motion
from adjust.epochs.deformation import Deformation, station_deformations
from adjust.model.errors import SurveyError, listed
from adjust.model.frozen import frozen
from adjust.model.result import Adjustment
from adjust.observations.copies import shared_observations
from survey.folder.plain import attributes, plain
from survey.jobs.adjusting.steps import adjust_project
from survey.project import Project, read
from survey.solution.quantities import ARCSEC_PER_RAD, SigmaKind, sigmas_in

ALPHA = 0.05
"""Error probability of the tests of all pairs of stations together."""
_MOST = 60


@frozen(eq=False)
class CompareOutcome:
    """Both folders with their adjustments, the deformation of neighbouring stations, and the congruence of all.

    congruence: None where nothing common can be tested; ``why`` then says what is in the way. sigmas: what both
    projects ask for; None: the pairs of stations are tested a priori, the congruence of all with the pooled sigma0.
    causes: what explains that they are not congruent, other than motions.
    """

    folders: tuple[Path, Path]
    adjustments: tuple[Adjustment, Adjustment]
    deformations: tuple[Deformation, ...]
    congruence: Congruence | None = None
    why: str = ""
    sigmas: SigmaKind | None = None
    causes: tuple[Between, ...] = ()

    @property
    def problems(self) -> tuple[str, ...]:
        """Causes other than motions; what the adjustments warn of: wrong sigmas there make wrong tests here."""
        pairs = zip(self.folders, self.adjustments, strict=True)
        causes = (f"probable cause: {c.cause}; {c.change} (then p {c.p:.2g})" for c in self.causes)
        warnings = (f"{folder}: {warning}" for folder, adjustment in pairs for warning in adjustment.warnings)
        return (*self._dependence, *self._alone, *causes, *warnings)

    @cached_property
    def _alone(self) -> tuple[str, ...]:
        """What stands in one epoch only, where that is more than stands in both: other names, or another survey."""
        first, second = (
            {*(p.point_id for p in a.survey.points), *(s.station_id for s in a.survey.stations)}
            for a in self.adjustments
        )
        apart = zip(self.folders, (first - second, second - first), strict=True)
        said = [f"{folder}: {listed(sorted(own), 4)}" for folder, own in apart if own]
        return () if len(first & second) >= len(first ^ second) / 2 else (
            f"only {len(first & second)} stations and points stand in both epochs, the others in one "
            f"({'; '.join(said)}), where they are not compared; give the same things the same ids",
        )  # fmt: skip

    @cached_property
    def _dependence(self) -> tuple[str, ...]:
        """What says that the epochs are not independent; empty where they may be."""
        shared = sum(shared_observations(*(a.survey for a in self.adjustments)).values())
        return () if not shared else (
            f"{shared} observations have the same values in both epochs, which are not independent, as the tests take "
            "them, so that sigmas of motions are too large and what moved may stay hidden; compare epochs that were "
            "measured anew (how far observations move a solution, 'labsurvey add' and 'labsurvey remove' say)",
        )  # fmt: skip

    def summary(self) -> dict[str, object]:
        """As plain values; None where something was not measured or cannot be tested."""
        return {
            "folders": [str(f) for f in self.folders],
            "sigma0": plain([a.sigma0 for a in self.adjustments]),
            "redundancy": [a.redundancy for a in self.adjustments],
            "sigmas": self.sigmas or "a_priori",
            "alpha": ALPHA,
            "deformations": [_entry(d) for d in self.deformations],
            "congruence": None if self.congruence is None else _congruence_dict(self.congruence),
            "diagnosis": [attributes(c, "name", "cause", "change") | {"ids": list(c.ids), "statistic": c.statistic}
                          | {"statistic_as_it_is": c.before, "p": c.p} for c in self.causes],
            "warnings": list(self.problems),
        }

    def text(self) -> str:
        """A table for people: rotation vectors and displacements with their sigmas; a star marks what is real."""
        whole = self.why if self.congruence is None else _congruence_text(self.congruence)
        if not self.deformations:
            problems = "".join(f"\n  ! {p}" for p in self.problems)
            return f"{self.folders[0]} -> {self.folders[1]}{problems}\n{whole}"
        moved = sum(d.significant for d in self.deformations)
        width = max(7, *(len(f"{d.a} - {d.b}") for d in self.deformations))
        head = f"  {'':<{width}}  {'rotation, arcsec':^42}  {'displacement, mm':^42}"
        axes = "".join(f"{axis:>7}{'sigma':>7}" for axis in "xyz")
        return "\n".join([
            f"{self.folders[0]} -> {self.folders[1]}: {moved} of {len(self.deformations)} relations moved "
            f"(error probability {ALPHA:g} for all together, {(self.sigmas or 'a_priori').replace('_', ' ')} sigmas)",
            *(f"  ! {p}" for p in self.problems),
            "", head.rstrip(), f"  {'a - b':<{width}}  {axes}  {axes}{'p':>9}",
            *(_row(d, width) for d in self.deformations),
            "", "  motion of a as seen from b, along the axes of a in the first epoch", "", whole,
        ])  # fmt: skip


def compare_job(folder_a: Path, folder_b: Path, *, progress: bool = True) -> CompareOutcome:
    """Adjust two project folders and compare their stations; writes nothing. Raises SurveyError."""
    folders = Path(folder_a), Path(folder_b)
    if os.path.realpath(folders[0]) == os.path.realpath(folders[1]):
        raise SurveyError(f"{folders[1]}: is the first epoch itself; name the folder of another epoch")
    projects = read(folders[0]), read(folders[1])
    sigmas = _sigmas(projects)
    first, second = (_adjusted(project, progress) for project in projects)
    power, names = max(p.options.power for p in projects), (folders[0].name, folders[1].name)
    options = CongruenceOptions(ALPHA, sigmas != "a_priori", power=power, names=names)
    try:
        found, why = congruence(first, second, options), ""
    except SurveyError as error:
        found, why = None, f"no congruence test: {error}"
    causes = () if found is None else causes_between(first, second, found, options)
    stations = [{s.station_id for s in a.survey.stations if s.motion == "fixed"} for a in (first, second)]
    if found is not None and len(stations[0] & stations[1]) < 2:
        return CompareOutcome(folders, (first, second), (), found, sigmas=sigmas, causes=causes)
    scaled = (sigmas == "a_posteriori",) * 2
    moved = station_deformations(first, second, alpha=ALPHA, scale=(scaled[0], scaled[1]))
    return CompareOutcome(folders, (first, second), moved, found, why, sigmas, causes)


def _sigmas(projects: tuple[Project, Project]) -> SigmaKind | None:
    """What both ask for; what only one says holds for the other too."""
    asked = {p.options.sigmas: p.folder for p in projects if p.options.sigmas is not None}
    if len(asked) > 1:
        said = ", ".join(f"{folder} {kind}" for kind, folder in asked.items())
        raise SurveyError(f"[adjustment] sigmas differ ({said}), and a test has but one kind; make them the same")
    return next(iter(asked), None)


def _adjusted(project: Project, progress: bool) -> Adjustment:
    folder = project.folder
    if project.images and not (project.survey.image_blocks or project.spots):
        raise SurveyError(
            f"{folder}: nothing was detected in its images yet, and a comparison writes nothing; run 'labsurvey detect "
            f"{folder}' first"
        )
    try:
        return adjust_project(project, progress)
    except SurveyError as error:
        # of two folders the message must say which
        raise error if str(folder) in str(error) else SurveyError(f"{folder}: {error}") from error


def _entry(d: Deformation) -> dict[str, object]:
    sigmas = d.sigmas
    tests = {"test_rotation": d.rotation_test, "test_displacement": d.displacement_test, "test": d.test}
    return dict(plain({
        "a": d.a, "b": d.b, "rotation_arcsec": ARCSEC_PER_RAD * d.rotation,
        "sigma_rotation_arcsec": ARCSEC_PER_RAD * sigmas[:3],
        "rotation_euler_xyz_arcsec": ARCSEC_PER_RAD * d.euler_zyx,
        "sigma_rotation_euler_xyz_arcsec": ARCSEC_PER_RAD * np.sqrt(np.diag(d.euler_cov)),
        "displacement_mm": 1e3 * d.displacement, "sigma_displacement_mm": 1e3 * sigmas[3:],
        **{key: {"chi_square": x.statistic, "freedom": x.freedom, "p": x.p} for key, x in tests.items()},
        "significant": d.significant,
    }))  # fmt: skip


def _row(d: Deformation, width: int) -> str:
    s = d.sigmas
    turn = "".join(_cell(ARCSEC_PER_RAD * x, 7, 1) for k in range(3) for x in (d.rotation[k], s[k]))
    shift = "".join(_cell(1e3 * x, 7, 3) for k in range(3) for x in (d.displacement[k], s[3 + k]))
    p = f"{d.test.p:9.2g}" if math.isfinite(d.test.p) else f"{'-':>9}"
    return f"  {f'{d.a} - {d.b}':<{width}}  {turn}  {shift}{p}{' *' if d.significant else ''}"


def _congruence_dict(found: Congruence) -> dict[str, object]:
    """As plain values; None where something was not measured or cannot be tested."""
    return {
        "alpha": found.alpha,
        "sigma0": plain(found.sigma0),
        "redundancy": plain(found.redundancy),
        "p_equal_variances": plain(found.ratio_p),
        "motions_left_open": list(found.datum),
        "all": _f_test(found.before),
        "stable": _f_test(found.after),
        "stable_names": [_name(n) for n in found.stable],
        "moved_names": [_name(n) for n in found.moved],
        "search": [{"name": _name(s.name), "share": plain(s.share), "test": _f_test(s.test)} for s in found.steps],
        "motions": [_motion(m) for m in found.motions],
        "warnings": list(found.warnings),
    }


def _congruence_text(found: Congruence) -> str:
    """For people: the verdict, and every point and station, moved ones first."""
    stable, n = len(found.stable), len(found.motions)
    verdict = "nothing moved" if found.before.passed else f"{len(found.moved)} of {n} moved"
    open_ = ", ".join(found.datum) or "none"
    lines = [
        f"congruence of all {n}: {verdict} (F {found.before.statistic:.2f}, p {found.before.p:.2g}); of the {stable} "
        f"stable ones: p {found.after.p:.2g}; sigma0 {found.sigma0:.3f}; motions left open: {open_}",
        *(f"  ! {w}" for w in found.warnings),
        *_table(found),
    ]
    if n > _MOST:
        lines.append(f"    and {n - _MOST} more")
    return "\n".join(lines)


def _table(found: Congruence) -> list[str]:
    """A line per point and station: displacements, or rotations where nothing else is known."""
    turned = found.motions and not any(np.isfinite(m.displacement).any() for m in found.motions)
    rows = []
    for m in found.motions[:_MOST]:
        of, cov, factor = (m.rotation, m.rotation_cov, ARCSEC_PER_RAD) if turned else (m.displacement, m.cov, 1e3)
        digits, nothing = 1 if turned else 3, np.full(3, np.nan)
        values, sigmas = nothing if of is None else factor * of, nothing if cov is None else factor * sigmas_in(cov)
        cells = "".join(_cell(x, 9, digits) for x in values) + "".join(_cell(x, 7, digits) for x in sigmas)
        least = "" if turned else _cell(1e3 * m.smallest, 12, 2)
        rows.append(f"    {' '.join(m.name[1:]):<14}{cells}{_cell(m.test.p, 10, 4)}{least}{_mark(m)}")
    if turned:
        said = ["  rotations alone were measured: they are compared, displacements are not known"]
        return [*said, f"    {'':<14}{'rx':>9}{'ry':>9}{'rz':>9}{'sigmas':>21}{'p':>10}   arcsec", *rows]
    return [f"    {'':<14}{'dx':>9}{'dy':>9}{'dz':>9}{'sigmas':>21}{'p':>10}{'found from':>12}   mm", *rows]


def _mark(m: Motion) -> str:
    return " *" if m.significant else "" if m.stable else " (not in the datum)"


def _name(name: tuple[str, ...]) -> str:
    return "/".join(name)


def _f_test(test: CongruenceTest) -> dict[str, object]:
    return dict(plain({"f": test.statistic, **attributes(test, "freedom", "freedom_sigma0", "p", "passed")}))


def _motion(m: Motion) -> dict[str, object]:
    out: dict[str, object] = {
        "name": _name(m.name),
        "displacement_mm": plain(1e3 * m.displacement),
        "sigma_displacement_mm": plain(1e3 * sigmas_in(m.cov)),
        "semi_axes_mm": [1e3 * float(x) for x in m.ellipsoid.semi_axes],
        "test": _f_test(m.test),
        "smallest_mm": plain(1e3 * m.smallest),
        **attributes(m, "stable", "significant"),
    }
    if m.rotation is not None and m.rotation_cov is not None and m.rotation_test is not None:
        turn, sigmas = (ARCSEC_PER_RAD * x for x in (m.rotation, sigmas_in(m.rotation_cov)))
        out |= {"rotation_arcsec": turn.tolist(), "sigma_rotation_arcsec": sigmas.tolist(),
                "test_rotation": _f_test(m.rotation_test)}  # fmt: skip
    return out


def _cell(value: float, width: int, digits: int) -> str:
    # a space of its own: large values must not run together
    return f" {value:>{width - 1}.{digits}f}" if math.isfinite(value) else f"{'-':>{width}}"
