"""A plan as one HTML page that needs nothing but itself."""

from functools import partial

import numpy as np
from gtsam import Pose3
from markupsafe import Markup

from adjust.design import group_redundancy
from adjust.model.errors import listed
from survey.planning.navigation import NavigationOutcome
from survey.planning.summary import (
    PlanResult,
    expected_sigmas,
    factor_text,
    gained,
    meets,
    pose_sigmas,
    tolerance_values,
)
from survey.report import drawing as d
from survey.report import markup as m
from survey.report.charts import Series, bars, chart, seen_map
from survey.report.language import esc, speaking
from survey.report.picture import draw, perspective, pictures
from survey.report.scene import Scene, Spot, scene_of
from survey.solution.quantities import scale_of

_MOST_CANDIDATES = 30
_COLOURS = {"epoch": d.BLUE, "beacon": d.RED, "distance": d.GREEN, "pair": d.ORANGE, "coordinates": d.PURPLE}


def html_page(title: str, heading: str, sections: list[Markup]) -> str:
    """A page in the style of the reports."""
    head = m.element("p", heading, "meta") + m.element("h1", title)
    return m.document(title, head + m.joined(sections, "\n"))


def plan_page(o: PlanResult) -> str:
    """The page of a plan, in English whatever is spoken around it."""
    title = o.title or o.folder.resolve().name
    with speaking("en"):
        parts = [
            _summary(o), _picture(o), _seen(o), _sigmas(o), _weak(o), _selection(o), _tolerances(o), _trials(o),
            _navigation(o.navigation) if o.navigation is not None else Markup(),
        ]  # fmt: skip
        return html_page(f"{title} – plan", "Plan: expected precision before measuring", [p for p in parts if p])


def _summary(o: PlanResult) -> Markup:
    e = o.expected
    cards = [(m.count(e.n_observations), "observations"), (m.count(e.n_unknowns), "unknowns"),
             (m.count(e.redundancy), "redundancy"), (m.count(o.planned.n_planned_epochs), "planned epochs"),
             (m.count(o.planned.n_existing_blocks), "images measured already")]  # fmt: skip
    body = m.listed([*o.planned.notes, *e.warnings]) + m.part("cards", cards)
    rows = [
        (g, m.count(n), m.fixed(r, 1), m.fixed(q[0], 3), m.fixed(q[1], 3), m.fixed(q[2], 3))
        for g, (n, r, q) in group_redundancy(e).items()
    ]
    columns = ("<Group", "Observations", "Redundancy", "Smallest", "Median", "Largest number")
    said = Markup(
        "No observation has a value yet: all sigmas on this page are <b>a priori</b>, from the planned sigmas of the "
        "observations and the geometry alone. A redundancy number tells how well an observation is checked by the "
        "others: an error in one near 0 would not be noticed."
    )
    return m.section("summary", "Summary", body + m.table(columns, rows), said)


def _picture(o: PlanResult) -> Markup:
    scale = scale_of(o.expected, "a_priori")
    drawn, enlarged = pictures(scene_of(o.expected, scale), scale.ellipsoid)
    said = (
        f"95 % confidence ellipsoids of points (red) and stations (green), enlarged {m.general(enlarged, 3)} times. "
        "Cameras are drawn at the first epoch; thin lines are their axes at others."
    )
    return m.section("picture", "The survey", m.figures(drawn), said)


def _seen(o: PlanResult) -> Markup:
    blocks = o.planned.survey.image_blocks
    if not blocks:
        return Markup()
    epochs = list(dict.fromkeys(b.epoch_id for b in blocks))
    rows = list(dict.fromkeys((b.camera_id, b.target_id or "points") for b in blocks))
    rows.sort()
    counts = np.zeros((len(rows), len(epochs)))
    for b in blocks:
        counts[rows.index((b.camera_id, b.target_id or "points")), epochs.index(b.epoch_id)] += len(b.point_idx)
    title = "Points seen, by camera and target over epochs (darker: more)"
    drawn = seen_map([f"{c}: {t}" for c, t in rows], epochs, counts, title)
    return m.section("seen", "What will be seen", m.element("figure", drawn))


def _sigmas(o: PlanResult) -> Markup:
    rows = [
        (".".join(name), " \u00a0 ".join(f"{c} {m.sigma_text(sigma)} {unit}".strip() for c, sigma, unit in sigmas))
        for name, sigmas in expected_sigmas(o) if len(name) < 3
    ]  # fmt: skip
    said = "One standard deviation, all others unknown too; poses in the tangent, in the frame on the right."
    return m.section("sigmas", "Expected sigmas", m.table(("<Unknown", "<Sigmas"), rows), said)


