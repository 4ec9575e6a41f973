"""Batches: records, the cache, the journal, workers that die, control charts, the overview in both languages."""

import csv
import io
import json
import os
import re
import shutil
import signal
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats

from adjust.model.errors import IndeterminateError, SurveyError
from survey.batch.cache import unchanged_solution
from survey.batch.control import Series, chart, runs
from survey.batch.journal import Journal, read_journal
from survey.batch.page import overview_html, write_overview
from survey.batch.record import CAUSES, FAILED, KEPT, Record, cause_of, record_from, solved_record
from survey.batch.run import BatchOptions, run_batch
from survey.batch.tables import folders_csv, overview_json, short_names, summary_table, trend_lines, trends_csv
from survey.batch.trends import all_series, trends_of
from survey.batch.worker import Worker, WorkerDiedError, adjust_task, attempts
from tests.browsing import CONTRAST, asked
from tests.survey.epochs import write_epochs

DRIFT_PX = 5.0
N = 7


@pytest.fixture(scope="module")
def nights(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Seven nights; the principal point of the left camera wanders; the third and the fifth are broken."""
    return write_epochs(tmp_path_factory.mktemp("nights"), N, drift_px=DRIFT_PX)


@pytest.fixture(scope="module")
def records(nights: list[Path]) -> tuple[Record, ...]:
    return tuple(adjust_task({"folder": str(f), "path": str(f), "redetect": False}) for f in nights)


def series(values: np.ndarray, sigma: float | np.ndarray = 1.0, name: str = "x", freedom: float = np.inf) -> Series:
    n = len(values)
    sigmas = np.broadcast_to(sigma, n).astype(float)
    return Series(name, "mm", np.arange(n), np.asarray(values, float), sigmas, np.full(n, freedom))


@pytest.mark.slow
def test_sigmas_from_few_observations_raise_no_more_alarms_than_known_ones() -> None:
    """Sigmas scaled by a sigma0 with ten degrees of freedom each; taken as known, noise leaves the limits too often."""
    rng, freedom, n, trials = np.random.default_rng(4), 10.0, 8, 1500
    found = {f: np.zeros(3) for f in (freedom, np.inf)}
    for _ in range(trials):
        sigma = np.sqrt(rng.chisquare(freedom, n) / freedom)
        values = rng.normal(size=n)
        for f, counts in found.items():
            c = chart(series(values, sigma, freedom=f))
            counts += [c.p < 0.01, c.p_slope < 0.01, np.abs(c.deviation).max() > 3.5]
    expected = trials * np.array([0.01, 0.01, n * 4.65e-4])
    assert (found[np.inf][[0, 2]] > 4.0 * expected[[0, 2]]).all()
    assert (found[freedom] < 2.5 * expected + 5.0).all(), found


@pytest.mark.slow
def test_broken_folders_are_failures_with_a_reason(records: tuple[Record, ...]) -> None:
    assert [r.state == FAILED for r in records] == [False, False, True, False, True, False, False]
    assert records[2].cause == "files"
    assert "image_points.csv:8: u_px: found '6x1.2'" in records[2].error
    assert records[4].cause == "survey"
    assert "nothing to adjust" in records[4].error


def test_a_record_holds_what_the_solution_says(records: tuple[Record, ...], nights: list[Path]) -> None:
    solution = json.loads((nights[0] / "results" / "solution.json").read_text())
    lens, pose = solution["cameras"]["left"]["lens"], solution["cameras"]["right"]["station_from_camera"]
    numbers = {n.name: n for n in records[0].numbers}
    assert numbers["lens/left/fx"].value == lens["fx_px"]
    assert numbers["lens/left/k1"].sigma == lens["sigma_k1"]
    assert "lens/left/k3" not in numbers  # held
    assert "station_from_camera/left/x" not in numbers  # held
    assert numbers["station_from_camera/right/x"].value == pose["translation_mm"][0]
    assert records[0].turns[0].sigmas_arcsec == tuple(pose["sigma_rotation_arcsec"])
    assert record_from(json.loads(json.dumps(records[0].plain()))) == records[0]


def test_results_are_taken_over_only_while_nothing_changes(nights: list[Path], tmp_path: Path) -> None:
    folder = tmp_path / "night"
    shutil.copytree(nights[0], folder)
    table, solution = folder / "observations" / "image_points.csv", folder / "results" / "solution.json"
    found, written = unchanged_solution(folder), json.loads(solution.read_text())
    assert found is not None
    assert found == {name: written[name] for name in ("inputs", *KEPT) if name in written}
    assert solved_record("", found, {}) == solved_record("", written, {})
    whole = table.read_bytes()
    table.write_bytes(whole.rstrip(b"\n") + b" \n")
    assert unchanged_solution(folder) is None
    table.write_bytes(whole)
    assert unchanged_solution(folder) is not None
    (folder / "observations" / "distances.csv").write_text("distance_id,from_id,to_id,value_mm,sigma_mm\n")
    assert unchanged_solution(folder) is None
    (folder / "observations" / "distances.csv").unlink()
    (folder / "results" / "covariance.npz").rename(folder / "results" / "elsewhere.npz")
    assert unchanged_solution(folder) is None
    (folder / "results" / "elsewhere.npz").rename(folder / "results" / "covariance.npz")
    text = solution.read_text()
    solution.write_text(re.sub(r'("numpy": ")[^"]*', r"\g<1>1.0", text))
    assert unchanged_solution(folder) is None
    solution.write_text(text[:200])
    assert unchanged_solution(folder) is None


@pytest.mark.slow
def test_a_second_run_adjusts_nothing_and_fresh_adjusts_all(nights: list[Path], records: tuple[Record, ...]) -> None:
    before = (nights[0] / "results" / "solution.json").stat().st_mtime_ns
    again = run_batch(nights[:2], BatchOptions(progress=False))
    assert [r.origin for r in again] == ["unchanged", "unchanged"]
    assert (nights[0] / "results" / "solution.json").stat().st_mtime_ns == before
    assert again[0].numbers == records[0].numbers
    fresh = run_batch(nights[:1], BatchOptions(progress=False, fresh=True))
    assert fresh[0].origin == "adjusted"
    assert (nights[0] / "results" / "solution.json").stat().st_mtime_ns > before
    assert fresh[0].numbers == records[0].numbers  # another process, the same bits


def test_a_journal_cut_off_by_a_kill_loses_one_line(tmp_path: Path) -> None:
    with Journal(tmp_path, []) as journal:
        for name in "abc":
            journal.add(Path("/x") / name, f"print of {name}", Record(name, FAILED, cause="files", error="why"))
    path = tmp_path / "journal.jsonl"
    path.write_bytes(path.read_bytes()[:-30])
    found = read_journal(tmp_path)
    assert list(found) == ["/x/a", "/x/b"]
    assert found["/x/a"][0] == "print of a"
    assert found["/x/b"][1].error == "why"


@pytest.mark.slow
def test_resume_takes_failures_over_until_their_inputs_change(nights: list[Path], tmp_path: Path) -> None:
    folders = [nights[2], nights[4]]
    first = run_batch(folders, BatchOptions(report=tmp_path, progress=False, jobs=1))
    assert [r.origin for r in first] == ["adjusted", "adjusted"]
    second = run_batch(folders, BatchOptions(report=tmp_path, progress=False, resume=True))
    assert [r.origin for r in second] == ["resumed", "resumed"]
    assert [r.error for r in second] == [r.error for r in first]
    table = nights[2] / "observations" / "image_points.csv"
    broken = table.read_text()
    table.write_text(broken.replace("6x1.2", "7x1.2"))
    try:
        third = run_batch(folders, BatchOptions(report=tmp_path, progress=False, resume=True, jobs=1))
    finally:
        table.write_text(broken)
    assert [r.origin for r in third] == ["adjusted", "resumed"]
    assert "7x1.2" in third[0].error


@pytest.mark.slow
def test_a_worker_that_is_killed_is_tried_again(nights: list[Path]) -> None:
    worker = Worker()
    task = {"folder": "n", "path": str(nights[2]), "redetect": False}
    try:
        assert worker.run(task).cause == "files"
        first = worker.pid
        os.kill(int(first or 0), signal.SIGKILL)
        found = attempts(worker, task, retries=1)
        assert (found.tries, found.cause) == (2, "files")
        assert worker.pid not in (None, first)
        os.kill(int(worker.pid or 0), signal.SIGKILL)
        lost = attempts(worker, task, retries=0)
        assert (lost.tries, lost.cause, lost.state) == (1, "process", FAILED)
        assert "SIGKILL" in lost.error
    finally:
        worker.stop()
    with pytest.raises(WorkerDiedError, match="stopped"):
        worker.run(task)


@pytest.mark.slow
def test_a_worker_ends_when_its_owner_is_gone() -> None:
    worker = Worker()
    try:
        assert worker.run({"folder": "n", "path": "/nowhere", "redetect": False}).cause == "project"  # it has started
        process = worker._running()
        assert process.stdin is not None
        process.stdin.close()
        assert process.wait(timeout=20) == 0
    finally:
        worker.stop()


def test_stopping_ends_a_run_that_waits(nights: list[Path]) -> None:
    worker, ended = Worker(), []

    def run() -> None:
        try:
            worker.run({"folder": "n", "path": str(nights[1]), "redetect": False})
        except WorkerDiedError:
            ended.append(True)

    thread = threading.Thread(target=run)
    thread.start()
    while worker.pid is None:
        time.sleep(0.01)
    worker.stop()
    thread.join(timeout=20)
    assert ended == [True]


@pytest.mark.parametrize(
    ("error", "cause"),
    [
        (IndeterminateError("x"), "undetermined"),
        (SurveyError("/a/survey.toml:3: no such key; did you mean y?"), "files"),
        (SurveyError("/a: no such folder"), "project"),
        (SurveyError("no start values; see survey.toml"), "survey"),
        (PermissionError(13, "denied", "/a"), "access"),
        (MemoryError(), "memory"),
        (ZeroDivisionError(), "internal"),
    ],
)
def test_failures_have_kinds(error: Exception, cause: str) -> None:
    assert cause_of(error) == cause
    assert cause in CAUSES


def test_a_bug_keeps_its_traceback_and_costs_one_folder(nights: list[Path], monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object, **__: object) -> None:
        raise ZeroDivisionError("oops")

    monkeypatch.setattr("survey.jobs.adjusting.job.adjust_job", broken)
    found = adjust_task({"folder": "n", "path": str(nights[0]), "redetect": False})
    assert (found.state, found.cause) == (FAILED, "internal")
    assert "ZeroDivisionError: oops" in found.error
    assert "Traceback" in found.traceback


def test_mean_slope_and_agreement_are_those_of_weighted_least_squares() -> None:
    rng = np.random.default_rng(5)
    sigma = rng.uniform(0.5, 2.0, 20)
    x = 7.0 + 0.02 * np.arange(20) + sigma * rng.normal(size=20)
    c = chart(series(x, sigma))
    assert c.used.all()
    line, cov = np.polyfit(np.arange(20), x, 1, w=1.0 / sigma, cov="unscaled")
    assert (c.slope, c.slope_sigma) == pytest.approx((line[0], np.sqrt(cov[0, 0])), rel=1e-9)
    mean, var = np.polyfit(np.arange(20), x, 0, w=1.0 / sigma, cov="unscaled")
    assert (c.mean, c.mean_sigma) == pytest.approx((mean[0], np.sqrt(var[0, 0])), rel=1e-9)
    squares = np.sum(((x - mean[0]) / sigma) ** 2)
    assert c.p == pytest.approx(stats.chi2.sf(squares, 19), rel=1e-9)
    assert c.p_slope == pytest.approx(2 * stats.norm.sf(abs(line[0]) / np.sqrt(cov[0, 0])), rel=1e-9)


def test_limits_hold_what_they_promise() -> None:
    """3 sigmas, both ways: 0.27 % of normal numbers lie outside; sigmas from the median moving range are unbiased."""
    rng = np.random.default_rng(11)
    outside, scatter, n = 0, [], 60
    for _ in range(200):
        c = chart(series(rng.normal(3.0, 2.0, n), 2.0))
        outside += int(np.count_nonzero(c.outside))
        scatter.append(c.by_scatter / 3.0)
    expected = 200 * n * 0.0027
    # phase I takes out what is outside, which leaves it outside: no more than chance makes
    assert abs(outside - expected) < 4 * np.sqrt(expected)
    assert np.mean(scatter) == pytest.approx(2.0, rel=0.03)


def test_gross_epochs_neither_hide_nor_hide_each_other() -> None:
    x = np.random.default_rng(2).normal(size=30)
    x[[7, 8]] = 40.0, 42.0
    c = chart(series(x))
    assert np.flatnonzero(c.outside).tolist() == [7, 8]
    assert c.outside_scatter[[7, 8]].all()
    assert np.count_nonzero(c.outside_scatter) <= 3  # limits from a scatter that is estimated itself
    assert abs(c.mean) < 4 / np.sqrt(28)
    assert c.p < 1e-100


def test_runs_are_nelsons() -> None:
    up = np.array([0.1, -0.2, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 0.0])
    assert [(r.kind, r.first, r.last) for r in runs(up, 2.0)] == [("rising", 1, 7)]
    side = np.array([-1.0, 1.0, 2.0, 1.0, 2.0, 1.0, 2.0, 1.0, 2.0, 1.0, -1.0])
    assert [(r.kind, r.first, r.last) for r in runs(side, 0.0)] == [("one_side", 1, 9)]
    assert runs(side[:9], 0.0) == ()
    assert [(r.kind, r.first, r.last) for r in runs(-up[2:8], 0.0)] == [("falling", 0, 5)]


def test_trends_are_calm_on_noise_and_find_one_bad_epoch() -> None:
    """All tests together err in at most 5 % of batches where nothing happens, and one bad number is found by name."""
    rng = np.random.default_rng(3)
    names = [f"lens/left/{c}" for c in "abcdefgh"]

    def made(shift: float) -> tuple[Record, ...]:
        from survey.batch.record import Number

        return tuple(
            Record(f"n{i}", "done", summary={}, numbers=tuple(
                Number(n, "px", rng.normal() + shift * (i == 9 and n.endswith("c")), 1.0) for n in names))
            for i in range(25)
        )  # fmt: skip

    false = sum(any(map((t := trends_of(made(0.0))).is_alarming, t.charts)) for _ in range(60))
    assert false <= stats.binom.isf(1e-4, 60, 0.15)  # three families of tests at 5 % each
    found = trends_of(made(7.0))
    assert found.charts[0].series.name == "lens/left/c"
    assert found.strays(found.charts[0])


def test_text_and_page_name_the_same_epochs() -> None:
    """Epochs that scatter by more than they claim: those outside of their own sigmas, drawn red, are named in both."""
    from survey.batch.record import Number

    rng = np.random.default_rng(5)
    made = tuple(Record(f"n{i:02d}", "done", summary={}, numbers=(Number("point/P/x", "mm", x, 1.0),))
                 for i, x in enumerate(rng.normal(0.0, 2.5, 14)))  # fmt: skip
    found = trends_of(made)
    (c,) = found.charts
    outside = [f"n{i:02d}" for i in np.flatnonzero(c.outside)]
    assert len(outside) >= 2
    assert not c.outside_scatter[c.outside].all()
    (line,) = trend_lines(found, made)[1:]
    page = overview_html(made, found, Path("."))
    row = page[page.index("outside:") :].split("</td>")[0]
    assert re.findall(r"n\d\d", line[line.index("outside:") :].split(";")[0]) == outside[:5]
    assert re.findall(r"n\d\d", row) == outside[:5]


def test_the_drift_of_the_principal_point_is_found_in_the_right_place(records: tuple[Record, ...]) -> None:
    found = trends_of(records)
    first = found.charts[0]
    assert first.series.name == "lens/left/u0"
    assert found.drifts(first)
    assert abs(first.slope - DRIFT_PX) < 4 * first.slope_sigma
    right = next(c for c in found.charts if c.series.name == "lens/right/u0")
    assert not found.is_alarming(right)
    assert first.series.epoch.tolist() == [0, 1, 3, 5, 6]


def test_rotations_are_vectors_against_the_first_epoch(records: tuple[Record, ...]) -> None:
    about = {s.name: s for s in all_series(records)}
    turn = about["station_from_camera/right/rz"]
    assert turn.value[0] == 0.0
    a, b = (np.array(records[i].turns[0].wxyz) for i in (0, 1))
    # the small angle between two quaternions: 2 acos(|a . b|)
    angle = 2.0 * np.degrees(np.arccos(min(abs(a @ b), 1.0))) * 3600.0
    vector = [about[f"station_from_camera/right/r{axis}"].value[1] for axis in "xyz"]
    assert np.linalg.norm(vector) == pytest.approx(angle, rel=1e-3)


def test_the_overview_is_written_in_all_forms(records: tuple[Record, ...], nights: list[Path], tmp_path: Path) -> None:
    place = tmp_path / "over view"
    paths = write_overview(place, records, trends_of(records))
    assert {p.name for p in place.iterdir()} == set(paths)
    value = json.loads(paths["overview.json"].read_text())
    assert value["counts"] == {"folders": N, "done": 5, "test_failed": 0, "failed": 2, "not_adjusted_again": 0}
    assert value["trends"]["charts"]["lens/left/u0"]["in_control"] is False
    rows = list(csv.DictReader(io.StringIO(paths["folders.csv"].read_text())))
    assert [r["state"] for r in rows].count("failed") == 2
    assert rows[2]["message"] == records[2].error
    numbers = [r for r in csv.DictReader(io.StringIO(paths["trends.csv"].read_text())) if r["name"] == "lens/left/u0"]
    assert [r["folder"] for r in numbers] == [str(nights[i]) for i in (0, 1, 3, 5, 6)]
    page = paths["overview.html"].read_text()
    links = re.findall(r'href="([^"#][^"]*)"', page)
    assert len(links) == 5
    assert all((place / link).resolve().is_file() for link in links)
    assert "u_px: found &#39;6x1.2&#39;" in page


def test_the_german_overview(records: tuple[Record, ...], tmp_path: Path) -> None:
    german = overview_html(records, trends_of(records), tmp_path, in_language="de")
    assert 'lang="de"' in german
    assert "Regelkarten" in german
    with pytest.raises(SurveyError, match="language"):
        overview_html(records, trends_of(records), tmp_path, in_language="xx")


def test_nothing_from_folders_becomes_markup(records: tuple[Record, ...], tmp_path: Path) -> None:
    evil = "<script>alert(1)</script>"
    bad = replace(records[2], folder=evil, error=evil)
    named = [replace(n, name=f"point/{evil}/x") for n in records[0].numbers[:1]]
    good = tuple(replace(r, folder=f"{evil}{i}", numbers=tuple(named)) for i, r in enumerate(records[:2]))
    page = overview_html((bad, *good), trends_of((bad, *good)), tmp_path)
    assert "<script" not in page


def test_tables_for_people_and_machines(records: tuple[Record, ...]) -> None:
    text = summary_table(records)
    assert text.endswith("7 folders: 5 done, 2 failed")
    assert text.count("error in the project's files") == 1
    assert short_names([Record(f"/a/b/c{i}/d", "done") for i in (1, 2)]) == ["c1/d", "c2/d"]
    assert short_names([Record("x", "done")]) == ["x"]
    json.loads(overview_json(records[2:3], trends_of(records[2:3])))  # nothing but a failure
    assert folders_csv(records[2:3]).count("\n") == 2
    assert trends_csv(records[2:3], trends_of(records[2:3])).count("\n") == 1


def test_a_folder_named_twice_is_refused(nights: list[Path]) -> None:
    with pytest.raises(SurveyError, match="named twice"):
        run_batch([nights[0], nights[0] / ".." / nights[0].name], BatchOptions(progress=False))


@pytest.mark.slow
def test_no_scheduler_is_said_at_once(nights: list[Path], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("survey.batch.cluster._WAIT_SECONDS", 1)
    with pytest.raises(SurveyError, match="no Dask scheduler at 'nonsense://x'"):
        run_batch(nights[:1], BatchOptions(scheduler="nonsense://x", fresh=True, progress=False))


@pytest.mark.slow
@pytest.mark.parametrize(("width", "dark"), [(390, False), (1280, True)])
def test_reasons_are_on_the_screen(
    browser: Any, records: tuple[Record, ...], tmp_path: Path, width: int, dark: bool
) -> None:
    """Also on a phone; every word can be read on a dark screen too."""
    page = write_overview(tmp_path / "o", records, trends_of(records))["overview.html"].read_text(encoding="utf-8")
    measure = """[document.documentElement.scrollWidth,
      Math.max(...[...document.querySelectorAll("#failures .words, #folders .words")]
        .map((e) => e.getBoundingClientRect().right))]"""
    (page_width, reasons), (ratio, words) = asked(
        browser, page, tmp_path, measure, CONTRAST, width=width, dark=dark, ready="document.readyState === 'complete'"
    )
    assert page_width <= width
    assert reasons <= width
    assert ratio >= 4.5, words
