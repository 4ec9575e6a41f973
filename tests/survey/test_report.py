import json
import re
import shutil
import sys
import xml.etree.ElementTree as ET
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from gtsam import Pose3, Rot3
from jinja2 import Environment

from adjust.model.errors import SurveyError
from adjust.model.result import Adjustment, ImageResiduals
from adjust.model.survey import Survey
from survey.jobs.adjusting.steps import adjust_project
from survey.project import read
from survey.project.detected import DetectedImage
from survey.report import drawing, markup
from survey.report import page as page_module
from survey.report.charts import CameraResiduals, histogram, mean_field, vector_field
from survey.report.context import worst
from survey.report.language import esc
from survey.report.page import report_html
from survey.report.picture import HEIGHT, WIDTH, perspective, pictures, plan
from survey.report.scene import Scene, Spot, enlargement, scene_of
from survey.report.sections import every_observation, statistics, unknowns
from survey.report.terminal import summary_text
from survey.solution.dictionary import RunInfo, solution_dict
from survey.solution.quantities import scale_of
from survey.solution.statistics import statistics_of
from tests.labs import example
from tests.survey.adjustments import Lab, correlate, lab_adjustment

RUN = RunInfo(
    "lab", "Full lab", {"survey.toml": "12ab"}, {"alpha": 0.05}, {"labsurvey": "0.1.0"}, "2026-01-02", {"solve": 1.5}
)
VOID = {"meta", "link", "br", "img", "input", "hr"}