def _weak(o: PlanResult) -> Markup:
    rows = [
        (m.fixed(w.factor, 0), m.part("lines", [f"{s:+.2f}  {a}: {c}" for a, c, s in w.parts])) for w in o.weak
    ]  # fmt: skip
    said = (
        "Combinations of unknowns that the observations hardly tell apart. Factor: how many times less precise the "
        "combination is than its parts would be if the rest were known; shares in sigmas of each."
    )
    return m.section("weak", "Weak directions", m.table(("Factor", "<What moves together"), rows) if rows else "", said)


def _selection(o: PlanResult) -> Markup:
    s = o.selection
    if s is None:
        return Markup()
    shown = s.first[:_MOST_CANDIDATES]
    names = [f"{g.kind} {g.name}" for g in shown]
    label = "gain in ln det" if s.criterion == "D" else "decrease of the mean variance"
    drawn = bars(names, np.array([g.value(s.criterion) for g in shown]), f"Every candidate alone: {label}",
                 [_COLOURS.get(g.kind, d.GREY) for g in shown])  # fmt: skip
    steps = [
        (str(i + 1), g.kind, g.name, m.fixed(g.ln_det, 3), m.fixed(g.ln_det_all, 3),
         m.fixed(100 * g.mean_variance, 2) + " %")
        for i, g in enumerate(s.steps)
    ]  # fmt: skip
    columns = ("", "<Kind", "<Measure next", "Gain ln det", "Of all unknowns", "Mean variance falls by")
    body = m.figures([drawn]) + m.table(columns, steps)
    rows = [
        (g.component.text, *(m.sigma_text(g.factor * sigma) for sigma in (g.before, g.after)), g.unit,
         m.fixed(100 * (1 - g.share), 1) + " %" if g.before > 0 else "")
        for g in gained(s)
    ]  # fmt: skip
    wanted = m.table(("<Component", "Before", "After all", "<Unit", "Smaller by"), rows)
    body += m.part("details", "Sigmas of everything wanted, before and after", wanted, False)
    said = (
        f"{len(s.first)} candidates; {s.criterion}-optimal choice of {len(s.steps)}, one after the other, each beside "
        "those taken. ln det: of the covariance of what is wanted; the mean variance counts every component in units "
        "of its variance now."
    )
    return m.section("next", "What to add next", body, said)


def _tolerances(o: PlanResult) -> Markup:
    if o.budget is None:
        return Markup()
    rows, share = [], o.budget.variances / o.budget.variances.sum(axis=0)
    for x, shares in zip(o.requirements, share.T, strict=True):
        word = m.pill("good", "met") if x.met else m.pill("bad", "not met")
        sigmas = m.sigma_text(x.factor * x.required), m.sigma_text(x.factor * x.planned)
        rows.append((x.component.text, *sigmas, x.unit, word, *(m.fixed(100 * v, 0) + " %" for v in shares)))
    body = m.table(("<Component", "Required", "Planned", "<Unit", "<", *map(esc, o.budget.groups)), rows)
    three = partial(m.general, digits=3)
    lines = [(t.group, factor_text(t.alone, three), factor_text(t.together, three), t.limiting) for t in o.tolerances]
    body += m.table(
        ("<Group", "Alone", "Together", "<Limited by"), lines, "Sigmas may be so many times the planned ones"
    )
    said = (
        "The variance of each component by group of observations, weights as planned. Alone: this group is changed, "
        "the others stay; together: every group takes an equal share of what is allowed."
    )
    return m.section("tolerances", "Required precision and tolerances", body, said)


def _trials(o: PlanResult) -> Markup:
    t = o.trials
    if t is None:
        return Markup()
    word = m.pill("good", "agrees") if t.passed else m.pill("bad", "does not agree")
    facts = m.definition([
        ("Surveys simulated and adjusted", f"{m.count(len(t.errors))}, {len(t.failed)} failed"),
        ("Scatter and predicted covariance", word),
        ("Mean of d' inv(C) d", f"{m.fixed(t.mean_square, 2)}, expected {t.dof} "
                                f"({m.fixed(t.band[0], 2)} to {m.fixed(t.band[1], 2)} at 99 %)"),
    ])  # fmt: skip
    k = len(t.ratios)
    x = np.arange(1.0, k + 1)
    se = 1.0 / np.sqrt(2.0 * len(t.errors))
    lines = [Series("expected", np.array([0.0, k]), np.ones(2), d.GREY, line=True),
             Series("RMS error / predicted sigma", x, t.ratios, d.BLUE),
             Series("± 2 standard errors", np.array([0.0, k]), np.ones(2) + 2 * se, d.GREY, line=True, dashed=True),
             Series("", np.array([0.0, k]), np.ones(2) - 2 * se, d.GREY, line=True, dashed=True)]  # fmt: skip
    drawn = chart(lines, "Scatter over prediction", "component", "ratio", 620, 260, None)
    return m.section("trials", "Monte Carlo", facts + m.element("figure", drawn))


