"""A plan as text for the terminal."""

import numpy as np

from adjust.design import group_redundancy
from survey.planning.summary import (
    Gained,
    Met,
    PlanResult,
    expected_sigmas,
    factor_text,
    gained,
    meets,
    pose_sigmas,
    tolerance_values,
)

_MOST = 8


def plan_text(o: PlanResult) -> str:
    """For the terminal, problems first."""
    e = o.expected
    name = o.title or str(o.folder)
    lines = [f"{name}: {e.n_observations} observations, {e.n_unknowns} unknowns, redundancy {e.redundancy}"]
    lines += [f"  ! {note}" for note in (*o.planned.notes, *e.warnings)]
    lines += ["", f"  {'group':<18}{'observations':>13}{'redundancy':>12}{'smallest':>10}{'median':>8}"]
    for group, (n, r, q) in group_redundancy(e).items():
        lines.append(f"  {group:<18}{n:>13}{r:>12.1f}{q[0]:>10.3f}{q[1]:>8.3f}")
    lines += ["", *_sigma_lines(o)]
    if o.weak:
        lines += ["", "  weak directions", *(f"    {w.text()}" for w in o.weak[:3])]
    if o.network is not None:
        w = o.network
        lines += ["", f"  network: {w['n_stations']} stations, {w['measured_pairs']} of {w['measurable_pairs']} pairs, "
                      f"{w['independent_conditions']} conditions, {w['conditions_per_pair']:.2f} per pair"]  # fmt: skip
    lines += _selection_lines(o) + _tolerance_lines(o) + _trial_lines(o) + _navigation_lines(o)
    return "\n".join(lines)


def _people(sigma: float, of: Gained | Met) -> str:
    """``0.12 mm``."""
    return f"{of.factor * sigma:.3g} {of.unit}".strip()


def _sigma_lines(o: PlanResult) -> list[str]:
    out = ["  expected sigmas (a priori)"]
    lasting = [(name, sigmas) for name, sigmas in expected_sigmas(o) if len(name) < 3]
    for name, sigmas in lasting[: 4 * _MOST]:
        groups: dict[str, list[str]] = {}
        for c, sigma, unit in sigmas:
            groups.setdefault(unit, []).append(f"{c} {sigma:.3g}")
        words = "   ".join(" ".join(v) + f" {unit}".rstrip() for unit, v in groups.items())
        out.append(f"    {'.'.join(name):<28}{words}")
    if len(lasting) > 4 * _MOST:
        out.append(f"    and {len(lasting) - 4 * _MOST} more, see plan.html")
    return out


def _selection_lines(o: PlanResult) -> list[str]:
    s = o.selection
    if s is None:
        return []
    out = ["", f"  what to add next ({s.criterion}-optimal), each beside those above it"]
    out += [f"    {'gain in':<34}{'ln det':>9}{'of all':>9}{'variance':>10}"]
    for g in s.steps:
        less = f"-{100 * g.mean_variance:.1f} %"
        out.append(f"    {g.kind + ' ' + g.name:<34}{g.ln_det:>9.3f}{g.ln_det_all:>9.3f}{less:>10}")
    out += [f"    {g.component.text:<34}{_people(g.before, g)} -> {_people(g.after, g)}"
            for g in sorted(gained(s), key=lambda g: g.share)[:_MOST]]  # fmt: skip
    return out


def _tolerance_lines(o: PlanResult) -> list[str]:
    if o.budget is None:
        return []
    out = ["", "  required precision"]
    for x in o.requirements:
        required, planned = _people(x.required, x), _people(x.planned, x)
        word = "met" if x.met else "NOT MET"
        out.append(f"    {x.component.text:<34}{required:>14} required{planned:>14} planned   {word}")
    out.append(f"    {'sigmas may be, times the planned':<34}{'alone':>9}{'together':>10}   limited by")
    for t in o.tolerances:
        out.append(f"    {t.group:<34}{factor_text(t.alone):>9}{factor_text(t.together):>10}   {t.limiting}")
    return out


def _trial_lines(o: PlanResult) -> list[str]:
    t = o.trials
    if t is None:
        return []
    word = "agrees" if t.passed else "DOES NOT AGREE"
    return [
        "",
        f"  Monte Carlo: {len(t.errors)} simulated surveys adjusted, {len(t.failed)} failed; scatter {word} with the "
        "predicted covariance",
        f"    mean of d' inv(C) d {t.mean_square:.2f}, expected {t.dof} ({t.band[0]:.2f} to {t.band[1]:.2f} at 99 %)",
        f"    RMS error over sigma: {t.ratios.min():.3f} to {t.ratios.max():.3f}, median {np.median(t.ratios):.3f}",
    ]


def _navigation_lines(o: PlanResult) -> list[str]:
    n = o.navigation
    if n is None:
        return []
    turn, shift = pose_sigmas(n)
    good = np.isfinite(turn) & np.isfinite(shift)
    head = f"  navigation of {n.station_id} from {len(n.beacons.beacon_ids)} beacons: {int(good.sum())} of {len(turn)}"
    out = ["", f"{head} poses determined, {int(meets(n).sum())} as precise as required"]
    if good.any():
        out.append(
            f"    largest sigma of a pose: median {np.median(turn[good]):.3f} deg {np.median(shift[good]):.2f} mm, "
            f"worst {turn[good].max():.3f} deg {shift[good].max():.2f} mm"
        )
    if n.placement is not None:
        beside = len(n.beacons.beacon_ids) - len(n.places)
        what = f"{n.plan.criterion} pose, in required variances; {n.placement.exchanged} exchanged"
        out.append(f"    placed{f' beside the {beside} that are there' if beside else ''} ({what})")
        for name, x in zip(n.placed_ids, 1e3 * n.places, strict=True):
            out.append(f"      {name:<5}{x[0]:>9.1f}{x[1]:>9.1f}{x[2]:>9.1f} mm")
        out.append(f"      measure at the end {n.placement.final:.3g}")
    if n.tolerances:
        out.append(f"    {'tolerances':<22}{'alone':>10}{'beside':>10}{'shared':>10}")
        for t in n.tolerances:
            unit, *values = tolerance_values(t)
            cells = "".join(f"{'never' if np.isnan(v) else f'{v:.3g}':>10}" for v in values)
            out.append(f"    {t.source:<22}{cells} {unit}")
        low, high = n.simulated.min(), n.simulated.max()
        out.append(f"    simulated with the shared tolerances: RMS error {low:.3f} to {high:.3f} of its prediction")
    return out