class Balanced(HTMLParser):
    """Fails on a tag that closes what is not open; collects the text."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.words: list[str] = []
        self.anchors: set[str] = set()
        self.links: set[str] = set()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = dict(attrs)
        if found.get("id"):
            self.anchors.add(str(found["id"]))
        if (found.get("href") or "").startswith("#"):
            self.links.add(str(found["href"])[1:])
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open
        assert self.open.pop() == tag

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        pass

    def handle_data(self, data: str) -> None:
        if not self.open or self.open[-1] != "style":
            self.words.append(data)


def parsed(page: str) -> Balanced:
    parser = Balanced()
    parser.feed(page)
    parser.close()
    assert parser.open == []
    return parser


@pytest.fixture(scope="module")
def adjustment() -> Adjustment:
    made = lab_adjustment(Lab(n_epochs=9, blunders=6, noise=1.3), ("Point B7 is seen from one direction only.",))
    lens = correlate(made.estimates["lens", "Z"], "k1", "k2", -0.97)
    return replace(made, estimates={**made.estimates, ("lens", "Z"): lens})


@pytest.fixture(scope="module")
def page(adjustment: Adjustment) -> str:
    return report_html(adjustment, RUN)


def empty_adjustment() -> Adjustment:
    none = ImageResiduals(
        np.zeros(1, dtype=np.int64),
        np.empty((0, 2)),
        np.empty((0, 2)),
        np.empty((0, 2)),
        np.empty(0),
        np.empty(0, dtype=bool),
    )
    return Adjustment(Survey(), {}, none, (), (), 0, 0, 0, 0, 0.0, float("nan"), None, 0, 0.0, True, (), None)


def test_page_is_well_formed_and_its_links_lead_somewhere(page: str) -> None:
    found = parsed(page)
    assert found.links
    assert found.links <= found.anchors
    pictures = re.findall(r"<svg.*?</svg>", page, re.S)
    groups = {"image", "table", "pair", "distance"}
    # global test, two views, three for each camera, quantiles of the groups large enough
    assert 1 + 2 + 3 * 3 + 1 <= len(pictures) <= 1 + 2 + 3 * 3 + len(groups)
    for picture in pictures:
        ET.fromstring(picture)
        assert "nan" not in picture
        assert "inf" not in picture


def test_page_needs_nothing_from_elsewhere(page: str) -> None:
    for word in ("http:", "https:", "src=", "@import", "url(", "<link", "fetch(", "import("):
        assert word not in page, word
    # its own script and the data for it, nothing else
    assert sorted(re.findall(r"<script([^>]*)>", page)) == [
        "",
        *(f' type="application/json" id="{name}"' for name in ("all-data", "space-data", "words")),
    ]


def test_problems_come_first_and_the_verdict_is_in_words(page: str) -> None:
    words = " ".join(parsed(page).words)
    assert (
        words.index("Failed")
        < words.index("Point B7 is seen from one direction only.")
        < words.index("Groups of observations")
    )
    assert words.index("image points") < words.index("unknowns")


def test_what_a_person_looks_for_is_there(page: str, adjustment: Adjustment) -> None:
    words = " ".join(parsed(page).words)
    assert f"{adjustment.sigma0:.3f}" in words
    assert "a posteriori" in words
    assert "95 % confidence ellipsoids" in words
    assert "not significant" in words
    assert re.search(r"k1\s+with\s+k2\s+−97\.0 %", words)
    for name in ("turntable", "relay", "board", "B3", "survey.toml", "12ab", "non_orthogonality", "d1 · B1 · B2"):
        assert name in words, name


def test_values_are_printed_with_the_digits_of_their_sigma(page: str, adjustment: Adjustment) -> None:
    lens = adjustment.estimates["lens", "X"]
    sigma = adjustment.sigma0 * np.sqrt(lens.cov[0, 0])
    assert 0.1 < sigma < 1.0
    value = float(np.asarray(lens.value)[0])
    assert f'<code>fx</code></td><td class="r">{value:.2f}</td><td class="r">{sigma:.2f}</td>' in page


def test_names_cannot_become_markup(adjustment: Adjustment) -> None:
    evil = "<script>alert('1')</script>&\""
    survey = adjustment.survey
    cameras = tuple(replace(c, camera_id=evil) if c.camera_id == "X" else c for c in survey.cameras)
    blocks = tuple(replace(b, camera_id=evil, epoch_id=evil) if b.camera_id == "X" else b for b in survey.image_blocks)
    points = tuple(replace(p, point_id=evil) if p.point_id == "B1" else p for p in survey.points)
    targets = tuple(replace(t, target_id=evil) if t.target_id == "board" else t for t in survey.targets)
    blocks = tuple(replace(b, target_id=evil) if b.target_id == "board" else b for b in blocks)
    swap = {"X": evil, "B1": evil, "board": evil, "relay": evil}
    estimates = {}
    for name, estimate in adjustment.estimates.items():
        new = tuple(swap.get(n, n) for n in name)
        estimates[new] = replace(estimate, name=new)
    others = tuple(replace(o, ids=(evil,), group=evil) for o in adjustment.other_residuals)
    groups = tuple(replace(g, group=evil) for g in adjustment.groups[:1])
    stations = tuple(replace(s, station_id=evil) if s.station_id == "relay" else s for s in survey.stations)
    targets = tuple(replace(t, station_id=evil) if t.station_id == "relay" else t for t in targets)
    survey = replace(survey, cameras=cameras, image_blocks=blocks, points=points, targets=targets, stations=stations)
    changed = replace(
        adjustment,
        survey=replace(survey, pairs=()),
        estimates=estimates, other_residuals=others, groups=groups, warnings=(evil,),
    )  # fmt: skip
    page = report_html(changed, RunInfo(evil, evil, {evil: evil}, {evil: evil}, {evil: evil}, evil, {evil: 1.0}))
    assert "<script>alert" not in page
    assert page.count("</script>") == 4
    assert page.count(esc(evil)) > 20
    parsed(page)
    for picture in re.findall(r"<svg.*?</svg>", page, re.S):
        ET.fromstring(picture)


@pytest.mark.slow
def test_a_large_laboratory_stays_readable_and_small() -> None:
    made = lab_adjustment(Lab(n_epochs=100, n_beacons=60))
    page = report_html(made, RUN)
    assert len(made.image_residuals.test) > 8000
    assert len(page) < 2_500_000  # every one of the 16000 coordinates takes about 90 bytes
    assert "1\u2009500 of" in page
    parsed(page)


def test_report_of_nothing_but_a_title() -> None:
    page = report_html(empty_adjustment(), RUN)
    words = " ".join(parsed(page).words)
    assert "Nothing was tested" in words
    assert "Cameras" not in words
    assert "Full lab" in summary_text(empty_adjustment(), RUN)


def test_what_is_made_before_the_statistics_does_not_ask_for_them() -> None:
    asked = ("statistics", "found")
    asking = {anchor for _, anchor, make in page_module._SECTIONS if {*asked} & {*make.__code__.co_names}}
    assert asking == page_module._OF_STATISTICS


def test_templates_are_compiled_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And again where they have changed, what is kept of them is damaged, or nothing may be kept."""
    shutil.copytree(markup._HERE / "templates", tmp_path / "templates", ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(markup, "_HERE", tmp_path)
    compiled: list[str] = []
    plain = Environment.compile
    monkeypatch.setattr(Environment, "compile", lambda self, source, name, file: compiled.append(name) or plain(
        self, source, name, file))  # fmt: skip

    def said() -> str:
        compiled.clear()
        return str(markup._environment.__wrapped__().get_template("parts.html").module.element("b", "x", ""))

    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    assert [said(), said()] == ["<b>x</b>"] * 2
    assert compiled == ["parts.html"]
    monkeypatch.setattr(sys, "dont_write_bytecode", False)
    assert [said(), said()] == ["<b>x</b>"] * 2
    assert not compiled
    (kept,) = (tmp_path / "templates" / "__pycache__").glob("parts.*")
    kept.write_bytes(kept.read_bytes()[:40])
    assert said() == "<b>x</b>"
    assert compiled == ["parts.html"]
    source = tmp_path / "templates" / "parts.html"
    source.write_text(source.read_text().replace("</{{ tag }}>", "!</{{ tag }}>"))
    assert said() == "<b>x!</b>"
    assert compiled == ["parts.html"]


def test_report_is_the_same_every_time(adjustment: Adjustment, page: str) -> None:
    assert page == report_html(adjustment, RUN)


def test_rows_are_sorted_by_their_standardized_residual(page: str) -> None:
    part = page[page.index('id="observations"') : page.index('id="image-points"')]
    shown = [
        float(x.replace(markup.MINUS, "-"))
        for x in re.findall(r'<td class="r">([−\d.]+)</td><td class="l">(?:<span|</td>)', part)
    ]
    assert len(shown) > 10
    assert np.all(np.diff(np.abs(shown)) <= 0)


def test_a_gross_error_is_shown_at_the_right_point(adjustment: Adjustment) -> None:
    found = adjustment.image_residuals
    k = 100
    test, used = found.test.copy(), found.used.copy()
    test[k], used[k] = 1e6, True
    page = report_html(replace(adjustment, image_residuals=replace(found, test=test, used=used)), RUN)
    part = page[page.index('id="image-points"') :]
    first = re.search(r"<tbody>(<tr.*?</tr>)", part, re.S)
    block_idx = int(np.searchsorted(found.block_ptr, k, side="right")) - 1
    block = adjustment.survey.image_blocks[block_idx]
    assert first is not None
    assert 'class="suspect"' in first[1]
    assert block.camera_id in first[1]
    assert block.epoch_id in first[1]
    assert f"{block.uv[k - found.block_ptr[block_idx], 0]:.2f}" in first[1]


@pytest.mark.parametrize(
    ("value", "sigma", "text", "sigma_text"),
    [
        (1599.26136, 0.21, "1599.26", "0.21"),
        (-0.13013, 0.00336, "−0.1301", "0.0034"),
        (12345.678, 23.4, "12346", "23"),
        (0.0, 0.0, "0", "–"),
        (2.5, None, "2.5", "–"),
        (float("nan"), 0.1, "–", "0.10"),
    ],
)
def test_digits(value: float, sigma: float | None, text: str, sigma_text: str) -> None:
    assert markup.value_text(value, sigma) == text
    assert markup.sigma_text(sigma) == sigma_text


@pytest.mark.parametrize(
    ("value", "digits", "text"),
    [(4583.2, 3, "4580"), (-151.2, 2, "−150"), (0.00012345, 2, "0.00012"), (12.0, 4, "12"), (2.5e12, 3, "2.5e+12")],
)
def test_numbers_of_unknown_size(value: float, digits: int, text: str) -> None:
    assert markup.general(value, digits) == text


def test_round_numbers_of_scale_bars() -> None:
    assert [drawing.round_below(x) for x in (1.0, 1.9, 2.0, 4.9, 5.0, 99.0, 0.03)] == pytest.approx(
        [1, 1, 2, 2, 5, 50, 0.02]
    )


def test_ellipse_has_the_axes_of_its_covariance() -> None:
    turn = np.array([[np.cos(0.5), -np.sin(0.5)], [np.sin(0.5), np.cos(0.5)]])
    (axes,) = drawing.half_axes((turn @ np.diag([900.0, 100.0]) @ turn.T)[None])
    words = drawing.ellipse(np.array([10.0, 20.0]), axes, "red", "red")
    assert 'rx="30.0" ry="10.0"' in words
    angle = float(re.search(r"rotate\((.*?)\)", words)[1])
    assert angle % 180 == pytest.approx(np.degrees(0.5), abs=0.1)


def test_plan_is_true_to_scale_and_y_points_up() -> None:
    view = plan(np.array([(0.0, 0.0, 0.0), (4.0, 2.0, 1.0)]))
    a, b, up = view.to_picture(np.array([(0.0, 0.0, 0.0), (1.0, 0.0, 5.0), (0.0, 1.0, 0.0)]))
    assert b - a == pytest.approx((view.unit, 0.0))
    assert up - a == pytest.approx((0.0, -view.unit))
    np.testing.assert_allclose(view.jacobian(np.zeros(3)), view.unit * np.array([[1, 0, 0], [0, -1, 0]]), atol=1e-6)


def test_axes_at_the_edge_are_inside_the_picture() -> None:
    """The world's origin is the farthest point to the right and above."""
    far = np.array([(0.0, 0.0, 0.0), (-8.0, -6.0, -2.0)])
    scene = Scene()
    scene.outlines.append(("", far))
    for page in pictures(scene, 2.8)[0]:
        letters = re.findall(r'<text x="([-\d.]+)" y="([-\d.]+)"[^>]*>([xyz])</text>', page)
        assert letters
        assert all(8.0 < float(x) < WIDTH - 8.0 and 12.0 < float(y) < HEIGHT for x, y, _ in letters), letters


def test_everything_is_inside_the_perspective_and_near_things_are_larger() -> None:
    box = np.array([(x, y, z) for x in (0.0, 6.0) for y in (0.0, 4.0) for z in (0.0, 2.5)])
    view = perspective(box)
    xy = view.to_picture(box)
    assert xy.min() > 0
    assert np.all(xy < (540, 450))
    near, far = view.jacobian(np.array([3.0, 0.0, 1.0])), view.jacobian(np.array([3.0, 4.0, 1.0]))
    assert np.linalg.norm(near) > np.linalg.norm(far)
    assert view.jacobian(np.array([3.0, 2.0, 1.0]))[1, 2] < 0  # z up is y down of a picture


def test_enlargement_draws_a_typical_ellipsoid_at_a_visible_size() -> None:
    scene = Scene(
        spots=[Spot("a", "point", np.zeros(3), np.eye(3) * 1e-8), Spot("b", "point", np.ones(3), np.zeros((3, 3)))]
    )
    # semi-axis 2.8e-4 m, wanted 3.5 % of 10 m: 1250, rounded down
    assert enlargement(scene, 2.8, 10.0) == 1000.0
    assert enlargement(Scene(), 2.8, 10.0) == 1.0


def test_scene_turns_station_covariances_into_the_world(adjustment: Adjustment) -> None:
    relay = adjustment.estimates["world_from_station", "relay"]
    cov = np.zeros((6, 6))
    cov[3, 3] = 1e-6
    turned = replace(relay, value=Pose3(Rot3.Rz(np.pi / 2), np.zeros(3)), cov=cov)
    changed = replace(adjustment, estimates={**adjustment.estimates, ("world_from_station", "relay"): turned})
    scene = scene_of(changed, scale_of(changed, "a_priori"))
    spot = next(s for s in scene.spots if s.label == "relay")
    np.testing.assert_allclose(spot.cov, np.diag([0, 1e-6, 0]), atol=1e-18)
    assert {s.label for s in scene.shots if s.main} == {"X", "Y", "Z"}
    assert [name for name, _ in scene.outlines] == ["board"]
    assert pictures(Scene(), 2.8) == ((), 1.0)


def test_many_stations_are_drawn_in_an_even_selection(adjustment: Adjustment) -> None:
    relay = adjustment.estimates["world_from_station", "relay"]
    many = {("world_from_station", f"s{i}"): replace(relay, name=("world_from_station", f"s{i}")) for i in range(1200)}
    scene = scene_of(replace(adjustment, estimates={**adjustment.estimates, **many}), scale_of(adjustment, "a_priori"))
    drawn = [int(s.label[1:]) for s in scene.spots if s.kind == "station" and s.label[1:].isdigit()]
    assert set(np.diff(drawn)) == {3}
    assert scene.n_left_out + sum(s.kind == "station" for s in scene.spots) >= 1200
    assert len(drawn) <= 500


def camera(uv: np.ndarray, residuals: np.ndarray, standardized: np.ndarray | None = None) -> CameraResiduals:
    n = len(uv)
    w = np.zeros((n, 2)) if standardized is None else standardized
    return CameraResiduals("X", (1000, 800), uv, residuals, w, np.ones(n, dtype=bool), np.zeros(n, dtype=bool))


def test_mean_per_cell_shows_a_constant_shift() -> None:
    uv = np.random.default_rng(0).uniform((0, 0), (999, 799), (8000, 2))
    words = mean_field(camera(uv, np.tile((0.02, 0.0), (8000, 1))))
    moves = re.findall(r"M[\d.]+ [\d.]+l([\d.]+) ([\d.-]+)", words)
    shafts = [m for m in moves if m[1] in ("0.0", "-0.0") and float(m[0]) > 10]
    assert len(shafts) == 16 * 13
    assert len(set(shafts)) == 1
    assert "208 of 208 cells" in words


def test_arrows_follow_the_residual_to_scale() -> None:
    words = vector_field(camera(np.array([(500.0, 400.0)]), np.array([(0.3, -0.4)])))
    # 0.5 px is the longest residual, drawn 15 long
    assert "l9.0 -12.0" in words
    assert "all 1" in words


def test_histogram_counts_what_it_cannot_show() -> None:
    w = np.zeros((50, 2))
    w[:3] = 7.0
    w[3] = np.nan
    assert "6 beyond ±5" in histogram(camera(np.zeros((50, 2)), np.zeros((50, 2)), w))


def test_summary_for_the_terminal(adjustment: Adjustment) -> None:
    lines = summary_text(adjustment, RUN).splitlines()
    assert lines[0] == "Full lab: FAILED"
    assert "Point B7 is seen from one direction only." in lines[2]
    assert len(lines) <= 35
    text = "\n".join(lines)
    for word in (
        "sigma0",
        "global test FAILED",
        "a posteriori",
        "k1-k2 correlated -97.0 %",
        "SUSPECT" if "SUSPECT" in text else "image",
    ):
        assert word in text, word
    worst = max(float(np.abs(o.standardized).max()) for o in adjustment.other_residuals)
    assert f"{worst:.2f}" in lines[lines.index("  largest standardized residuals") + 1]
    assert lines[-1] == "  solve 1.50 s"
    axes = [float(line.split()[-2]) for line in lines[-5:-2]]
    assert axes == sorted(axes, reverse=True)


def test_all_observations_are_in_the_page_with_what_was_observed(page: str, adjustment: Adjustment) -> None:
    holder = re.search(r'id="all-data">(.*?)</script>', page, re.S)
    assert holder is not None
    data = json.loads(holder[1])
    n = 2 * len(adjustment.image_residuals.test) + sum(len(o.components) for o in adjustment.other_residuals)
    assert data["rows"] == n
    columns = [c["values"] if "values" in c else [c["names"][k] for k in c["codes"]] for c in data["columns"]]
    assert {len(c) for c in columns} == {n}
    by_name = dict(zip(every_observation.COLUMNS, columns, strict=True))
    kind, where, point, component = (by_name[name] for name in ("Kind", "Where", "Point", "Component"))
    observed, sigma, adjusted, residual = (by_name[name] for name in ("Observed", "σ", "Adjusted", "Residual"))
    block = adjustment.survey.image_blocks[5]
    k = int(adjustment.image_residuals.block_ptr[5])
    text = f"{block.camera_id} · {block.epoch_id} · {block.target_id or 'points'}"
    name = adjustment.survey.targets[0].point_ids[int(block.point_idx[0])] if block.target_id == "board" else None
    row = next(
        i for i in range(n)
        if where[i] == text and component[i] == "v" and (name is None or point[i] == name)
        and abs(observed[i] - block.uv[0, 1]) < 0.01
    )  # fmt: skip
    assert kind[row] == "image point"
    assert residual[row] == pytest.approx(adjustment.image_residuals.residuals[k, 1], abs=1e-3)
    assert adjusted[row] == pytest.approx(observed[row] + residual[row], abs=2e-3)
    assert sigma[row] == pytest.approx(np.sqrt(block.cov[0, 1, 1]), abs=1e-3)


def test_german_page_says_the_same_numbers(adjustment: Adjustment, page: str) -> None:
    german = report_html(adjustment, RUN, in_language="de")
    words = " ".join(parsed(german).words)
    assert "Ausgleichungsbericht" in words
    assert "Beobachtungsgruppen" in words
    assert f"{adjustment.sigma0:.3f}".replace(".", ",") in words
    figures = re.findall(r'<td class="r">([−\d.]+)</td>', page)
    comma = re.findall(r'<td class="r">([−\d,]+)</td>', german)
    assert [x.replace(",", ".") for x in comma] == figures
    with pytest.raises(SurveyError, match="language 'fr'"):
        report_html(adjustment, RUN, in_language="fr")


def test_the_largest_are_those_of_a_whole_sorting() -> None:
    """Equal values in their order, what is no number last, whatever the number that is wanted."""
    values = np.random.default_rng(3).integers(-9, 10, 500).astype(float)
    values[[7, 80, 200]] = np.nan
    order = sorted(range(len(values)), key=lambda k: -abs(values[k]) if np.isfinite(values[k]) else 1.0)
    for most in (1, 20, 250, 499, 500, 900):
        assert worst(values, most).tolist() == order[:most]
    assert worst(np.empty(0), 5).tolist() == []


@pytest.mark.slow
def test_the_page_grows_no_further_with_the_observations() -> None:
    small, large = (lab_adjustment(Lab(n_epochs=n, n_beacons=60)) for n in (150, 600))
    assert 2 * len(small.image_residuals.test) > every_observation.MOST
    pages = [report_html(made, RUN) for made in (small, large)]
    assert len(pages[1]) < 1.1 * len(pages[0]) < 3e6
    n = markup.count(2 * len(large.image_residuals.test) + sum(len(o.components) for o in large.other_residuals))
    assert f"The worst 20\u2009000 of {n}; all in residuals.csv and residuals_other.csv." in pages[1]


def test_rows_shown_are_the_same_with_and_without_the_others(adjustment: Adjustment, page: str) -> None:
    """The worst rows of a page that is cut are the first of the one that is not."""
    whole = json.loads(re.search(r'id="all-data">(.*?)</script>', page, re.S)[1])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(every_observation, "MOST", 40)
        cut = report_html(adjustment, RUN)
    part = json.loads(re.search(r'id="all-data">(.*?)</script>', cut, re.S)[1])
    assert part["rows"] == 40
    assert part["flags"] == whole["flags"][:40]
    for a, b in zip(part["columns"], whole["columns"], strict=True):
        if "codes" in a:
            assert [a["names"][k] for k in a["codes"]] == [b["names"][k] for k in b["codes"][:40]]
        else:
            assert a["values"] == b["values"][:40]


def test_of_very_many_cameras_and_images_the_page_says_what_it_leaves_out(
    adjustment: Adjustment, monkeypatch: pytest.MonkeyPatch
) -> None:
    images = {f"X/e{i}": DetectedImage(f"images/X/e{i}.png", "ab", 1, 1, 1, n_image_points=3) for i in range(510)}
    monkeypatch.setattr(unknowns, "_MOST_CAMERAS", 1)
    page = report_html(adjustment, replace(RUN, images=images))
    rms = {k: e["rms_residual_px"] for k, e in solution_dict(adjustment, RUN)["cameras"].items()}
    largest = max(rms, key=lambda k: rms[k])
    assert re.findall("<h3>Camera (.)</h3>", page) == [largest]
    words = " ".join(parsed(page).words)
    assert "2 more cameras, with smaller residuals; their lenses and poses in solution.json" in words
    assert all(f"{value:.3f}" in words for value in rms.values())
    assert "510 images" in words
    assert "images/X/e499.png" in words
    assert "images/X/e500.png" not in words
    assert "10 more in solution.json." in words


def test_what_tables_of_statistics_leave_out_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    project = read(example("total-station", tmp_path / "lab"))
    adjusted = adjust_project(project, progress=False)
    found = statistics_of(adjusted, project.options, scale_of(adjusted, RUN.sigmas))

    def told() -> dict[str, str]:
        html = report_html(adjusted, RUN, None, found)
        return {name: text for text, name in re.findall(r'(<section id="(\w+)".*?</section>)', html, re.S)}

    whole = told()
    for limit in ("_MOST_ROWS", "_MOST_WEAK", "_MOST_DRAWN"):
        monkeypatch.setattr(statistics, limit, 1)
    cut = told()
    influences = len(found.reliability.influences)
    for name, every in (("reliability", influences), ("relative", len(found.relative)), ("budget", len(found.budget))):
        assert f" {every - 1} more in solution.json." in cut[name]
        assert (f" {influences - 30} more in solution.json." in whole[name]) == (name == "reliability")
    assert re.search("The first 1 of [2-9] groups are drawn", cut["normality"])
    assert "groups are drawn" not in whole["normality"]
