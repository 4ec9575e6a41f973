"""Section on the published methods beside the joint adjustment, where they were asked for."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from markupsafe import Markup

from survey.report import markup as m
from survey.report.context import Context
from survey.report.language import t

_MOST_PAIRS = 150


def published(c: Context) -> Markup:
    """Every number both ways, with both sigmas."""
    found = c.solution.get("published")
    if found is None:
        return Markup()
    body = m.joined(make(found[part]) for part, make in (("head", _head), ("pairs", _pairs)) if part in found)
    said = [n for part in ("head", "pairs") for n in found.get(part, {}).get("notes", ())]
    said += [f"{t(_TITLES[name])}: {t('not run')}: {why}" for name, why in found["not_run"].items()]
    note = t(
        "The published step-by-step methods on the same observations. Claimed: the sigma as its step states it, with "
        "all steps before taken as free of error. Published: the sigma that the observations cause, through all "
        "steps. Difference: published minus joint, rotations as small turns about the axes on the right."
    )
    return m.section("published", "Published methods", body + m.listed(said), note)


_TITLES = {"head": "Calibration of the head, step by step", "pairs": "Iteration of measured pairs over their loops"}


def _head(found: Mapping[str, Any]) -> Markup:
    columns = ["<Pose", "<", "Published", "Claimed σ", "Published σ", "Joint", "Joint σ", "Difference", "σ ratio"]
    rows = []
    for pose, component, unit, entry in head_rows(found):
        small = "arcsec" if unit == "deg" else "mm"
        per, mark = (3600.0, "″") if unit == "deg" else (1.0, "")
        sigma, joint = entry[f"published_sigma_{small}"], entry[f"joint_sigma_{small}"]
        rows.append([
            pose, f"{component} [{'°' if unit == 'deg' else 'mm'}]",
            m.value_text(entry[f"published_{unit}"], sigma / per), m.sigma_text(entry[f"claimed_sigma_{small}"]) + mark,
            m.sigma_text(sigma) + mark, m.value_text(entry[f"joint_{unit}"], joint / per if joint else None),
            m.sigma_text(joint) + mark, m.general(entry[f"difference_{small}"], 3) + mark,
            m.fixed(entry["sigma_ratio"], 1),
        ])  # fmt: skip
    return m.element("h3", t(_TITLES["head"])) + m.table(columns, rows)


def _pairs(found: Mapping[str, Any]) -> Markup:
    columns = ["<Pair", "<", "Published", "Published σ", "Equal weights σ", "Joint", "Joint σ", "Difference"]
    rows = []
    for pair_id in worst_pairs(found)[:_MOST_PAIRS]:
        entry = found["pairs"][pair_id]
        for i, axis in enumerate("xyz"):
            sigma = entry["weighted"]["sigma_rotation_arcsec"][i]
            joint, joint_sigma = (
                (entry["joint"][k] or [None] * 3)[i] for k in ("rotation_euler_xyz_deg", "sigma_rotation_arcsec")
            )
            rows.append([
                pair_id if i == 0 else "", f"{axis} [°]",
                m.value_text(entry["weighted"]["rotation_euler_xyz_deg"][i], sigma / 3600.0), m.sigma_text(sigma) + "″",
                m.sigma_text(entry["equal_weights"]["sigma_rotation_arcsec"][i]) + "″",
                m.value_text(joint, joint_sigma / 3600.0 if joint_sigma else None), m.sigma_text(joint_sigma) + "″",
                m.general(entry["weighted"].get("difference_arcsec", [None] * 3)[i], 3) + "″",
            ])  # fmt: skip
    said = m.joined(
        m.element("p", _steps(t(text), found["steps"][name]))
        for name, text in (("weighted", "Weighted"), ("equal_weights", "Equal weights"))
    )
    more = m.more(len(found["pairs"]) - _MOST_PAIRS)
    return m.element("h3", t(_TITLES["pairs"])) + said + m.table(columns, rows) + (m.note(more) if more else more)


def _steps(name: Markup, steps: Mapping[str, Any]) -> Markup:
    left = m.general(steps["misclosure_left_arcsec"], 2)
    return t("{name}: {n} iterations, misclosure left {left}″", name=name, n=m.count(steps["iterations"]), left=left)


def head_rows(found: Mapping[str, Any]) -> list[tuple[str, str, str, Mapping[str, Any]]]:
    """Of ``head``: pose, component, unit of value ("deg", "mm") and the entry, one for each number."""
    words = {"world_from_table": "table", "mount_from_camera": "camera"}
    rows = []
    for pose, entries in found["poses"].items():
        kind, owner = pose.split("/", 1)
        rows += [(f"{words[kind]} {owner}", x, "deg" if x[0] == "r" else "mm", e) for x, e in entries.items()]
    return rows


def worst_pairs(found: Mapping[str, Any]) -> list[str]:
    """Of ``pairs``: the ids, those first whose published rotations are farthest from the joint ones."""

    def off(pair_id: str) -> float:
        return float(np.linalg.norm(found["pairs"][pair_id]["weighted"].get("difference_arcsec", 0.0)))

    return sorted(found["pairs"], key=lambda p: (-off(p), p))
