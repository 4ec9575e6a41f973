"""What became of a solution: every parameter before and after, in its own sigmas, and the verdict."""

from collections.abc import Mapping
from dataclasses import field
from typing import Any

import numpy as np
from gtsam import Pose3

from adjust.model.frozen import frozen
from adjust.model.result import Estimate, ParameterName
from adjust.model.survey import FloatArray
from survey.folder.plain import plain
from survey.solution.quantities import sigma_unit_for_people, sigmas_in, unit_for_people


@frozen(eq=False)
class Snapshot:
    """A solution as it can be kept and compared. summary: sigma0, redundancy, verdict and so on, as plain values."""

    estimates: Mapping[ParameterName, Estimate]
    summary: Mapping[str, Any]


@frozen
class Change:
    """One component of a parameter before and after, in the ``unit`` that people read (rotations about own axes).

    sigmas: the difference in sigmas of before, nan where the component had none. ratio: its sigma after over before.
    """

    name: str
    unit: str
    before: float | None
    after: float | None
    difference: float
    sigmas: float
    ratio: float


@frozen
class Changes:
    """All components, the one that moved by most sigmas first; ``new`` and ``gone``: parameters in one only."""

    components: tuple[Change, ...]
    new: tuple[str, ...]
    gone: tuple[str, ...]
    before: Mapping[str, Any] = field(default_factory=dict)
    after: Mapping[str, Any] = field(default_factory=dict)

    @property
    def largest(self) -> tuple[Change, ...]:
        """Those that moved, by most sigmas first."""
        return tuple(c for c in self.components if c.sigmas > 0.0)

    def as_dict(self, most: int | None = None) -> dict[str, Any]:
        """As plain values; ``most``: of this many components, None for all."""
        rows = [vars(c) for c in self.components[:most]]
        return dict(plain({"before": self.before, "after": self.after, "new": self.new, "gone": self.gone,
                           "n_components": len(self.components), "components": rows}))  # fmt: skip

    def text(self, most: int = 20) -> str:
        """For people."""
        a, b = self.before, self.after
        lines = [f"verdict {a['verdict']} -> {b['verdict']}   sigma0 {_number(a['sigma0'])} -> {_number(b['sigma0'])}"
                 f"   redundancy {a['redundancy']} -> {b['redundancy']}"]  # fmt: skip
        lines += [f"  {c.name:<44} {c.difference:+.4g} {c.unit}  {c.sigmas:.2f} sigma  sigma x {c.ratio:.3f}"
                  for c in self.largest[:most]]  # fmt: skip
        lines += [f"  only before: {', '.join(self.gone)}"] if self.gone else []
        lines += [f"  only after: {', '.join(self.new)}"] if self.new else []
        return "\n".join(lines)


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.4f}"


_SHORT = ("verdict", "reason", "sigma0", "redundancy", "n_observations", "n_unknowns", "omega", "iterations")


def in_short(summary: Mapping[str, Any]) -> dict[str, Any]:
    """Of the ``summary`` in ``solution.json`` what runs and the workbench show. Raises KeyError."""
    test, suspect = summary["global_test"], summary["suspects"]
    return {
        **{key: summary[key] for key in _SHORT}, "global_test": test and test["status"],
        "n_suspects": suspect["n_image_points"] + suspect["n_other"], "n_not_used": suspect["n_not_used"],
    }  # fmt: skip


def solution_changes(before: Snapshot, after: Snapshot) -> Changes:
    """From one solution to another; parameters of another model or size count as new and gone."""
    a, b = before.estimates, after.estimates
    both = [n for n in a if n in b and a[n].components == b[n].components and _kind(a[n]) == _kind(b[n])]
    found = [c for n in both for c in _components(a[n], b[n])]
    found.sort(key=lambda c: -(c.sigmas if np.isfinite(c.sigmas) else -1.0))
    known = set(both)
    new, gone = (tuple("/".join(n) for n in x if n not in known) for x in (b, a))
    return Changes(tuple(found), new, gone, before.summary, after.summary)


def _kind(e: Estimate) -> bool:
    return isinstance(e.value, Pose3)


def _components(a: Estimate, b: Estimate) -> list[Change]:
    sigma_a, sigma_b = sigmas_in(a.cov), sigmas_in(b.cov)
    d = _difference(a, b)
    with np.errstate(divide="ignore", invalid="ignore"):
        sigmas = np.where(sigma_a > 0.0, np.abs(d) / sigma_a, np.where(d == 0.0, 0.0, np.nan))
        ratio = np.where(sigma_a > 0.0, sigma_b / sigma_a, np.nan)
    old, new = _shown(a), _shown(b)
    out = []
    for i, component in enumerate(a.components):
        unit, factor = sigma_unit_for_people(a.units[i], component)
        name = "/".join((*a.name, component))
        out.append(Change(name, unit, old[i], new[i], float(d[i] * factor), float(sigmas[i]), float(ratio[i])))
    return out


def _difference(a: Estimate, b: Estimate) -> FloatArray:
    """After minus before, of a pose in the tangent of before."""
    if isinstance(a.value, Pose3) and isinstance(b.value, Pose3):
        return np.asarray(Pose3.Logmap(a.value.between(b.value)))
    old, new = np.asarray(a.value, dtype=float), np.asarray(b.value, dtype=float)
    return np.asarray(new - old)


def _shown(e: Estimate) -> list[float | None]:
    """Values for people; of a pose the origin, its rotation has none."""
    if isinstance(e.value, Pose3):
        return [None, None, None, *(1e3 * np.asarray(e.value.translation())).tolist()]
    pairs = zip(e.components, e.units, np.asarray(e.value, dtype=float).tolist(), strict=True)
    return [value * unit_for_people(component, unit)[1] for component, unit, value in pairs]
