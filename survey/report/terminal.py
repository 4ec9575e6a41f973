"""The summary of an adjustment for the terminal: about twenty-five aligned lines, the worst first."""

import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from adjust.model.result import Adjustment
from survey.project.observed import name_of_residual
from survey.report.anchors import anchor, anchors_in
from survey.report.sections.published import head_rows, worst_pairs
from survey.solution.dictionary import RunInfo, solution_dict
from survey.solution.records import having

_WIDTH = 100
_WORDS = {"passed": "PASSED", "check": "NEEDS A LOOK", "failed": "FAILED"}
_MOST_WARNINGS, _MOST_GROUPS, _MOST_CAMERAS, _MOST_OTHER, _MOST_POINTS, _MOST_TERMS = 6, 6, 6, 4, 3, 12
_MOST_LOOPS, _MOST_EXCLUSIONS, _MOST_PAIRS = 3, 5, 5


def summary_text(adjustment: Adjustment, run: RunInfo, solution: dict[str, Any] | None = None) -> str:
    """Verdict, warnings, key figures, groups, cameras, network, worst observations and points.

    solution: that of :func:`survey.solution.dictionary.solution_dict`, made here where it is not given.
    """
    solution = solution_dict(adjustment, run) if solution is None else solution
    limit = solution["summary"]["suspects"]["standardized_limit"]
    parts = (_head, _figures, _exclusions, _groups, _cameras, _terms, _network, _loops, _published)
    took = [", ".join(f"{step} {seconds:.2f} s" for step, seconds in run.seconds.items())] if run.seconds else []
    blocks = [list(part(solution)) for part in parts]
    blocks += [list(_observations(adjustment, limit)), list(_points(solution)), [f"  {said}" for said in took]]
    return "\n\n".join("\n".join(map(str.rstrip, block)) for block in blocks if block) + "\n"


def _few(rows: Sequence[str], most: int, what: str) -> Iterator[str]:
    """The first ones, and how many more there are; ``what`` begins as the line does, with ``{n}``."""
    yield from rows[:most]
    if len(rows) > most:
        yield what.format(n=len(rows) - most)


def _number(value: float | None, width: int, decimals: int) -> str:
    return f"{'-':>{width}}" if value is None or not math.isfinite(value) else f"{value:{width}.{decimals}f}"


def _cut(text: str, width: int) -> str:
    return text if len(text) <= width else text[: width - 1] + "…"


def _head(solution: dict[str, Any]) -> Iterator[str]:
    s = solution["summary"]
    yield f"{_cut(s['title'] or solution['inputs']['folder'], 70)}: {_WORDS[s['verdict']]}"
    yield s["reason"]
    warnings = ["  ".join([f"  ! {w}", *anchors_in(w)]) for w in solution["warnings"]]
    yield from _few(warnings, _MOST_WARNINGS, "  ! and {n} more, see the report")


def _figures(solution: dict[str, Any]) -> Iterator[str]:
    s, test = solution["summary"], solution["summary"]["global_test"]
    found = s["suspects"]
    yield (
        f"  sigma0 {_number(s['sigma0'], 0, 4)}   observations {s['n_observations']}   unknowns {s['n_unknowns']}   "
        f"redundancy {s['redundancy']}   iterations {s['iterations']}"
    )
    if test:
        said = {"passed": "passed", "cautious": "passed with cautious sigmas", "failed": "FAILED"}[test["status"]]
        yield (
            f"  global test {said}: omega {test['omega']:.1f}, accepted "
            f"{test['lower']:.1f} to {test['upper']:.1f} at {100 * (1 - test['alpha']):g} %"
        )
    parts = solution.get("consistency")
    if parts and parts["n_tests"]:
        failed = [f"{kind} {name}" for kind, x in parts["parts"].items()
                  for name, fits in x.numbers("fits").items() if not fits]  # fmt: skip
        changed = [f"{x['kind']} {x['name']}" for x in parts["changes"]]
        listed = ", ".join(dict.fromkeys(changed + failed)) or "all fit"
        yield f"  parts and changes: {parts['n_tests']} tests: {_cut(listed, _WIDTH - 30)}"
    yield from (f"  not computed: {line}" for line in solution.get("not_computed", ()))
    yield (
        f"  suspect: {found['n_image_points']} image points, {found['n_other']} other observations; "
        f"not used: {found['n_not_used']}   (sigmas below {s['sigmas'].replace('_', ' ')})"
    )
    out = solution["left_out"]
    if any(out.values()):
        yield (
            f"  left out: {out['by_people']} by people, {out['in_files']} marked used = false, "
            f"{out['in_this_run']} by this run"
        )


