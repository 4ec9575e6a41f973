"""The solution of a survey as one dictionary of plain values: what ``solution.json`` holds and reports print."""

from collections.abc import Mapping, Sequence
from dataclasses import field
from typing import Any

import numpy as np

from adjust.epochs.states import datum_carriers, open_directions
from adjust.model.frozen import frozen
from adjust.model.result import Adjustment, GroupSummary
from adjust.precision.precision import in_conditions
from adjust.statistics.result import Consistency
from survey.folder.plain import attributes, plain
from survey.project.detected import DetectedImage
from survey.project.observed import IMAGES, Hits, Observed, name_of_residual
from survey.project.project import LeftOut
from survey.solution import quantities as q
from survey.solution.instruments import instrument_entries
from survey.solution.statistics import Statistics
from survey.solution.statistics_dict import statistics_dict
from survey.solution.unknowns import unknown_entries
from survey.solution.verdict import fit_of, suspects, verdict, warnings_with

CONVENTIONS = {
    "poses": "a_from_b takes coordinates in b to coordinates in a; camera x right, y down, z forward",
    "translation_mm": "origin of b in a; sigma_translation_mm along the axes of a",
    "rotation_euler_xyz_deg": "R = Rz(z) Ry(y) Rx(x); sigma_rotation_arcsec: small rotations about the axes of b",
    "residuals": "adjusted (predicted) minus observed",
    "image": "the centre of the first pixel is (0, 0)",
}


@frozen
class RunInfo:
    """What was run: everything in a result file that the adjustment itself does not know.

    date: time stamp, ISO 8601. seconds: duration per step; printed, but in no file, so that equal input gives equal
    files. sigmas: how sigmas of unknowns are given. identification: what the project says of itself (who, where, with
    what), in its order. command: as it can be given again. images: by camera/epoch, with their hashes. left_out,
    n_left_out, n_unused_in_files: as of :class:`survey.project.Project`.
    """

    folder: str
    title: str
    input_hashes: Mapping[str, str] = field(default_factory=dict)
    options: Mapping[str, Any] = field(default_factory=dict)
    versions: Mapping[str, str] = field(default_factory=dict)
    date: str = ""
    seconds: Mapping[str, float] = field(default_factory=dict)
    sigmas: q.SigmaKind = "a_posteriori"
    identification: tuple[tuple[str, str], ...] = ()
    command: str = ""
    images: Mapping[str, DetectedImage] = field(default_factory=dict)
    left_out: tuple[LeftOut, ...] = ()
    n_left_out: int = 0
    n_unused_in_files: int = 0


def solution_dict(adjustment: Adjustment, run: RunInfo, found: Statistics | None = None) -> dict[str, Any]:
    """The whole solution as plain values, floats in full, None where there is no number; ``found``: its statistics."""
    if found is not None:
        return with_statistics(solution_dict(adjustment, run), adjustment, run, found)
    scale = q.scale_of(adjustment, run.sigmas)
    solution: dict[str, Any] = plain(
        {
            "format": 1,
            "summary": summary_dict(adjustment, run.title, scale),
            "conventions": CONVENTIONS,
            **unknown_entries(adjustment, scale),
            "pairs": _pairs(adjustment, scale),
            **instrument_entries(adjustment, scale),
            **_network(adjustment),
            **_free_datum(adjustment),
            "groups": {g.group: _group(g) for g in adjustment.groups},
            **_left_out(adjustment, run),
            "warnings": list(adjustment.warnings),
            **({"diagnosis": adjustment.diagnosis.told()} if adjustment.diagnosis is not None else {}),
            "inputs": {
                "folder": run.folder,
                "identification": dict(run.identification),
                "command": run.command,
                "hashes": dict(run.input_hashes),
                "images": {
                    name: attributes(i, "file", "sha256") | {"points": i.status}
                    | attributes(i, "n_image_points", "n_spots")
                    for name, i in run.images.items()
                },
                "options": dict(run.options),
                "versions": dict(run.versions),
                "date": run.date,
            },
        }
    )
    return solution


def with_statistics(
    solution: dict[str, Any], adjustment: Adjustment, run: RunInfo, found: Statistics
) -> dict[str, Any]:
    """The solution of :func:`solution_dict`, with its statistics before what went in, and judged by them."""
    scale, tested = q.scale_of(adjustment, run.sigmas), found.consistency
    n_unmet = sum(not v.met for v in found.verdicts)
    told: dict[str, Any] = plain({
        "summary": summary_dict(adjustment, run.title, scale, tested, n_unmet),
        "warnings": warnings_with(adjustment, tested),
        **statistics_dict(adjustment, found, scale),
    })  # fmt: skip
    out, names = solution | told, list(solution)
    return out | {name: out.pop(name) for name in names[names.index("inputs") :]}


def _free_datum(adjustment: Adjustment) -> dict[str, Any]:
    """Motions of the whole (t, rotation vector, ln scale) that the observations leave open, and what carries them."""
    directions = open_directions(adjustment)
    if not directions.shape[1]:
        return {}
    carriers = ["/".join(name) for name in datum_carriers(adjustment)]
    return {"free_datum": {"open_motions": directions.T.tolist(), "carried_by": carriers}}


