"""Sections on measured pairs: what the network can tell, its loops one by one, and the adjusted pairs, worst first."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from markupsafe import Markup

from survey.report import markup as m
from survey.report.context import Context
from survey.report.language import message, t

_MOST_LOOPS = 60
_MOST_PAIRS = 150
_MOST_NAMES = 30


def network(c: Context) -> Markup:
    """The counts of theorem 1, and what is weak by name."""
    n = c.solution.get("network")
    if n is None:
        return Markup()
    each = t("poses") if n["equations_per_condition"] == 6 else t("rotations")
    measured = t("{n} of {most} measurable", n=m.count(n["measured_pairs"]), most=m.count(n["measurable_pairs"]))
    facts = [
        (t("stations"), m.count(n["n_stations"])),
        (t("parts"), m.count(n["n_parts"])),
        (t("independent unknown {each}", each=each), m.count(n["independent_unknown_poses"])),
        (t("pairs measured"), measured),
        (t("triangle conditions"), m.count(n["triangle_conditions"])),
        (t("independent conditions"), m.count(n["independent_conditions"])),
        (t("redundancy"), t("{n} equations", n=m.count(n["redundancy"]))),
        (t("conditions per pair"), m.fixed(n["conditions_per_pair"], 2)),
    ]
    if n["conditions_through_given_stations"]:
        facts.insert(6, (t("of these through given stations"), m.count(n["conditions_through_given_stations"])))
    note = t(
        "n stations have n − 1 independent relative poses; every independent loop of pairs adds a condition. A pair "
        "that closes no loop cannot be checked. Pairs that share all their loops: an error in one is seen, but not "
        "told from one in the others."
    )
    return m.section("network", "Network of measured pairs", m.definition(facts) + m.listed(_weak(n)), note)


def _weak(n: dict[str, Any]) -> list[Markup]:
    out = []
    for i, names in enumerate(n["parts"][:10]):
        out.append(t("Part {i}: {names}", i=i + 1, names=_named(names)))
    if len(n["parts"]) > 10:
        out.append(t("{n} more parts in solution.json", n=m.count(len(n["parts"]) - 10)))
    if n["uncontrolled_pairs"]:
        out.append(t("Close no loop: {names}", names=_named(n["uncontrolled_pairs"])))
    groups = n["inseparable_pairs"]
    out += [t("Errors seen but not told apart: {names}", names=_named(group)) for group in groups[:10]]
    if len(groups) > 10:
        out.append(t("{n} more such groups in solution.json", n=m.count(len(groups) - 10)))
    return out


def _named(ids: Sequence[str]) -> Markup:
    more = t(" and {n} more", n=m.count(len(ids) - _MOST_NAMES)) if len(ids) > _MOST_NAMES else ""
    return m.joined(map(m.code, ids[:_MOST_NAMES]), ", ") + more


def loops(c: Context) -> Markup:
    """Misclosures from the measured pairs alone, before any adjustment, and what is left of them after it."""
    found = c.solution.get("loops")
    if found is None or not found["n_loops"]:
        return Markup()
    entries = found["worst_first"][:_MOST_LOOPS]
    poses = any("misclosure_mm" in e for e in entries)
    rows = [_loop_row(e, poses) for e in entries]
    columns = ["<Loop", "<", "Misclosure", "σ [″]"] + (["[mm]", "σ [mm]"] if poses else [])
    columns += ["Test", "p", "After", *(["[mm]"] if poses else []), "<Pairs"]
    shown = (
        t("All {n}", n=m.count(found["n_loops"]))
        if len(rows) == found["n_loops"]
        else t("The worst {shown} of {n}", shown=m.count(len(rows)), n=m.count(found["n_loops"]))
    )
    note = t(
        "{shown} independent loops ({note}), from the measured pairs alone, before any adjustment. σ: "
        "of the misclosure, along its direction, from the covariances of the pairs. Test: w′C⁻¹w, chi-square with "
        "{freedom} degrees of freedom; a loop is open where its p is too small for chance at {alpha} % for all loops "
        "together ({failed} are).",
        shown=shown, note=message(found["note"]), freedom=6 if poses else 3, alpha=m.general(100 * found["alpha"]),
        failed=m.count(found["n_failed"]),
    )  # fmt: skip
    note += " " + t(
        "After: by the adjusted pairs, {form}.",
        form=t("all loops closed as conditions" if found["solved_by"] == "conditions" else
               "each by the poses of its frames"),
    )
    note += m.more(found["n_loops"] - len(rows))
    classes = ["" if e["closes"] else "suspect" for e in entries]
    return m.section("loops", "Loop closures", m.table(columns, rows, "", classes), note) + _mounts(c)


def _mounts(c: Context) -> Markup:
    """Loops that a mechanical mount closes."""
    entries = c.solution.get("closures", {})
    if not entries:
        return Markup()
    rows = []
    for name, e in entries.items():
        measured = _both(e["misclosure_arcsec"], e.get("misclosure_mm"))
        given = _both(e["sigma_arcsec"], e["sigma_mm"] if "misclosure_mm" in e else None)
        play = _both(e["play_arcsec"], e.get("play_mm")) if "play_arcsec" in e else ""
        rows.append([name, measured, given, play, m.general(e["test"], 4), m.p_text(e["p_value"]),
                     m.element("small", ", ".join(_shortened(e["pairs"])))])  # fmt: skip
    columns = ["<Mount", "Misclosure", "σ of the mount", "Its play", "Test", "p", "<Pairs"]
    note = t("Loops through a mount close as well as it repeats: σ as given, about and along each axis; its play is "
             "what the adjustment leaves of the misclosure to it.")  # fmt: skip
    return m.section("mounts", "Loops through a mount", m.table(columns, rows, ""), note)


def _both(arcsec: float, mm: float | None) -> str:
    return f"{m.general(arcsec, 3)}″" + ("" if mm is None else f" {m.general(mm, 3)} mm")


def _left(value: float | None, unit: str) -> str:
    """What is left of a misclosure; below a millionth of its unit it is rounding."""
    if value is None:
        return ""
    return f"{m.general(value, 3) if value > 1e-6 else '0'}{unit}"


def _loop_row(e: dict[str, Any], poses: bool) -> list[str]:
    stations = " → ".join(_shortened([*e["stations"], e["stations"][0]]))
    left_out = set(e["pairs_not_used"])
    pairs = m.joined((m.element("s", p) if p in left_out else p for p in _shortened(e["pairs"])), ", ")
    flag = Markup() if e["closes"] else m.pill("bad", t("open"))
    flag += " " + m.pill("soft", t("pair not used")) if left_out else ""
    sigma = e["sigma_misclosure_arcsec"]
    cells: list[str] = [stations, flag, angle_text(e["misclosure_arcsec"], sigma), m.sigma_text(sigma)]
    if poses:
        cells += [m.value_text(e["misclosure_mm"], e["sigma_misclosure_mm"]), m.sigma_text(e["sigma_misclosure_mm"])]
    cells += [m.general(e["test"], 4), m.p_text(e["p_value"]), _left(e.get("misclosure_after_arcsec"), "″")]
    cells += [_left(e.get("misclosure_after_mm"), "")] if poses else []
    return [*cells, m.element("small", pairs)]


def _shortened(names: Sequence[str], most: int = 12) -> list[str]:
    return list(names) if len(names) <= most else [*names[: most - 2], "…", names[-1]]


def angle_text(arcsec: float, sigma: float | None) -> str:
    """An angle of a few arcminutes or more in those too: 2′ 05″."""
    if arcsec < 60.0:
        return f"{m.value_text(arcsec, sigma) if sigma else m.general(arcsec, 3)}″"
    if arcsec >= 3600.0:
        return f"{arcsec / 3600.0:.4g}°"
    decimals = min(m.decimals_for(sigma) or 0, 2)
    minutes = int(arcsec // 60.0)
    rest = round(arcsec - 60.0 * minutes, decimals)
    if rest >= 60.0:
        minutes, rest = minutes + 1, 0.0
    return f"{minutes}′ {rest:0{3 + decimals if decimals else 2}.{decimals}f}″"


def pairs(c: Context) -> Markup:
    """Adjusted pairs: value with sigma, residual, redundancy, test."""
    every = c.solution["pairs"]
    if not every:
        return Markup()
    tests = np.nan_to_num(list(every.numbers("test").values()), nan=-1.0)
    names = list(every)
    order = [names[i] for i in np.argsort(-tests, kind="stable")[:_MOST_PAIRS].tolist()]
    poses = any("translation_mm" in every[p]["measured"] for p in order)
    rows = [_pair_row(p, every[p], poses) for p in order]
    columns = ["<Pair, from a to b", "Residual", *(["[mm]"] if poses else []), "Redundancy", "Largest std."]
    columns += ["Test", "p", "<", "x [°]", "y [°]", "z [°]", *(["x [mm]", "y [mm]", "z [mm]"] if poses else [])]
    more = " " + t("The worst {shown} of {n}", shown=m.count(len(rows)), n=m.count(len(every))) + "."
    more = more if len(every) > len(rows) else Markup()
    note = t(
        "Adjusted b_from_a: quaternion w x y z, Euler angles of R = Rz(z) Ry(y) Rx(x) with the σ of small rotations "
        "about the axes of a, translation with its σ along the axes of b. Residual: length of the rotation and of the "
        "translation that takes the measured pair to the adjusted one; of pairs not used, to its prediction. "
        "Redundancy: mean of its components, 0 where nothing checks the pair, 1 where the others alone determine it."
    ) + more
    classes = ["off" if not every[p]["used"] else "" for p in order]
    return m.section("pairs", "Adjusted pairs", m.table(columns, rows, "", classes), note)


def _pair_row(pair_id: str, e: dict[str, Any], poses: bool) -> list[str]:
    value = e.get("adjusted", {})
    quaternion = " ".join(m.fixed(q, 7) for q in value.get("rotation_quaternion_wxyz", ()))
    ends = " → ".join(e[end].removeprefix("station:") for end in "ab")
    cells: list[str] = [m.part("below", m.joined((m.element("b", pair_id), ends), " "), quaternion)]
    cells.append(angle_text(e["misfit_arcsec"], None) if e.get("misfit_arcsec") is not None else m.MISSING)
    cells += [m.general(e.get("misfit_mm"), 4)] if poses else []
    redundancy = [r for r in e.get("redundancy", ()) if r is not None]
    largest = max((abs(s) for s in e.get("standardized", ()) if s is not None), default=None)
    cells += [m.fixed(sum(redundancy) / len(redundancy), 2) if redundancy else m.MISSING, m.fixed(largest, 2)]
    cells += [m.general(e.get("test"), 4), m.p_text(e.get("p_value")), _pair_flag(e)]
    sigmas = value.get("sigma_rotation_arcsec", [None] * 3)
    for angle, sigma in zip(value.get("rotation_euler_xyz_deg", [None] * 3), sigmas, strict=True):
        shown = m.value_text(angle, None if not sigma else sigma / 3600.0)
        cells.append(m.part("below", shown, f"± {m.sigma_text(sigma)}″"))
    if poses:
        shift = value.get("translation_mm", [None] * 3)
        along = value.get("sigma_translation_mm", [None] * 3)
        cells += [m.with_sigma(x, s) if s else m.value_text(x, None) for x, s in zip(shift, along, strict=True)]
    return cells


def _pair_flag(e: dict[str, object]) -> str:
    if not e["used"]:
        return m.pill("soft", t("not used"))
    return "" if e.get("controlled", True) else m.pill("warn", t("uncontrolled"))
