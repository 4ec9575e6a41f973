"""The first screen of a report: verdict, warnings, key figures, global test, groups, picture, inputs."""

from typing import Any

from markupsafe import Markup

from survey.report import drawing as d
from survey.report import markup as m
from survey.report.context import Context
from survey.report.language import group_name, known, message, t
from survey.report.picture import pictures
from survey.report.scene import scene_of, space
from survey.solution.quantities import sigma_unit_for_people
from survey.solution.tolerances import Verdict, coverage

_WORDS = {"passed": "Passed", "check": "Needs a look", "failed": "Failed"}
_MOST_WARNINGS = 25
_MOST_VERDICTS = 200
_MOST_PARTS = 20
_MOST_IMAGES = 500
_KINDS = {"group": "Group", "camera": "Camera", "epoch": "Epoch", "target": "Target", "table": "Table",
          "set-up": "Set-up", "instrument": "Instrument"}  # fmt: skip
_CLEAR = 3.0  # deviations of a group beyond this many sigmas are marked


def header(c: Context) -> Markup:
    """Title, verdict and, before anything else, what is wrong."""
    s = c.solution["summary"]
    version = c.run.versions.get("labsurvey", "")
    meta = " · ".join(x for x in (c.run.folder, c.run.date, f"labsurvey {version}".strip()) if x)
    found = s["suspects"]
    warnings = c.solution["warnings"]
    problems: list[str] = [message(w) for w in warnings[:_MOST_WARNINGS]]
    if len(warnings) > _MOST_WARNINGS:
        problems.append(t("{n} more warnings in solution.json.", n=m.count(len(warnings) - _MOST_WARNINGS)))
    if found["n_image_points"]:
        n = m.count(found["n_image_points"])
        problems.append(t('<a href="#image-points">{n} image points</a> are suspect.', n=n))
    if found["n_other"]:
        n = m.count(found["n_other"])
        problems.append(t('<a href="#observations">{n} other observations</a> are suspect.', n=n))
    out = c.solution["left_out"]
    if out["in_this_run"]:
        problems.append(t("{n} observations were left out by this adjustment.", n=m.count(out["in_this_run"])))
    if out["by_people"] + out["in_files"]:
        n = m.count(out["by_people"] + out["in_files"])
        problems.append(t('<a href="#excluded">{n} observations</a> are left out by people or their tables.', n=n))
    verdicts = () if c.statistics is None else c.statistics.verdicts
    n_unmet = sum(not v.met for v in verdicts)
    if n_unmet:
        n, most = m.count(n_unmet), m.count(len(verdicts))
        said = t('<a href="#tolerances">{n} of {most} demands</a> on the results are not met.', n=n, most=most)
        problems.insert(0, said)
    calm = m.element("p", t("No warnings, nothing suspect, nothing left out."), "calm")
    return m.joined((
        m.part("header", t("Adjustment report"), s["title"] or c.run.folder, meta),
        m.part("verdict", s["verdict"], t(_WORDS[s["verdict"]]), message(s["reason"])), m.listed(problems) or calm,
    ))  # fmt: skip


def summary(c: Context) -> Markup:
    """Key figures and the global test."""
    s = c.solution["summary"]
    values = (
        (t("sigma0 (a priori 1)"), m.fixed(s["sigma0"], 3)),
        (t("observations"), m.count(s["n_observations"])),
        (t("unknowns"), m.count(s["n_unknowns"])),
        (t("redundancy"), m.count(s["redundancy"])),
        (t("iterations"), f"{s['iterations']}" + ("" if s["converged"] else t(" (not converged)"))),
        (t("last step"), f"{m.general(s['last_step_sigmas'], 2)} σ"),
        (t("datum"), t("{kind}, defect {n}", kind=t(s["datum"]), n=s["datum_defect"])),
    )
    if s["sigmas"] == "a_posteriori":
        factor = m.fixed(s["sigma_factor"], 4)
        said = t("Sigmas of unknowns here are <b>a posteriori</b>: multiplied by sigma0 = {factor}.", factor=factor)
    else:
        said = t("Sigmas of unknowns here are <b>a priori</b>: they follow from the sigmas of the observations alone.")
    said += " " + t(
        "Sigmas of observations, standardized residuals and tests are a priori. Residuals are adjusted minus observed."
    )
    cards = m.part("cards", [(value, name) for name, value in values])
    return m.section("summary", "Summary", cards + _global_test(s["global_test"]) + m.note(said))