def _exclusions(solution: dict[str, Any]) -> Iterator[str]:
    found = solution["exclusions"]
    if found:
        yield f"  excluded by people ({len(found)})"
    for e in found[-_MOST_EXCLUSIONS:]:
        w = e["largest_standardized_residual"]
        now = "" if w is None else f"  now w {w:.1f}"
        said = f"{e['reason'] or 'no reason given'} ({e['author'] or 'nobody named'})"
        yield f"  {_cut(e['name'], 36):<36}{now:<13} {_cut(said, _WIDTH - 52)}"
    if len(found) > _MOST_EXCLUSIONS:
        yield f"  and {len(found) - _MOST_EXCLUSIONS} before these"


def _groups(solution: dict[str, Any]) -> Iterator[str]:
    groups = sorted(solution["groups"].items(), key=lambda x: -abs(x[1]["deviation"] or 0.0))
    if groups:
        yield f"  {'group':<18}{'observations':>13}{'redundancy':>12}{'variance factor':>17}"
    rows = [f"  {_cut(name, 18):<18}{g['n_observations']:>13}{g['redundancy']:>12.1f}"
            f"{_number(g['variance_factor'], 17, 3)}" for name, g in groups]  # fmt: skip
    yield from _few(rows, _MOST_GROUPS, "  and {n} more groups")


def _cameras(solution: dict[str, Any]) -> Iterator[str]:
    cameras = sorted(solution["cameras"].items(), key=lambda x: -(x[1]["rms_residual_px"] or 0.0))
    if cameras:
        yield f"  {'camera':<18}{'images':>7}{'points':>9}{'RMS px':>9}   largest sigma of the lens"
    rows = [f"  {_cut(camera_id, 18):<18}{c['n_images']:>7}{c['n_image_points']:>9}"
            f"{_number(c['rms_residual_px'], 9, 3)}   {_lens(c.get('lens'))}" for camera_id, c in cameras]  # fmt: skip
    yield from _few(rows, _MOST_CAMERAS, "  and {n} more cameras")


def _lens(lens: dict[str, Any] | None) -> str:
    if lens is None:
        return ""
    sigmas = {k[6:-3]: v for k, v in lens.items() if k.startswith("sigma_") and k.endswith("_px") and v}
    parts = []
    if sigmas:
        name = max(sigmas, key=lambda k: sigmas[k])
        parts.append(f"{name} {sigmas[name]:.2g} px")
    if lens["not_significant"]:
        parts.append(f"not significant: {' '.join(lens['not_significant'])}")
    # fx and fy of a camera always go together; that is no news
    strong = next((p for p in lens["correlations_over_95_percent"] if {p["a"], p["b"]} != {"fx", "fy"}), None)
    if strong is not None:
        parts.append(f"{strong['a']}-{strong['b']} correlated {100 * strong['correlation']:.1f} %")
    return ", ".join(parts)


_SAID = {"": ("significant", "not significant"), "lens_shared": ("does not hold", "holds")}


def _terms(solution: dict[str, Any]) -> Iterator[str]:
    """Terms of boards, tables, lenses and clocks that are estimated, and whether they differ from zero."""
    owners = [(f"target {k}", e["warp"]) for k, e in solution["targets"].items() if "warp" in e]
    owners += [(f"table {k}", e["geometry"]) for k, e in solution["tables"].items() if "geometry" in e]
    owners += [(f"camera {k}", e[key]) for k, e in solution["cameras"].items()
               for key in ("lens_drift", "lens_crop", "lens_shared") if key in e]  # fmt: skip
    owners += [(f"{kind[:-1]} {k}", e["clock"]) for kind in ("cameras", "tables", "stations")
               for k, e in having(solution[kind], "clock").items()]  # fmt: skip
    rows = []
    for name, term, test in ((k, *one) for k, e in owners for one in e.get("significance", {}).items()):
        said = _SAID.get(term, _SAID[""])[not test["significant"]]
        shown = f"{_cut(name, 26):<26}  {_cut(term.replace('_', ' '), 24):<24}"
        rows.append(f"  {shown}  {said}, p {test['p_value']:.2g}")
    yield from _few(rows, _MOST_TERMS, "  and {n} more terms")


def _network(solution: dict[str, Any]) -> Iterator[str]:
    n = solution.get("network")
    if n is None:
        return
    what = "poses" if n["equations_per_condition"] == 6 else "rotations"
    yield (
        f"  network: {n['n_stations']} stations, {n['measured_pairs']} of {n['measurable_pairs']} pairs measured, "
        f"{n['independent_unknown_poses']} unknown {what}"
    )
    yield (
        f"  {n['independent_conditions']} independent conditions ({n['redundancy']} equations), "
        f"{n['conditions_per_pair']:.2f} per pair"
    )
    if n["uncontrolled_pairs"]:
        yield f"  close no loop: {_cut(', '.join(n['uncontrolled_pairs']), _WIDTH - 20)}"


