"""The first screen of a report: verdict, warnings, key figures, global test, groups, picture, inputs."""

from typing import Any

from survey.report import drawing as d
from survey.report.context import Context
from survey.report.markup import count, definition, esc, fixed, general, pill, section, table
from survey.report.picture import pictures
from survey.report.scene import scene_of

_WORDS = {"passed": "Passed", "check": "Needs a look", "failed": "Failed"}
_MOST_WARNINGS = 25
_CLEAR = 3.0  # deviations of a group beyond this many sigmas are marked


def header(c: Context) -> str:
    """Title, verdict and, before anything else, what is wrong."""
    s = c.solution["summary"]
    version = c.run.versions.get("labsurvey", "")
    meta = " · ".join(esc(x) for x in (c.run.folder, c.run.date, f"labsurvey {version}".strip()) if x)
    found = s["suspects"]
    warnings = c.solution["warnings"]
    problems = [esc(w) for w in warnings[:_MOST_WARNINGS]]
    if len(warnings) > _MOST_WARNINGS:
        problems.append(f"{count(len(warnings) - _MOST_WARNINGS)} more warnings in solution.json.")
    if found["n_image_points"]:
        problems.append(f'<a href="#image-points">{count(found["n_image_points"])} image points</a> are suspect.')
    if found["n_other"]:
        problems.append(f'<a href="#observations">{count(found["n_other"])} other observations</a> are suspect.')
    if found["n_not_used"]:
        problems.append(f"{count(found['n_not_used'])} observations were not used.")
    items = "".join(f"<li>{p}</li>" for p in problems)
    listed = (
        f'<ul class="problems">{items}</ul>'
        if items
        else '<p class="calm">No warnings, nothing suspect, nothing left out.</p>'
    )
    return (
        f'<header><p class="meta">Adjustment report</p><h1>{esc(s["title"] or c.run.folder)}</h1>'
        f'<p class="meta">{meta}</p></header>'
        f'<div class="verdict {s["verdict"]}"><b>{_WORDS[s["verdict"]]}</b><span>{esc(s["reason"])}</span></div>'
        f"{listed}"
    )


def summary(c: Context) -> str:
    """Key figures and the global test."""
    s = c.solution["summary"]
    figures = (
        ("sigma0 (a priori 1)", fixed(s["sigma0"], 3)),
        ("observations", count(s["n_observations"])),
        ("unknowns", count(s["n_unknowns"])),
        ("redundancy", count(s["redundancy"])),
        ("iterations", f"{s['iterations']}" + ("" if s["converged"] else " (not converged)")),
        ("last step", f"{general(s['last_step_sigmas'], 2)} σ"),
        ("datum", f"{esc(s['datum'])}, defect {s['datum_defect']}"),
    )
    cards = (
        '<div class="cards">' + "".join(f"<div><b>{v}</b><span>{esc(k)}</span></div>" for k, v in figures) + "</div>"
    )
    if s["sigmas"] == "a_posteriori":
        said = f"Sigmas of unknowns here are <b>a posteriori</b>: multiplied by sigma0 = {fixed(s['sigma_factor'], 4)}."
    else:
        said = "Sigmas of unknowns here are <b>a priori</b>: they follow from the sigmas of the observations alone."
    said += (
        " Sigmas of observations, standardized residuals and tests are a priori. Residuals are adjusted minus observed."
    )
    return section("summary", "Summary", cards + _global_test(s["global_test"]) + f'<p class="note">{said}</p>')