def _global_test(test: dict[str, Any] | None) -> Markup:
    if test is None:
        return m.note(t("No global test: there is no redundancy."))
    width, height, left = 400.0, 58.0, 20.0  # also on a telephone seen as a whole
    r = test["redundancy"]
    # the scale is the variance factor omega / r; its interval and the value always fit
    marks = {k: test[k] / r for k in ("lower", "upper", "omega")}
    low, high = min(*marks.values(), 1.0), max(*marks.values(), 1.0)
    span = max(high - low, 1e-6)
    x = {
        k: left + (v - low + 0.1 * span) / (1.2 * span) * (width - 2 * left) for k, v in (marks | {"one": 1.0}).items()
    }
    colour = {"passed": d.GREEN, "cautious": d.ORANGE, "failed": d.RED}[test["status"]]
    parts = [
        d.line(left, 28, width - left, 28, d.FAINT, 2),
        d.rect(x["lower"], 22, x["upper"] - x["lower"], 12, d.GREEN, ' fill-opacity="0.22" rx="2"'),
        d.line(x["one"], 20, x["one"], 36, d.GREY),
        d.dot(x["omega"], 28, 5.5, colour),
        d.text(min(max(x["omega"], 70.0), width - 70.0), 14, f"omega / r = {m.general(marks['omega'])}", "middle",
               11.5, colour),
    ]
    if x["upper"] - x["lower"] > 110:
        parts += [d.text(x[k], 50, m.general(marks[k]), "middle") for k in ("lower", "upper")]
    else:
        words = t("{low} to {high}", low=m.general(marks["lower"]), high=m.general(marks["upper"]))
        parts.append(d.text(0.5 * (x["lower"] + x["upper"]), 50, words, "middle"))
    said = {"passed": "passed", "cautious": "cautious sigmas", "failed": "failed"}[test["status"]]
    word = m.pill({"passed": "good", "cautious": "warn", "failed": "bad"}[test["status"]], t(said))
    sentence = t(
        "Global test {word} omega = {omega}, redundancy {r}, accepted between {lower} and {upper} at {level} %",
        word=word, omega=m.general(test["omega"], 6), r=m.count(r), lower=m.general(test["lower"], 6),
        upper=m.general(test["upper"], 6), level=m.general(100 * (1 - test["alpha"])),
    )  # fmt: skip
    drawn = d.svg(width, height, parts, t("Global test"))
    return m.element("p", sentence, "lead") + m.element("div", drawn)


def groups(c: Context) -> Markup:
    """Redundancy and variance factor of every group, the worst first."""
    rows = []
    for name, g in sorted(c.solution["groups"].items(), key=lambda x: -abs(x[1]["deviation"] or 0.0)):
        deviation: str = m.fixed(g["deviation"], 1)
        if g["deviation"] is not None and abs(g["deviation"]) > _CLEAR:
            deviation = m.pill("warn", deviation)
        numbers = (m.fixed(g["variance_factor"], 3), m.fixed(g["sigma_scale"], 3), deviation)
        sums = (m.count(g["n_observations"]), m.fixed(g["redundancy"], 1), m.general(g["omega"], 6))
        rows.append((group_name(name), *sums, *numbers))
    said = t(
        "The variance factor is the weighted square sum omega over the redundancy of the group; its root is the number "
        "by which the sigmas given for the group would have to be multiplied to agree with its residuals. Deviation: "
        "of omega from the redundancy, in sigmas of chi-square."
    )
    columns = ("<Group", "Observations", "Redundancy", "Omega", "Variance factor", "Scale of sigmas", "Deviation [σ]")
    return m.section("groups", "Groups of observations", m.table(columns, rows) if rows else "", said)


