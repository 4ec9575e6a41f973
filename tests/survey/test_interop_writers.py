"""Networks written as gkf, CSV, JSON and SINEX, and read again."""

import json

import numpy as np
import pytest

from survey.cli import main
from survey.interop.networks.gama import read_gama
from survey.interop.networks.plain_csv import read_plain_csv
from survey.project import read
from tests.acceptance.dense_network import dense_adjust
from tests.survey.interop_samples import CSV, GKF

X = {"left/1": (0.0, 0.0, 0.0), "right": (10.0, 0.5, 0.2), "top": (5.0, 8.0, 1.0), "T2": (6.0, 7.0, 3.0)}
FREE = ("top", "T2")


def _small():
    """Two stations and two free points: east and north, clockwise from north, with small errors in gon and m."""
    rng = np.random.default_rng(4)
    lines = ['<gama-local><network axes-xy="en"><points-observations direction-stdev="20" distance-stdev="1"',
             ' zenith-angle-stdev="30">']  # fmt: skip
    for name, x in X.items():
        start = np.round(np.array(x) + (0.01 if name in FREE else 0.0), 3)
        status = 'adj="xyz"' if name in FREE else 'fix="xyz"'
        lines.append(f'<point id="{name}" x="{start[0]}" y="{start[1]}" z="{start[2]}" {status}/>')
    for at in ("left/1", "right"):
        lines.append(f'<obs from="{at}">')
        for to in X:
            d = np.array(X[to]) - np.array(X[at])
            if to == at:
                continue
            bearing = (np.degrees(np.arctan2(d[0], d[1])) / 0.9 - 17.0 + 2e-3 * rng.standard_normal()) % 400
            lines.append(f'<direction to="{to}" val="{bearing:.5f}"/>')
            if to in FREE:
                zenith = np.degrees(np.arccos(d[2] / np.linalg.norm(d))) / 0.9 + 3e-3 * rng.standard_normal()
                lines.append(f'<z-angle to="{to}" val="{zenith:.5f}"/>')
                lines.append(f'<s-distance to="{to}" val="{np.linalg.norm(d) + 1e-3 * rng.standard_normal():.5f}"/>')
        lines.append("</obs>")
    return "\n".join([*lines, "</points-observations></network></gama-local>"])


@pytest.fixture
def project(tmp_path):
    (tmp_path / "net.gkf").write_text(GKF.replace('adj="XYZ"', 'adj="xyz"'), encoding="utf-8")
    assert main(["convert", str(tmp_path / "net.gkf"), str(tmp_path / "lab")]) == 0
    return tmp_path / "lab"


def _same(a, b, correlations=True):
    """Whether two surveys hold the same network; ids may differ."""
    assert [p.point_id for p in a.points] == [p.point_id for p in b.points]
    key = [
        sorted((r.kind, r.at.point_id, r.to.point_id, round(r.value, 12), round(r.sigma * 1e6, 9),
                r.instrument_height, r.target_height) for r in s.readings)
        for s in (a, b)
    ]  # fmt: skip
    assert key[0] == key[1]
    if not correlations:
        return
    start = {p.point_id: np.array([1.0, 2.0, 3.0]) + i * np.array([7.0, -3.0, 1.0]) for i, p in enumerate(a.points)}
    first, second = (dense_adjust(s, {k: v.copy() for k, v in start.items()}, steps=1) for s in (a, b))
    assert second.omega == pytest.approx(first.omega, rel=1e-9)
    for point in start:
        np.testing.assert_allclose(second.points[point], first.points[point], rtol=1e-9, atol=1e-9)


def test_gkf_there_and_back(project, tmp_path, capsys):
    assert main(["convert", str(project), str(tmp_path / "back.gkf")]) == 0
    assert "start values" in capsys.readouterr().out
    before, after = read(project).survey, read_gama(tmp_path / "back.gkf").survey
    _same(before, after)
    assert after.bearings == before.bearings
    assert [c.reading_ids for c in after.reading_covariances] == [c.reading_ids for c in before.reading_covariances]
    assert {p.point_id: p.x_in_world.held for p in after.points} == {
        p.point_id: p.x_in_world.held for p in before.points
    }


def test_csv_there_and_back_says_which_correlations_it_loses(project, tmp_path, capsys):
    assert main(["convert", str(project), str(tmp_path / "back.csv"), "--json"]) == 0
    out = capsys.readouterr().out
    said = json.loads(out[out.index("{") :])
    assert "left out, correlations of readings: 3" in said["left_out"]
    before, after = read(project).survey, read_plain_csv(tmp_path / "back.csv").survey
    _same(before, after, correlations=False)
    assert len(after.coordinate_differences) == 2
    assert len(after.coordinates) == 2


def test_a_plain_table_there_and_back_is_the_same_table(tmp_path):
    (tmp_path / "net.csv").write_text(CSV, encoding="utf-8")
    for source, target in (("net.csv", "lab"), ("lab", "one.csv"), ("one.csv", "lab2"), ("lab2", "two.csv")):
        assert main(["convert", str(tmp_path / source), str(tmp_path / target)]) == 0
    _same(read_plain_csv(tmp_path / "net.csv").survey, read_plain_csv(tmp_path / "one.csv").survey, correlations=False)
    assert (tmp_path / "one.csv").read_text() == (tmp_path / "two.csv").read_text()


