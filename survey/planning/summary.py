"""All that is known of a plan, as plain values."""

from collections.abc import Callable, Iterator
from dataclasses import field
from pathlib import Path
from typing import Any

import numpy as np

from adjust.design import (
    Budget,
    Component,
    Selection,
    Tolerance,
    Trials,
    WeakDirection,
    group_redundancy,
)
from adjust.design.pose_budget import PoseTolerance
from adjust.model.frozen import frozen
from adjust.model.result import Adjustment, ParameterName
from adjust.model.survey import FloatArray
from adjust.precision.precision import precision_of
from survey.folder.plain import attributes, plain
from survey.planning.building import Planned
from survey.planning.navigation import NavigationOutcome
from survey.planning.plan_file import Plan
from survey.solution.quantities import key_of, sigma_unit_for_people


@frozen
class Met:
    """A component with the sigma that is required of it and the one that is planned (SI), and what people read."""

    component: Component
    required: float
    planned: float
    unit: str
    factor: float

    @property
    def met(self) -> bool:
        """Whether it is as precise as required."""
        return self.planned <= self.required * (1 + 1e-9)


@frozen
class Gained:
    """A component with its sigma before and after what is to be added (SI), and what people read."""

    component: Component
    before: float
    after: float
    unit: str
    factor: float

    @property
    def share(self) -> float:
        """What stays of the sigma; all of one that is zero."""
        return self.after / self.before if self.before > 0.0 else 1.0


@frozen(eq=False)
class PlanResult:
    """All that is known of a plan."""

    folder: Path
    title: str
    plan: Plan
    planned: Planned
    expected: Adjustment
    weak: tuple[WeakDirection, ...]
    wanted: tuple[Component, ...]
    selection: Selection | None
    required: dict[Component, float]
    budget: Budget | None
    tolerances: tuple[Tolerance, ...]
    trials: Trials | None
    network: dict[str, object] | None
    navigation: NavigationOutcome | None
    seconds: dict[str, float] = field(default_factory=dict)
    paths: dict[str, Path] = field(default_factory=dict)

    @property
    def requirements(self) -> tuple[Met, ...]:
        """What is required, beside what is planned."""
        planned = () if self.budget is None else self.budget.sigmas.tolist()
        return tuple(Met(c, r, s, *sigma_unit_for_people(c.unit))
                     for (c, r), s in zip(self.required.items(), planned, strict=self.budget is not None))  # fmt: skip


def gained(s: Selection) -> list[Gained]:
    """What a selection does for everything that is wanted."""
    return [Gained(c, a, b, *sigma_unit_for_people(c.unit))
            for c, a, b in zip(s.wanted, s.sigmas.tolist(), s.after.tolist(), strict=True)]  # fmt: skip


def factor_text(value: float, shown: Callable[[float], str] = "{:.3g}".format) -> str:
    """How many times the planned sigmas may be, for people."""
    return "never" if np.isnan(value) else "any" if value > 1e6 else shown(value)


def expected_sigmas(o: PlanResult) -> Iterator[tuple[ParameterName, list[tuple[str, float, str]]]]:
    """Of every unknown: its components, their sigmas for people and the units of these."""
    for name, unknown in precision_of(o.expected).unknowns.by_name.items():
        estimate = o.expected.estimates[name]
        s = dict(zip(estimate.components, np.sqrt(np.maximum(np.diag(estimate.cov), 0.0)).tolist(), strict=True))
        shown = [(c, *sigma_unit_for_people(u)) for c, u in zip(unknown.components, unknown.units, strict=True)]
        yield name, [(c, factor * s[c], unit) for c, unit, factor in shown]