def parts(c: Context) -> Markup:
    """Every part of the survey tested for itself, the least likely first; what the statistics leave out."""
    s = c.found
    tested, out = s.consistency, Markup()
    if tested is not None and tested.parts:
        rows = [
            (f"{t(_KINDS[x.kind])} {group_name(x.name) if x.kind == 'group' else x.name}", m.count(x.n),
             m.fixed(x.redundancy, 1), m.fixed(x.factor, 3), m.general(x.p, 2),
             m.pill("bad", t("does not fit")) if x.fails else m.pill("good", t("fits")))
            for x in tested.parts[:_MOST_PARTS]
        ]  # fmt: skip
        classes = ["suspect" if x.fails else "" for x in tested.parts[:_MOST_PARTS]]
        columns = ("<Part", "Observations", "Redundancy", "Factor", "p", "<")
        said = t(
            "Every group, camera, epoch, target, table, set-up and instrument tested for itself, and {n} changes and "
            "shapes of cameras, targets and tables: {all} tests at {level} % together. The {most} with the smallest p "
            "are listed.",
            n=m.count(tested.n_changes), all=m.count(tested.n_tests), level=m.general(100 * tested.alpha),
            most=m.count(len(rows)),
        )  # fmt: skip
        out = m.section("parts", "Parts of the survey", m.table(columns, rows, "", classes), said)
    if s.left_out:
        out += m.section("not-computed", "Not computed", m.listed(map(message, s.left_out), ""))
    return out


def identification(c: Context) -> Markup:
    """Who measured what, as the project says it."""
    said = c.run.identification
    return m.section("identification", "Identification", m.definition(said) if said else "")


def tolerances(c: Context) -> Markup:
    """What the project demands of its results, the hardest to meet first."""
    if not c.found.verdicts:
        return Markup()
    found = sorted(c.found.verdicts, key=lambda v: -v.found / v.allowed)
    rows = [_verdict_row(v) for v in found[:_MOST_VERDICTS]]
    columns = ("<Demand", "<Result", "<Quantity", "<", "Found", "Allowed", "<Unit", "Used [%]", "<")
    classes, more = ["" if v.met else "suspect" for v in found[:_MOST_VERDICTS]], m.more(len(found) - len(rows))
    said = t(
        "U: expanded uncertainty at 95 % (k = {k}), in the worst direction. |Δ| + U: deviation from nominal with its "
        "uncertainty; what is not proven is not met (ISO 14253-1).",
        k=m.fixed(coverage(c.adjustment, c.scale), 2),
    )
    return m.section("tolerances", "Tolerances", m.table(columns, rows, "", classes), said + more)


def _verdict_row(v: Verdict) -> tuple[str, ...]:
    unit, factor = sigma_unit_for_people(v.unit)
    said = m.pill("good", t("met")) if v.met else m.pill("bad", t("not met"))
    return (
        v.tolerance, " ".join(v.result[1:]), known(v.quantity), "|Δ| + U" if v.of_value else "U",
        m.general(v.found * factor, 3), m.general(v.allowed * factor, 3), unit, m.fixed(100 * v.found / v.allowed, 0),
        said,
    )  # fmt: skip


def picture(c: Context) -> Markup:
    """Plan and perspective."""
    scene = scene_of(c.adjustment, c.scale)
    drawn, enlarged = pictures(scene, c.scale.ellipsoid)
    n = m.count(scene.n_left_out)
    left_out = " " + t("{n} points and stations are left out for clarity.", n=n) if scene.n_left_out else Markup()
    said = t(
        "95 % confidence ellipsoids of points (red) and stations (green), enlarged {n} times. "
        "Cameras are drawn at the first epoch; thin lines are their axes at others, dash-dotted lines those of tables.",
        n=m.general(enlarged, 3),
    ) + left_out
    return m.section("picture", "The survey", m.figures(drawn) + space(c.adjustment, c.scale, scene), said)


def inputs(c: Context) -> Markup:
    """What went in: files with their hashes, options, versions."""
    i = c.solution["inputs"]
    files = m.table(("<File", "<Hash"), [(k, m.code(v)) for k, v in i["hashes"].items()])
    parts = [m.definition([(t("Command"), m.code(i["command"]))])] if i["command"] else []
    parts += [files] if i["hashes"] else []
    if i["images"]:
        shown = list(i["images"].values())[:_MOST_IMAGES]
        rows = [(e["file"], m.code(e["sha256"]), m.count(e["n_image_points"] + e["n_spots"])) for e in shown]
        images, left_out = m.table(("<Image", "<Hash", "Points"), rows), len(i["images"]) - len(rows)
        images += m.note(m.more(left_out)) if left_out else Markup()
        said = t("{n} images, each with the hash of the file that its points come from", n=m.count(len(i["images"])))
        parts.append(m.part("details", said, images, False))
    for title, entries in (("Options", i["options"]), ("Versions", i["versions"])):
        if entries:
            parts.append(m.element("h3", t(title)) + m.definition(entries.items()))
    return m.section("inputs", "Inputs", m.joined(parts))