def _global_test(test: dict[str, Any] | None) -> str:
    if test is None:
        return '<p class="note">No global test: there is no redundancy.</p>'
    width, height, left = 700.0, 58.0, 20.0
    r = test["redundancy"]
    # the scale is the variance factor omega / r; its interval and the value always fit
    marks = {k: test[k] / r for k in ("lower", "upper", "omega")}
    low, high = min(*marks.values(), 1.0), max(*marks.values(), 1.0)
    span = max(high - low, 1e-6)
    x = {
        k: left + (v - low + 0.1 * span) / (1.2 * span) * (width - 2 * left) for k, v in (marks | {"one": 1.0}).items()
    }
    colour = d.GREEN if test["passed"] else d.RED
    parts = [
        d.line(left, 28, width - left, 28, d.FAINT, 2),
        d.rect(x["lower"], 22, x["upper"] - x["lower"], 12, d.GREEN, ' fill-opacity="0.22" rx="2"'),
        d.line(x["one"], 20, x["one"], 36, d.GREY),
        d.dot(x["omega"], 28, 5.5, colour),
        d.text(x["omega"], 14, f"omega / r = {marks['omega']:.4g}", "middle", 11.5, colour),
    ]
    if x["upper"] - x["lower"] > 110:
        parts += [d.text(x[k], 50, f"{marks[k]:.4g}", "middle") for k in ("lower", "upper")]
    else:
        parts.append(
            d.text(0.5 * (x["lower"] + x["upper"]), 50, f"{marks['lower']:.4g} to {marks['upper']:.4g}", "middle")
        )
    word = pill("good", "passed") if test["passed"] else pill("bad", "failed")
    sentence = (
        f"Global test {word} omega = {general(test['omega'], 6)}, redundancy {count(r)}, accepted between "
        f"{general(test['lower'], 6)} and {general(test['upper'], 6)} at {100 * (1 - test['alpha']):g} %"
    )
    return f'<p class="lead">{sentence}</p>{d.svg(width, height, parts, "Global test")}'


def groups(c: Context) -> str:
    """Redundancy and variance factor of every group, the worst first."""
    rows = []
    for name, g in sorted(c.solution["groups"].items(), key=lambda x: -abs(x[1]["deviation"] or 0.0)):
        deviation = fixed(g["deviation"], 1)
        if g["deviation"] is not None and abs(g["deviation"]) > _CLEAR:
            deviation = pill("warn", deviation)
        numbers = (fixed(g["variance_factor"], 3), fixed(g["sigma_scale"], 3), deviation)
        rows.append(
            (esc(name), count(g["n_observations"]), fixed(g["redundancy"], 1), general(g["omega"], 6), *numbers)
        )
    note = (
        "The variance factor is the weighted square sum omega over the redundancy of the group; its root is the number "
        "by which the sigmas given for the group would have to be multiplied to agree with its residuals. Deviation: "
        "of omega from the redundancy, in sigmas of chi-square."
    )
    columns = ("<Group", "Observations", "Redundancy", "Omega", "Variance factor", "Scale of sigmas", "Deviation [σ]")
    return section("groups", "Groups of observations", table(columns, rows) if rows else "", note)


def picture(c: Context) -> str:
    """Plan and perspective."""
    scene = scene_of(c.adjustment, c.scale)
    drawn, enlarged = pictures(scene, c.scale.ellipsoid)
    left_out = f" {count(scene.n_left_out)} points are left out for clarity." if scene.n_left_out else ""
    note = (
        f"95 % confidence ellipsoids of points (red) and stations (green), enlarged {general(enlarged, 3)} times. "
        "Cameras are drawn at the first epoch; thin lines are their axes at others, dash-dotted lines those of tables."
        f"{left_out}"
    )
    return section("picture", "The survey", f'<div class="figures">{drawn}</div>' if drawn else "", note)


def inputs(c: Context) -> str:
    """What went in: files with their hashes, options, versions."""
    i = c.solution["inputs"]
    files = table(("<File", "<Hash"), [(esc(k), f"<code>{esc(v)}</code>") for k, v in i["hashes"].items()])
    parts = [files] if i["hashes"] else []
    for title, entries in (("Options", i["options"]), ("Versions", i["versions"])):
        if entries:
            parts.append(f"<h3>{title}</h3>" + definition((k, esc(v)) for k, v in entries.items()))
    return section("inputs", "Inputs", "".join(parts))