def plan_summary(o: PlanResult) -> dict[str, object]:
    """All figures by name, units in the keys."""
    out: dict[str, object] = {
        "folder": str(o.folder),
        "title": o.title,
        "observations": o.expected.n_observations,
        "unknowns": o.expected.n_unknowns,
        "redundancy": o.expected.redundancy,
        "datum_defect": o.expected.datum_defect,
        "existing_images": o.planned.n_existing_blocks,
        "planned_epochs": o.planned.n_planned_epochs,
        "planned_blocks": len(o.planned.survey.image_blocks) - o.planned.n_existing_blocks,
        "groups": {
            g: {"observations": n, "redundancy": r, "smallest": float(q[0]), "median": float(q[1])}
            for g, (n, r, q) in group_redundancy(o.expected).items()
        },
        "sigmas": {
            ".".join(name): {f"sigma_{key_of(c, unit)}": sigma for c, sigma, unit in sigmas}
            for name, sigmas in expected_sigmas(o)
        },
        "weak_directions": [
            {"factor": w.factor, "parts": [{"unknown": a, "component": c, "share": s} for a, c, s in w.parts]}
            for w in o.weak
        ],
        "notes": [*o.planned.notes, *o.expected.warnings],
        "seconds": o.seconds,
        "written": {name: str(path) for name, path in o.paths.items()},
    }
    if o.selection is not None:
        out["selection"] = _selection(o.selection)
    if o.budget is not None:
        out["tolerances"] = _tolerances(o)
    if o.trials is not None:
        t = o.trials
        out["monte_carlo"] = {
            "trials": len(t.errors), "failed": len(t.failed), "mean_square": t.mean_square, "dof": t.dof,
            "band_99": list(t.band), "passed": t.passed, "mean_omega": float(t.omega.mean()),
            "rms_over_sigma": [float(t.ratios.min()), float(np.median(t.ratios)), float(t.ratios.max())],
        }  # fmt: skip
    if o.network is not None:
        out["network"] = o.network
    if o.navigation is not None:
        out["navigation"] = _navigation(o.navigation)
    return out


def _selection(s: Selection) -> dict[str, object]:
    gain = ("name", "kind", "ln_det", "ln_det_all", "mean_variance")
    wanted = {g.component.text: {f"sigma_{when}_{g.unit}".rstrip("_"): g.factor * sigma
                                 for when, sigma in (("before", g.before), ("after", g.after))}
              for g in gained(s)}  # fmt: skip
    return {
        "criterion": s.criterion,
        "chosen": [attributes(g, *gain) for g in s.steps],
        "candidates": [attributes(g, *gain) for g in s.first],
        "wanted": wanted,
    }


def _tolerances(o: PlanResult) -> dict[str, object]:
    return {
        "met": all(r.met for r in o.requirements),
        "groups": {t.group: {"factor_alone": plain(t.alone), "factor_together": plain(t.together),
                             "limited_by": t.limiting} for t in o.tolerances},
        "components": {
            r.component.text: {"required": r.factor * r.required, "planned": r.factor * r.planned, "unit": r.unit}
            for r in o.requirements
        },
    }  # fmt: skip


def tolerance_values(t: PoseTolerance) -> tuple[str, float, float, float]:
    """Unit for people, then alone, beside, shared in it."""
    unit, factor = ("deg", 180.0 / np.pi) if t.unit == "rad" else sigma_unit_for_people(t.unit)
    return unit, factor * t.alone, factor * t.beside, factor * t.shared


def pose_sigmas(n: NavigationOutcome) -> tuple[FloatArray, FloatArray]:
    """Largest sigma of rotation (deg) and of translation (mm) of every pose."""
    return np.degrees(n.sigmas[:, :3].max(axis=1)), 1e3 * n.sigmas[:, 3:].max(axis=1)


def _navigation(n: NavigationOutcome) -> dict[str, object]:
    turn, shift = pose_sigmas(n)
    out: dict[str, Any] = {
        "station": n.station_id,
        "poses": len(n.precision),
        "undetermined": sum(bool(e.undetermined) for e in n.precision),
        "meet_requirement": int(np.sum(meets(n))),
        "beacons": len(n.beacons.beacon_ids),
        "sigma_rotation_deg": plain(turn),
        "sigma_translation_mm": plain(shift),
        "beacons_seen": [len(e.beacon_ids) for e in n.precision],
        "tolerances": {},
    }
    for t in n.tolerances:
        unit, alone, beside, shared = tolerance_values(t)
        key = t.source.replace(" ", "_")
        out["tolerances"][key] = {f"alone_{unit}": plain(alone), f"beside_{unit}": plain(beside),
                                  f"shared_{unit}": plain(shared)}  # fmt: skip
    if n.tolerances:
        out["simulated_over_predicted"] = plain(n.simulated)
    if n.placement is not None:
        p = n.placement
        out["placement"] = {
            "ids": list(n.placed_ids), "x_mm": (1e3 * n.places).tolist(), "measure": plain(p.measure),
            "exchanged": p.exchanged, "final": p.final, "criterion": n.plan.criterion,
        }  # fmt: skip
    return out


def meets(n: NavigationOutcome) -> FloatArray:
    """(q,) whether every component of a pose is as precise as required."""
    limit = np.array([n.plan.required_rotation] * 3 + [n.plan.required_translation] * 3)
    return np.asarray((n.sigmas <= limit).all(axis=1))
