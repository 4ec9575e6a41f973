"""A congruence test as plain values and as text."""

import math
from typing import Any

import numpy as np

from adjust.epochs.congruence_result import Congruence, CongruenceTest, Motion
from survey.folder.plain import plain
from survey.solution.quantities import ARCSEC_PER_RAD

_MOST = 60


def congruence_dict(found: Congruence) -> dict[str, Any]:
    """As plain values; None where something was not measured or cannot be tested."""
    return {
        "alpha": found.alpha,
        "sigma0": plain(found.sigma0),
        "redundancy": plain(found.redundancy),
        "p_equal_variances": plain(found.ratio_p),
        "motions_left_open": list(found.datum),
        "all": _test(found.before),
        "stable": _test(found.after),
        "stable_names": [_name(n) for n in found.stable],
        "moved_names": [_name(n) for n in found.moved],
        "search": [{"name": _name(s.name), "share": plain(s.share), "test": _test(s.test)} for s in found.steps],
        "motions": [_motion(m) for m in found.motions],
        "warnings": list(found.warnings),
    }


def congruence_text(found: Congruence) -> str:
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
    turned = [m for m in found.motions if not np.isfinite(m.displacement).any()]
    if turned and len(turned) == len(found.motions):
        head = f"    {'':<14}{'rx':>9}{'ry':>9}{'rz':>9}{'sigmas':>21}{'p':>10}   arcsec"
        return ["  rotations alone were measured: they are compared, displacements are not known", head,
                *(_turn_row(m) for m in turned[:_MOST])]  # fmt: skip
    head = f"    {'':<14}{'dx':>9}{'dy':>9}{'dz':>9}{'sigmas':>21}{'p':>10}{'found from':>12}   mm"
    return [head, *(_shift_row(m) for m in found.motions[:_MOST])]


def _shift_row(m: Motion) -> str:
    d, s = 1e3 * m.displacement, 1e3 * np.sqrt(np.maximum(np.diag(m.cov), 0.0))
    cells = "".join(_cell(x, 9, 3) for x in d) + "".join(_cell(x, 7, 3) for x in s)
    return f"    {' '.join(m.name[1:]):<14}{cells}{_cell(m.test.p, 10, 4)}{_cell(1e3 * m.smallest, 12, 2)}{_mark(m)}"


def _turn_row(m: Motion) -> str:
    turn = np.full(3, np.nan) if m.rotation is None else m.rotation
    spread = np.full(3, np.nan) if m.rotation_cov is None else np.sqrt(np.maximum(np.diag(m.rotation_cov), 0.0))
    cells = "".join(_cell(ARCSEC_PER_RAD * x, 9, 1) for x in turn)
    cells += "".join(_cell(ARCSEC_PER_RAD * x, 7, 1) for x in spread)
    return f"    {' '.join(m.name[1:]):<14}{cells}{_cell(m.test.p, 10, 4)}{_mark(m)}"


def _mark(m: Motion) -> str:
    return " *" if m.significant else "" if m.stable else " (not in the datum)"


def _name(name: tuple[str, ...]) -> str:
    return "/".join(name)


def _test(test: CongruenceTest) -> dict[str, Any]:
    return {"f": plain(test.statistic), "freedom": test.freedom, "freedom_sigma0": plain(test.freedom_sigma0),
            "p": plain(test.p), "passed": test.passed}  # fmt: skip


def _motion(m: Motion) -> dict[str, Any]:
    out: dict[str, Any] = {
        "name": _name(m.name),
        "displacement_mm": plain(1e3 * m.displacement),
        "sigma_displacement_mm": plain(1e3 * np.sqrt(np.maximum(np.diag(m.cov), 0.0))),
        "semi_axes_mm": [1e3 * float(x) for x in m.ellipsoid.semi_axes],
        "test": _test(m.test),
        "smallest_mm": plain(1e3 * m.smallest),
        "stable": m.stable,
        "significant": m.significant,
    }
    if m.rotation is not None and m.rotation_cov is not None and m.rotation_test is not None:
        out["rotation_arcsec"] = [ARCSEC_PER_RAD * float(x) for x in m.rotation]
        out["sigma_rotation_arcsec"] = [ARCSEC_PER_RAD * math.sqrt(max(0.0, float(v))) for v in np.diag(m.rotation_cov)]
        out["test_rotation"] = _test(m.rotation_test)
    return out


def _cell(value: float, width: int, digits: int) -> str:
    # a space of its own: large values must not run together
    return f" {value:>{width - 1}.{digits}f}" if math.isfinite(value) else f"{'-':>{width}}"