def summary_dict(
    adjustment: Adjustment, title: str, scale: q.Scale, tested: Consistency | None = None, n_unmet: int = 0
) -> dict[str, Any]:
    """How an adjustment went and what is to be thought of it; ``tested``, ``n_unmet`` as :func:`verdict` has them."""
    found, test = suspects(adjustment), adjustment.global_test
    level, reason = verdict(adjustment, found, n_unmet, tested)
    return {
        "title": title,
        "verdict": level,
        "reason": reason,
        "fit": fit_of(adjustment, tested),
        "sigma0": adjustment.sigma0 if adjustment.redundancy > 0 else None,
        **attributes(adjustment, "redundancy", "n_observations", "n_unknowns"),
        "datum": adjustment.survey.datum.kind,
        "datum_defect": adjustment.datum_defect,
        "n_tolerances_not_met": n_unmet,
        **attributes(adjustment, "converged", "iterations"),
        "last_step_sigmas": adjustment.max_step,
        "sigmas": scale.sigmas,
        "sigma_factor": scale.factor,
        "omega": adjustment.omega,
        "global_test": test
        and attributes(test, "omega", "redundancy", "alpha", "lower", "upper", "passed", "status"),
        "suspects": {
            "alpha": found.alpha,
            "image_test_limit": found.image_limit,
            "standardized_limit": found.w_limit,
            "n_image_points": found.n_image,
            **attributes(found, "n_other", "n_not_used"),
        },
    }


def _group(group: GroupSummary) -> dict[str, Any]:
    """``deviation``: of omega from its expectation r, in units of its own sigma sqrt(2 r), as chi-square has it."""
    factor, r = group.factor, group.redundancy
    return {
        **attributes(group, "n_observations", "redundancy", "omega"),
        "variance_factor": factor,
        "sigma_scale": float(np.sqrt(factor)) if factor >= 0.0 else float("nan"),
        "deviation": (group.omega - r) / float(np.sqrt(2.0 * r)) if factor >= 0.0 else float("nan"),
    }


def _pairs(adjustment: Adjustment, scale: q.Scale) -> Mapping[str, Any]:
    if not adjustment.survey.pairs:
        return {}
    from survey.solution.network.pairs import pairs_dict  # here: as above

    return pairs_dict(adjustment, scale)


def _network(adjustment: Adjustment) -> dict[str, Any]:
    """What the pairs can tell, and how well their loops close; nothing where there are no pairs."""
    survey = adjustment.survey
    if not survey.pairs:
        return {}
    # here: a survey without pairs is reported without it
    from survey.solution.network.counts import network_dict, pair_network
    from survey.solution.network.loops import closures_dict, loops_after, loops_dict, pair_loops

    loops = pair_loops(survey)
    if loops is None:
        return {}
    left_out = [p.pair_id for p in survey.pairs if not p.used]
    how = "conditions" if in_conditions(adjustment) else "poses"
    listed = loops_dict(loops, left_out, loops_after(adjustment, loops), survey.pair_form, how)
    closures = {"closures": closures_dict(adjustment)} if survey.closures else {}
    return {"network": network_dict(pair_network(survey)), "loops": listed, **closures}


def _left_out(adjustment: Adjustment, run: RunInfo) -> dict[str, Any]:
    """``exclusions`` row by row, and ``left_out``: three counts of observations that never overlap.

    by_people: excluded by ``exclusions.csv``. in_files: only marked ``used = false`` in a table. in_this_run: in use
    until this adjustment left them out. An image point and a reading count one each.
    """
    return {
        "exclusions": _exclusions(adjustment, run.left_out),
        "left_out": {"by_people": run.n_left_out, "in_files": run.n_unused_in_files,
                     "in_this_run": adjustment.n_screened},
    }  # fmt: skip


def _exclusions(adjustment: Adjustment, left_out: Sequence[LeftOut]) -> list[dict[str, Any]]:
    if not left_out:
        return []
    observed = Observed(adjustment.survey, ())
    others = {name_of_residual(o): o for o in adjustment.other_residuals}
    return [_exclusion(adjustment, one, observed.hits(one.exclusion.name, one.exclusion.at), observed, others)
            for one in left_out]  # fmt: skip


def _exclusion(
    adjustment: Adjustment, one: LeftOut, hit: Hits, observed: Observed, others: Mapping[str, Any]
) -> dict[str, Any]:
    said, ptr, images = one.exclusion, adjustment.image_residuals.block_ptr, adjustment.image_residuals
    sizes = [np.abs(images.standardized[ptr[i] : ptr[i + 1]][mask]).ravel() for i, mask in hit.of(IMAGES).items()]
    sizes += [np.abs(others[name].standardized).ravel() for name in observed.names(hit) if name in others]
    known = np.concatenate([*sizes, np.zeros(0)])
    known = known[np.isfinite(known)]
    largest = {"largest_standardized_residual": float(known.max()) if len(known) else None}
    return said.as_dict() | {"line": said.line} | one.counts() | largest
