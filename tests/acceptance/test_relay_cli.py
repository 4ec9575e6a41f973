"""Relay networks through the command line: planning, adjusting, adding, and what goes wrong on the way."""

import csv
import json
import re
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from survey.cli import main

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def example(tmp_path_factory):
    folder = tmp_path_factory.mktemp("relay") / "lab"
    assert main(["example", "relay", str(folder), "--quiet"]) == 0
    assert main(["adjust", str(folder), "--quiet"]) == 0
    return folder


@pytest.fixture
def lab(example, tmp_path):
    """An adjusted copy of the example."""
    return Path(shutil.copytree(example, tmp_path / "lab"))


def _json(capsys, *arguments, code=0):
    capsys.readouterr()
    assert main([*map(str, arguments), "--json", "--quiet"]) == code
    return json.loads(capsys.readouterr().out)


def _solution(folder):
    return json.loads((folder / "results" / "solution.json").read_text())


def _rows(folder):
    with (folder / "observations" / "pairs.csv").open(newline="") as stream:
        return list(csv.DictReader(stream))


def _write(folder, rows):
    with (folder / "observations" / "pairs.csv").open("w", newline="") as stream:
        writer = csv.DictWriter(stream, rows[0], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def _turned(row, degrees):
    """The row with its rotation turned about z by some degrees."""
    w, x, y, z = (float(row[k]) for k in ("qw", "qx", "qy", "qz"))
    x, y, z, w = (Rotation.from_quat([x, y, z, w]) * Rotation.from_euler("z", degrees, degrees=True)).as_quat()
    return row | {"qw": w, "qx": x, "qy": y, "qz": z}


def _files(folder):
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def test_the_example_agrees_with_its_truth(example):
    solution = _solution(example)
    truth = json.loads((example / "truth.json").read_text())["parameters"]
    d = []
    for station, entry in solution["stations"].items():
        pose, true = entry["world_from_station"], truth[f"world_from_station/{station}"]
        if station != "K01":
            sigma = np.array(pose["sigma_translation_mm"])
            d.append((np.array(pose["translation_mm"]) - true["translation_mm"]) / sigma)
    # 87 correlated components: their mean square is 1 within a factor of some
    assert 0.3 < np.mean(np.square(d)) < 3.0
    assert solution["summary"]["verdict"] == "passed"


def test_counts_are_those_of_the_theorem(lab, capsys):
    n = _json(capsys, "plan", lab)["network"]
    # 59 pairs, 30 stations in one part: 59 - 29 independent conditions of six equations
    assert (n["n_stations"], n["n_parts"], n["independent_unknown_poses"]) == (30, 1, 29)
    assert (n["measured_pairs"], n["measurable_pairs"]) == (59, 435)
    assert (n["independent_conditions"], n["redundancy"]) == (30, 180)
    assert n["uncontrolled_pairs"] == []
    assert n == _solution(lab)["network"]
    assert _solution(lab)["summary"]["redundancy"] == 180


def test_plan_needs_no_values(lab, capsys):
    before = _json(capsys, "plan", lab)
    rows = [{k: row[k] for k in ("pair_id", "a_id", "b_id")} for row in _rows(lab)]
    _write(lab, rows)
    assert _json(capsys, "plan", lab) == before
    _write(lab, [row for row in rows if row["pair_id"] not in ("K09-K10", "A1-A2")])
    found = _json(capsys, "plan", lab)
    assert found["network"]["uncontrolled_pairs"] == ["K08-K10"]
    assert found["network"]["redundancy"] == 168
    assert "K08-K10" in found["problems"][0]
    assert main(["plan", str(lab)]) == 0
    assert "! close no loop, so that nobody would notice an error in them: K08-K10" in capsys.readouterr().out


def test_plan_names_unknown_stations_with_their_line(lab, capsys):
    rows = _rows(lab)
    rows[4]["b_id"] = "K66"
    _write(lab, rows)
    assert main(["plan", str(lab)]) == 1
    assert f"{lab}/observations/pairs.csv:6: a_id, b_id: 'K66': unknown station" in capsys.readouterr().err


def test_plan_without_pairs_says_what_to_write(lab, capsys):
    (lab / "observations" / "pairs.csv").unlink()
    assert main(["plan", str(lab)]) == 1
    assert "pair_id,a_id,b_id" in capsys.readouterr().err


def test_a_wrong_pair_is_found_named_and_left_out(lab, capsys):
    clean = _solution(lab)["stations"]["C4"]["world_from_station"]
    _write(lab, [_turned(row, 1.0) if row["pair_id"] == "B1-B3" else row for row in _rows(lab)])
    found = _json(capsys, "adjust", lab)
    assert len(found["warnings"]) == 1
    said = re.match(r"left out: pair B1-B3: off by (\S+) deg", found["warnings"][0])
    assert float(said[1]) == pytest.approx(1.0, abs=0.01)
    solution = _solution(lab)
    assert [p for p, e in solution["pairs"].items() if not e["used"]] == ["B1-B3"]
    pair = solution["pairs"]["B1-B3"]
    assert pair["misfit_arcsec"] == pytest.approx(3600.0, abs=60.0)
    assert pair["p_value"] < 1e-12
    worst = solution["loops"]["worst_first"][0]
    assert "B1-B3" in worst["pairs"]
    assert worst["pairs_not_used"] == ["B1-B3"]
    assert not worst["closes"]
    # far from the error nothing has changed by more than a sigma
    after = solution["stations"]["C4"]["world_from_station"]
    moved = np.subtract(after["translation_mm"], clean["translation_mm"])
    assert np.abs(moved).max() < min(clean["sigma_translation_mm"])
    page = (lab / "results" / "report.html").read_text()
    assert "left out: pair B1-B3" in page
    assert 'id="loops"' in page


def test_rejection_can_be_switched_off(lab, capsys):
    _write(lab, [_turned(row, 1.0) if row["pair_id"] == "B1-B3" else row for row in _rows(lab)])
    text = (lab / "survey.toml").read_text()
    (lab / "survey.toml").write_text(text + "\n[adjustment]\nreject_pairs = false\n")
    found = _json(capsys, "adjust", lab, code=3)
    assert found["summary"]["verdict"] == "failed"
    solution = _solution(lab)
    assert all(e["used"] for e in solution["pairs"].values())
    tests = {p: e["test"] for p, e in solution["pairs"].items()}
    assert max(tests, key=tests.get) == "B1-B3"


def test_a_pair_without_a_loop_is_named_as_uncontrolled(lab, capsys):
    _write(lab, [row for row in _rows(lab) if row["pair_id"] != "K09-K10"])
    found = _json(capsys, "adjust", lab)
    assert found["warnings"] == [
        "pair K08-K10 closes no loop: nobody would notice an error in it; measure a second way to what it leads to"
    ]
    pair = _solution(lab)["pairs"]["K08-K10"]
    assert not pair["controlled"]
    assert pair["p_value"] is None
    assert max(pair["redundancy"]) < 1e-6


def test_a_part_that_hangs_on_nothing_is_an_error_that_names_it(lab, capsys):
    _write(lab, [row for row in _rows(lab) if not {row["a_id"], row["b_id"]} & {"K10"}])
    assert main(["adjust", str(lab), "--quiet"]) == 1
    assert "no measured pair ties K10 to the datum" in capsys.readouterr().err
    apart = [row for row in _rows(lab) if (row["a_id"][0] == "D") == (row["b_id"][0] == "D")]
    _write(lab, [row for row in apart if row["a_id"] != "K10" and row["b_id"] != "K10"])
    assert main(["adjust", str(lab), "--quiet"]) == 1
    assert "K10" in capsys.readouterr().err
    _write(lab, [*apart, _rows(lab)[0] | {"pair_id": "again", "a_id": "K09", "b_id": "K10"}])
    assert main(["adjust", str(lab), "--quiet"]) == 1
    assert "no measured pair ties D1, D2, D3, D5, D4 to the datum" in capsys.readouterr().err


def test_a_covariance_that_is_none_is_an_error_with_its_line(lab, capsys):
    rows = _rows(lab)
    rows[4]["cov_rx_ry_rad2"] = "1"
    _write(lab, rows)
    assert main(["adjust", str(lab), "--quiet"]) == 1
    assert f"{lab}/observations/pairs.csv:6: the covariance is not positive definite" in capsys.readouterr().err


def _compare(a, b, path=""):
    """All numbers of two solutions; values, sigmas and residuals agree to what the iterations leave over."""
    if isinstance(a, dict):
        assert a.keys() == b.keys(), path
        for key in a:
            if key not in ("inputs", "iterations", "last_step_sigmas"):
                _compare(a[key], b[key], f"{path}/{key}")
    elif isinstance(a, list):
        assert len(a) == len(b), path
        for i, (x, y) in enumerate(zip(a, b, strict=True)):
            _compare(x, y, f"{path}/{i}")
    elif isinstance(a, float) and isinstance(b, float):
        assert a == pytest.approx(b, rel=1e-6, abs=1e-6), path
    else:
        assert a == b, path


def test_what_was_added_equals_adjusting_everything_at_once(lab, tmp_path, capsys):
    before = _files(lab)
    found = _json(capsys, "add", lab, lab / "more", "--out", tmp_path / "grown")
    assert _files(lab) == before
    grown = _solution(tmp_path / "grown")
    assert main(["adjust", str(tmp_path / "grown"), "--quiet"]) == 0
    _compare(grown, _solution(tmp_path / "grown"))
    assert found["added"] == {"stations": ["E1", "E2", "E3"], "pairs": 6}
    assert (found["redundancy_before"], found["redundancy_after"]) == (180, 198)
    assert found["start"] == "from the previous solution"
    moved = {m["name"]: m for m in found["moved"]}
    assert len(moved) == 29
    poses = [_solution(f)["stations"]["K10"]["world_from_station"] for f in (lab, tmp_path / "grown")]
    old, new = (pose["translation_mm"] for pose in poses)
    assert moved["K10"]["moved_mm"] == pytest.approx(np.linalg.norm(np.subtract(new, old)), rel=1e-3)
    assert 0.0 < found["moved"][0]["moved_sigmas"] < 3.0
    # in place the same comes out, and the old tables are part of the new ones
    capsys.readouterr()
    assert main(["add", str(lab), str(lab / "more"), "--quiet"]) == 0
    assert "added: stations E1, E2, E3; pairs 6\nredundancy 180 -> 198" in capsys.readouterr().out
    _compare(_solution(lab), grown)
    assert {p.name for p in lab.iterdir()} == {"survey.toml", "observations", "results", "runs", "more", "truth.json"}
    assert (lab / "survey.toml").read_text().startswith(before["survey.toml"].decode())
    assert len(_rows(lab)) == 65


def test_adding_a_wrong_pair_leaves_it_out_as_adjusting_would(lab, tmp_path, capsys):
    more = lab / "more"
    _write(more, [_turned(row, 0.5) if row["pair_id"] == "C2-E3" else row for row in _rows(more)])
    found = _json(capsys, "add", lab, more, "--out", tmp_path / "grown")
    assert any(w.startswith("left out: pair C2-E3") for w in found["warnings"])
    grown = _solution(tmp_path / "grown")
    assert main(["adjust", str(tmp_path / "grown"), "--quiet"]) == 0
    _compare(grown, _solution(tmp_path / "grown"))


def test_a_free_network_grows_too(lab, tmp_path, capsys):
    text = (lab / "survey.toml").read_text().replace('world_from_station = { treatment = "held" }', "")
    (lab / "survey.toml").write_text(text + '\n[datum]\nkind = "inner"\n')
    assert main(["adjust", str(lab), "--quiet"]) == 0
    found = _json(capsys, "add", lab, lab / "more", "--out", tmp_path / "grown")
    grown = _solution(tmp_path / "grown")
    assert main(["adjust", str(tmp_path / "grown"), "--quiet"]) == 0
    _compare(grown, _solution(tmp_path / "grown"))
    assert found["start"] == "from the beginning"
    # the datum of the new network is another one; what counts is how the shape changed
    assert found["moved"][0]["moved_mm"] < 2.0


def test_pairs_are_told_while_they_are_measured(lab, monkeypatch, capsys):
    more, rows = lab / "more", _rows(lab / "more")
    table = more / "observations" / "pairs.csv"
    _write(more, rows)
    head, *lines = table.read_text().splitlines(keepends=True)
    ids = [row["pair_id"] for row in rows]
    turned = _turned(rows[1], 0.5)
    wrong = ",".join(str(turned[name]) for name in head.strip().split(",")).replace(ids[1], "wrong", 1) + "\n"
    floating = ids.index("E2-E3")
    assert ids[:2] == ["K10-E1", "K09-E1"]
    steps = [  # what stands in the table, and how the lines begin that are told of it
        (lines[:1], ["K10-E1: K10 - E1; E1 is placed; v'Pv 0.0 of 6"]),
        ([lines[0], wrong[:90]], []),  # a row that is being written
        ([lines[0], wrong], ["wrong: K09 - E1; v'Pv"]),
        ([lines[0], lines[floating]], ["taken out: wrong", "! E2-E3: no pair with a translation ties E2, E3"]),
        ([lines[0], lines[floating]], []),  # said once
        ([lines[0], "\n", "short,K01\n"], [f"! {table}:4: "]),
        (lines, [f"{name}: " for name in ids[1:]]),
    ]  # fmt: skip
    said, end = list[str](), iter(steps)

    def measure(_: float) -> None:
        said.append(capsys.readouterr().err)
        step = next(end, None)
        if step is None:
            raise KeyboardInterrupt
        table.write_text(head + "".join(step[0]))

    monkeypatch.setattr("survey.commands.networks.time.sleep", measure)
    table.write_text(head)
    assert main(["add", str(lab), str(more), "--live", "--json"]) == 0
    added = json.loads(capsys.readouterr().out)
    assert added["added"] == {"stations": ["E1", "E2", "E3"], "pairs": 6}
    assert said[0] == "30 stations; waiting for pairs, Ctrl-C adds them\n"
    for (_, expected), text in zip(steps, said[1:], strict=True):
        found = text.splitlines()
        assert len(found) == len(expected), text
        for begin in expected:
            assert any(line.startswith(begin) for line in found), (begin, text)
    assert ["DOES NOT FIT" in text for text in said[1:]] == [False, False, True, False, False, False, False]
    assert all("; moved: " in line for line in said[-1].splitlines() if "is placed" not in line)


@pytest.mark.parametrize("fault", ["free network", "no folder", "held", "twice", "world"])
def test_what_cannot_be_told_live_is_said(lab, fault, monkeypatch, capsys):
    def stop(_: float) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("survey.commands.networks.time.sleep", stop)
    more, message = lab / "more", ""
    if fault == "free network":
        text = (lab / "survey.toml").read_text().replace('world_from_station = { treatment = "held" }', "")
        (lab / "survey.toml").write_text(text + '\n[datum]\nkind = "inner"\n')
        assert main(["adjust", str(lab), "--quiet"]) == 0
        message = f"error: {lab}: sessions need a station that is held or has a prior"
    elif fault == "no folder":
        more, message = lab / "none", f"error: {lab / 'none'}: no such folder"
    elif fault == "held":
        held = '[stations.E1]\nworld_from_station = { treatment = "held" }\n[stations.E2]\n[stations.E3]\n'
        (more / "survey.toml").write_text(held)
        message = f"! {more}/survey.toml: stations.E1: is not placed by pairs alone"
    elif fault == "twice":
        (more / "survey.toml").write_text("[stations.E1]\n[stations.E2]\n[stations.E3]\n[stations.K04]\n")
        message = f"! {more}/survey.toml: stations.K04: stands already in {lab}"
    elif fault == "world":
        _write(more, [row | {"a_id": "world"} if row["pair_id"] == "K10-E1" else row for row in _rows(more)])
        message = "! K10-E1: world is no fixed station, as --live needs it; the pair counts once all is added\n"
    before = _files(lab)
    main(["add", str(lab), str(more), "--live"])
    assert message in capsys.readouterr().err
    assert _files(lab) == before or fault in ("held", "world")


def test_a_datum_that_is_not_there_is_no_contradiction(lab, capsys):
    text = (lab / "survey.toml").read_text().replace('world_from_station = { treatment = "held" }', "")
    (lab / "survey.toml").write_text(text)
    assert main(["adjust", str(lab), "--quiet"]) == 1
    said = capsys.readouterr().err
    assert "the datum: no station is held or has a prior" in said
    assert "contradict" not in said


def _faulty(lab, fault):
    more = lab / "more"
    rows = _rows(more)
    if fault == "duplicate pair":
        rows[2]["pair_id"] = "K01-K02"
        message = f"{more}/observations/pairs.csv:4: pair_id: 'K01-K02' stands already in {lab}/observations/"
        message += "pairs.csv:2; give each row its own id"
    elif fault == "unknown station":
        rows[3]["b_id"] = "E9"
        message = f"{more}/observations/pairs.csv:5: a_id, b_id: 'E9': unknown station 'E9'"
    elif fault == "duplicate station":
        (more / "survey.toml").write_text("[stations.E1]\n[stations.E2]\n[stations.E3]\n[stations.K04]\n")
        line = (lab / "survey.toml").read_text().splitlines().index("[stations.K04]") + 1
        message = f"{more}/survey.toml:4: stations.K04: stands already in {lab}/survey.toml:{line}"
    elif fault == "wrong value":
        (more / "survey.toml").write_text('[stations.E1]\n\n[stations.E2]\n[stations.E3]\nmotion = "fix"\n')
        message = f"{more}/survey.toml:5: stations.E3.motion"
    elif fault == "datum":
        (more / "survey.toml").write_text('[stations.E1]\n[stations.E2]\n[stations.E3]\n[datum]\nkind = "inner"\n')
        message = f"{more}/survey.toml:4: datum: cannot be added"
    elif fault == "no tie":
        rows = rows[2:5]
        message = "no measured pair ties E1, E2, E3 to the datum"
    elif fault == "not a covariance":
        rows[4]["cov_rx_ry_rad2"] = "1"
        message = f"{more}/observations/pairs.csv:6: the covariance is not positive definite"
    elif fault == "unknown column":
        rows = [row | {"sigma": "1"} for row in rows]
        message = f"{more}/observations/pairs.csv:1: unknown column 'sigma'"
    _write(more, rows)
    return message


@pytest.mark.parametrize(
    "fault",
    ["duplicate pair", "unknown station", "duplicate station", "wrong value", "datum", "no tie", "not a covariance",
     "unknown column"],
)  # fmt: skip
def test_faults_in_what_is_new_are_named_and_change_nothing(lab, fault, capsys):
    message = _faulty(lab, fault)
    before = _files(lab)
    assert main(["add", str(lab), str(lab / "more"), "--quiet"]) == 1
    assert message in capsys.readouterr().err
    assert _files(lab) == before


def test_only_an_adjusted_project_grows(lab, capsys):
    results = lab / "results" / "solution.json"
    content = results.read_bytes()
    results.unlink()
    assert main(["add", str(lab), str(lab / "more"), "--quiet"]) == 1
    assert f"run 'labsurvey adjust {lab}' first" in capsys.readouterr().err
    results.write_bytes(content)
    _write(lab, _rows(lab)[:-1])
    assert main(["add", str(lab), str(lab / "more"), "--quiet"]) == 1
    assert "observations/pairs.csv changed since the project was adjusted" in capsys.readouterr().err


def test_commands_of_the_page_work(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    text = (ROOT / "docs" / "relay.md").read_text()
    commands = [line for block in re.findall(r"^```\w*\n(.*?)^```", text, re.S | re.M) for line in block.splitlines()]
    commands = [shlex.split(line)[1:] for line in commands if line.startswith("labsurvey ")]
    assert [c[0] for c in commands] == ["example", "plan", "adjust", "example", "pairs", "adjust", "add", "add"]
    for command in commands:
        assert main([*command, "--quiet"]) == 0, command
    assert (tmp_path / "grown" / "results" / "report.html").is_file()