def _loops(solution: dict[str, Any]) -> Iterator[str]:
    found = solution.get("loops")
    if not found or not found["n_loops"]:
        return
    how = ", closed by the adjustment" if found["form"] == "closed" else ""
    yield f"  loops: {found['n_loops']}{how}, of which {found['n_failed']} do not close as measured; worst, and after"
    for e in found["worst_first"][:_MOST_LOOPS]:
        flag, left = "" if e["closes"] else "  OPEN", _size(e, "misclosure_after", 1e-6)
        names = _cut(" ".join(e["stations"]), 40)
        yield f"  {names:<40}{_size(e, 'misclosure'):>22} {left:>14}  p {e['p_value']:.2g}{flag}"
    for name, e in solution.get("closures", {}).items():
        play = _size(e, "play")
        yield f"  mount {_cut(name, 34):<34}{_size(e, 'misclosure'):>22} {play:>14}  p {e['p_value']:.2g}"


def _size(e: dict[str, Any], what: str, least: float = 0.0) -> str:
    """The parts of a misclosure or play that there are; what is not above ``least`` is none."""
    parts = ((e.get(f"{what}_arcsec"), "″"), (e.get(f"{what}_mm"), " mm"))
    return " ".join(f"{x if x > least else 0:.4g}{unit}" for x, unit in parts if x is not None)


def _published(solution: dict[str, Any]) -> Iterator[str]:
    found = solution.get("published")
    if not found:
        return
    yield "  published methods, step by step, beside this adjustment"
    if "head" in found:
        heads = f"{'published':>11}{'claimed σ':>10}{'σ':>9}{'joint':>11}{'σ':>9}{'difference':>11}{'ratio':>7}"
        yield f"  {'':<30}{heads}"
        for pose, name, unit, e in head_rows(found["head"]):
            small, digits, fine = ("arcsec", 4, 1) if unit == "deg" else ("mm", 3, 3)
            values = (_number(e[f"{which}_{unit}"], 11, digits) for which in ("published", "joint"))
            sigmas = (e[f"{which}_sigma_{small}"] for which in ("claimed", "published", "joint"))
            (value, other), (claimed, own, joint) = values, map(_number, sigmas, (10, 9, 9), [fine] * 3)
            apart = _number(e[f"difference_{small}"], 11, fine)
            place = f"{_cut(pose, 22)} {name} {unit}"
            yield f"  {place:<30}{value}{claimed}{own}{other}{joint}{apart}{_number(e['sigma_ratio'], 7, 1)}"
        yield "  claimed: as each step states it, σ: through all steps; difference: published minus joint; σ and"
        yield "  differences of angles in arcsec, of turns about the axes: near ry = ±90° rx and rz differ by more"
    if "pairs" in found:
        pairs, steps = found["pairs"], found["pairs"]["steps"]["weighted"]
        said = f"{pairs['n_loops']} loops closed in {steps['iterations']} iterations"
        yield f"  {said}; the farthest from this adjustment, arcsec"
        yield f"  {'':<30}{'published - joint x y z':>28}{'published σ x y z':>24}{'joint σ x y z':>24}"
        for pair_id in worst_pairs(pairs)[:_MOST_PAIRS]:
            e = pairs["pairs"][pair_id]
            off, sigma = (e["weighted"].get(k) or [None] * 3 for k in ("difference_arcsec", "sigma_rotation_arcsec"))
            ours = e["joint"]["sigma_rotation_arcsec"] or [None] * 3
            cells = "".join(_number(x, 8, 2) for x in (*off, *sigma, *ours))
            yield f"  {_cut(pair_id, 30):<34}{cells}"
    for name, why in found["not_run"].items():
        yield f"  not run ({name}): {_cut(' '.join(why.split()), _WIDTH - 20)}"
    yield from (f"  {note}" for part in ("head", "pairs") for note in found.get(part, {}).get("notes", ()))


def _observations(adjustment: Adjustment, limit: float) -> Iterator[str]:
    size, used = adjustment.other_arrays.largest, np.flatnonzero(adjustment.other_arrays.used)
    worst = used[np.argsort(-size[used], kind="stable")][:_MOST_OTHER].tolist()
    if worst:
        yield "  largest standardized residuals"
    for k in worst:
        o = adjustment.other_residuals[k]
        flag = "  SUSPECT" if size[k] > limit else ""
        place = anchor("reading", name_of_residual(o))
        yield f"  {_cut(f'{o.kind} {chr(32).join(o.ids)}', 44):<44}{size[k]:>8.2f}{flag}  {place}"


def _points(solution: dict[str, Any]) -> Iterator[str]:
    sized = {k: p["ellipsoid_95_semi_axes_mm"][0] for k, p in solution["points"].items()}
    worst = sorted(sized, key=lambda k: -sized[k])[:_MOST_POINTS]
    if worst:
        heading = f"least precise of {len(sized)} points"
        yield f"  {heading:<32}{'sigma x y z mm':>24}{'95 % semi-axis mm':>20}"
    for name in worst:
        p = solution["points"][name]
        sigmas = "".join(_number(p[f"sigma_{a}_mm"], 8, 3) for a in "xyz")
        yield f"  {_cut(name, 32):<32}{sigmas}{sized[name]:>20.3f}  {anchor('point', name)}"