def _navigation(n: NavigationOutcome) -> Markup:
    turn, shift = pose_sigmas(n)
    x = np.arange(1.0, len(turn) + 1)
    limits = np.degrees(n.plan.required_rotation), 1e3 * n.plan.required_translation
    drawn = []
    for what, values, limit, unit in (("rotation", turn, limits[0], "deg"), ("translation", shift, limits[1], "mm")):
        good = np.isfinite(values)
        if not good.any():
            continue
        lines = [Series("required", np.array([0.0, len(x)]), np.full(2, limit), d.RED, line=True, dashed=True),
                 Series(f"largest sigma of {what}", x[good], values[good], d.BLUE)]  # fmt: skip
        drawn.append(chart(lines, f"Expected {what} of every pose", "pose", unit))
    drawn += [_room(n)] if n.placement is None else []
    body = m.part("figures", drawn, "figures")
    good = meets(n)
    open_poses = [i + 1 for i, e in enumerate(n.precision) if e.undetermined]
    facts = [("Poses as precise as required", f"{int(good.sum())} of {len(good)}")]
    if open_poses:
        facts.append(("Not determined", listed([*map(str, open_poses)], 20)))
    body = m.definition(facts) + body
    if n.placement is not None:
        body += _placement(n)
    if n.tolerances:
        rows = []
        for t in n.tolerances:
            unit, *sigmas = tolerance_values(t)
            rows.append((t.source, *("never" if np.isnan(v) else m.general(v, 3) for v in sigmas), unit))
        caption = "Sigma per component that each source may have for every determined pose to be as required"
        body += m.table(("<Source", "Alone", "Beside the planned", "Equal shares", "<Unit"), rows, caption)
        body += m.note(
            f"With equal shares simulated and solved anew: RMS errors are {n.simulated.min():.3f} to "
            f"{n.simulated.max():.3f} of their predictions."
        )
    said = (
        f"Station {n.station_id} with its calibration as planned, {len(n.beacons.beacon_ids)} beacons; required: "
        f"{limits[0]:.3g} deg and {limits[1]:.3g} mm per component."
    )
    return m.section("navigation", "Navigation", body, said)


def _room(n: NavigationOutcome) -> Markup:
    scene = Scene()
    beacons = np.asarray(n.beacons.x_in_world)
    for name, x in zip(n.beacons.beacon_ids, beacons, strict=True):
        scene.spots.append(Spot(name, "point", x, np.zeros((3, 3))))
    for pose in n.plan.poses:
        scene.moves.append(np.asarray(Pose3(pose).translation()))
    if len(n.plan.places):
        scene.clouds.append(("", n.plan.places))
    everything = scene.positions()
    return draw(scene, perspective(everything), everything, 1.0, 1.0)


def _placement(n: NavigationOutcome) -> Markup:
    p = n.placement
    if p is None:
        return Markup()
    measure = p.measure
    x = np.arange(1.0, len(measure) + 1)
    good = measure < 1e4
    lines = []
    if good.any():
        lines.append(Series("greedy", x[good], np.sqrt(measure[good]), d.BLUE, line=True))
        lines.append(Series("after exchanges", x[-1:], np.sqrt([p.final]), d.RED))
    what = "worst pose" if n.plan.criterion == "worst" else "mean pose"
    title = f"{what.capitalize()} over beacons placed"
    drawn = chart(lines, title, "beacons", "sigma / required") if lines else Markup()
    rows = [
        (name, *(m.fixed(1e3 * v, 0) for v in place), str(sum(name in e.beacon_ids for e in n.precision)))
        for name, place in zip(n.placed_ids, n.places, strict=True)
    ]
    body = m.element("h3", "Where to put beacons") + m.figures((_room(n), drawn))
    said = (
        f"{len(n.places)} of {len(n.plan.places)} places on the walls (small dots), chosen one by one "
        f"for the {what}, {p.exchanged} then exchanged; red: beacons, green: where the head will be. Every pose sees "
        f"at least {min(p.seen)} beacons."
    )
    return body + m.note(said) + m.table(("<Beacon", "x mm", "y mm", "z mm", "Poses that see it"), rows)