def test_json_says_everything_with_units(project, tmp_path):
    assert main(["convert", str(project), str(tmp_path / "net.json")]) == 0
    document = json.loads((tmp_path / "net.json").read_text(encoding="utf-8"))
    survey = read(project).survey
    assert document["bearings"] == {"zero": "x", "clockwise": False}
    assert document["points"]["A"]["x_m"] == [0.0, 0.0, 10.0]
    by_id = {r["id"]: r for r in document["readings"]}
    for reading in survey.readings:
        value = by_id[reading.reading_id].get("value_rad", by_id[reading.reading_id].get("value_m"))
        assert value == reading.value
    np.testing.assert_allclose(document["reading_covariances"][0]["covariance"], survey.reading_covariances[0].cov)
    assert document["adjusted"] is None


def test_sinex_holds_the_full_covariance_in_its_columns(tmp_path, capsys):
    (tmp_path / "net.gkf").write_text(_small(), encoding="utf-8")
    assert main(["convert", str(tmp_path / "net.gkf"), str(tmp_path / "lab")]) == 0
    assert "left/1 -> left_1" in capsys.readouterr().out
    assert main(["convert", str(tmp_path / "lab"), str(tmp_path / "net.snx")]) == 0
    lines = (tmp_path / "net.snx").read_text(encoding="utf-8").splitlines()
    assert lines[0].startswith("%=SNX 2.02 ")
    assert lines[-1] == "%ENDSNX"
    assert " 0000 = top" in lines  # four characters are upper case in SINEX
    values, sigmas, cov = _sinex(lines)
    survey = read(tmp_path / "lab").survey
    reference = dense_adjust(survey, {p.point_id: p.x_in_world.value for p in survey.points})
    names = [("top", i) for i in range(3)] + [("T2", i) for i in range(3)]
    assert [v[0] for v in values] == ["0000"] * 3 + ["T2"] * 3
    columns = [reference.columns[name] for name in names]
    expected = reference.sigma0**2 * reference.cov[np.ix_(columns, columns)]
    np.testing.assert_allclose([v[1] for v in values], [reference.points[p][i] for p, i in names], rtol=0, atol=1e-9)
    np.testing.assert_allclose(cov, expected, rtol=1e-6, atol=1e-9 * expected.max())
    np.testing.assert_allclose(sigmas, np.sqrt(np.diag(expected)), rtol=1e-5)


def _sinex(lines):
    """Values by code, deviations and covariance, by the format's fixed columns."""
    block = ""
    values, sigmas, entries = [], [], {}
    for line in lines:
        if line[0] in "+-%*":
            block = line[1:] if line[0] == "+" else "" if line[0] == "-" else block
        elif block == "SOLUTION/ESTIMATE":
            values.append((line[14:18].strip(), float(line[47:68])))
            sigmas.append(float(line[69:80]))
        elif block == "SOLUTION/MATRIX_ESTIMATE L COVA":
            row, first = int(line[1:6]), int(line[7:12])
            for k in range(3):
                if text := line[13 + 22 * k : 34 + 22 * k].strip():
                    entries[row - 1, first - 1 + k] = float(text)
    n = len(values)
    cov = np.full((n, n), np.nan)
    for (i, j), value in entries.items():
        cov[i, j] = cov[j, i] = value
    assert np.isfinite(cov).all()
    return values, np.array(sigmas), cov


@pytest.mark.parametrize(
    ("source", "target", "message"),
    [
        ("net.gkf", "net.snx", "only a project is converted to sinex"),
        ("net.txt", "lab", "the ending tells no format"),
        ("lab", "new.txt", "the ending tells no format"),
        ("lab", "net.gkf", "is there already"),
        ("lab", "new.lgc", "the format 'lgc' does not go this way"),
        ("nothing.gkf", "lab3", "there is no such file"),
    ],
)
def test_wrong_ways_are_refused(project, tmp_path, capsys, source, target, message):
    (tmp_path / "net.txt").write_text("x")
    assert main(["convert", str(tmp_path / source), str(tmp_path / target)]) == 1
    assert message in capsys.readouterr().err


@pytest.mark.parametrize("format", ["gama", "csv", "json"])
def test_what_is_written_is_counted_and_what_is_not_is_said(project, tmp_path, capsys, format):
    with (project / "survey.toml").open("a", encoding="utf-8") as file:
        file.write('\n[stations.head]\nworld_from_station = { treatment = "held" }\n')
    a, b, *_ = (p.point_id for p in read(project).survey.points)
    rows = f"distance_id,from_id,to_id,value_mm,sigma_mm\nd1,station:head,{a},1000,1\nd2,{a},{b},2000,1\n"
    (project / "observations" / "distances.csv").write_text(rows, encoding="utf-8")
    survey = read(project).survey
    assert main(["convert", str(project), str(tmp_path / "out"), "--format", format, "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert "left out, distances on stations, cameras or targets: 1" in said["left_out"]
    assert (said["points"], said["readings"]) == (len(survey.points), len(survey.readings) + 1)
    assert (said["baselines"], said["coordinates"]) == (2, 2)
    if format != "json":
        (tmp_path / "out").rename(tmp_path / ("out.gkf" if format == "gama" else "out.csv"))
        back = (read_gama(tmp_path / "out.gkf") if format == "gama" else read_plain_csv(tmp_path / "out.csv")).survey
        assert len(back.readings) == said["readings"]


@pytest.mark.parametrize("name", ["net.ply", "net.glb", "net.json"])
def test_a_network_of_pairs_is_no_scene_and_no_cameras(name, tmp_path, capsys):
    assert main(["example", "relay", str(tmp_path / "relay")]) == 0
    capsys.readouterr()
    how = ["--format", "nerf"] if name.endswith("json") else []
    assert main(["convert", str(tmp_path / "relay"), str(tmp_path / name), *how]) == 1
    assert "the project has no " in capsys.readouterr().err
    assert not (tmp_path / name).exists()
