"""Networks of measured pairs: counts against the theorem, loops and tests against closed forms."""

import json
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from gtsam import Pose3, Rot3
from scipy.stats import chi2

from adjust.adjustment import AdjustOptions, adjust
from adjust.graph.assembly import StartValues
from adjust.model.errors import IndeterminateError, SurveyError
from adjust.model.observations import Coordinates, Distance, FrameRef, Pair, PositionRef
from adjust.model.survey import (
    Camera,
    Datum,
    LensParameter,
    Point,
    PointParameter,
    PoseParameter,
    Station,
    Survey,
    Target,
)
from adjust.pose_network.from_survey import network_of_pairs
from adjust.statistics.screened_adjustment import CleanOptions, adjust_cleaned
from survey import problem, solve
from survey.cli import main
from survey.project import read, write_project
from survey.project.merging import merge
from survey.solution.dictionary import RunInfo, solution_dict
from survey.solution.network.counts import network_dict, pair_network
from survey.solution.network.loops import loops_after, loops_dict, pair_loops
from survey.solution.quantities import ARCSEC_PER_RAD, scale_of

HELD = PoseParameter(Pose3(), "held")
SIGMAS = np.array([1e-4] * 3 + [1e-3] * 3)
COV = np.diag(SIGMAS**2)


FREE = PoseParameter()


def _station(name, parameter=FREE):
    return Station(name, world_from_station=parameter)


def _pair(name, a, b, motion, cov=None):
    n = 6 if isinstance(motion, Pose3) else 3
    return Pair(name, FrameRef("station", a), FrameRef("station", b), motion, COV[:n, :n] if cov is None else cov)


def _poses(n, seed=1):
    rng = np.random.default_rng(seed)
    return [Pose3()] + [Pose3(Rot3.Expmap(rng.normal(0, 1, 3)), rng.uniform(-5, 5, 3)) for _ in range(n - 1)]


def _network(n, ends, noise=0.0, seed=1, rotations=False):
    """Stations S0 ..., the first held, and pairs between them with noise in sigmas."""
    rng, poses = np.random.default_rng(seed + 100), _poses(n, seed)
    pairs = []
    for i, j in ends:
        true = poses[j].between(poses[i]).retract(noise * SIGMAS * rng.standard_normal(6))
        pairs.append(_pair(f"p{i}-{j}", f"S{i}", f"S{j}", true.rotation() if rotations else true))
    stations = tuple(_station(f"S{i}", HELD if i == 0 else PoseParameter()) for i in range(n))
    return Survey(stations=stations, pairs=tuple(pairs)), poses


@pytest.mark.parametrize("n", [3, 4, 5, 8])
def test_a_complete_network_has_the_papers_counts(n):
    survey, _ = _network(n, combinations(range(n), 2), rotations=True)
    found = network_dict(pair_network(survey))
    assert found["measured_pairs"] == found["measurable_pairs"] == n * (n - 1) // 2
    assert found["independent_unknown_poses"] == n - 1
    assert found["triangle_conditions"] == n * (n - 1) * (n - 2) // 6
    assert found["independent_conditions"] == (n - 1) * (n - 2) // 2
    assert found["redundancy"] == 3 * (n - 1) * (n - 2) // 2
    assert found["conditions_per_pair"] == pytest.approx((n - 2) / n)
    assert found["uncontrolled_pairs"] == []


def test_a_ring_with_a_tail_names_the_tail():
    survey, _ = _network(5, [(0, 1), (1, 2), (2, 0), (2, 3), (3, 4)])
    found = pair_network(survey)
    assert found.uncontrolled == ("p2-3", "p3-4")
    assert found.inseparable == (("p0-1", "p1-2", "p2-0"),)
    assert found.redundancy == 6


def test_a_held_component_of_a_station_keeps_its_value_in_a_network_of_pairs():
    survey, poses = _network(4, combinations(range(4), 2), noise=1.0)
    held = PoseParameter(poses[2], held=("tz",))
    stations = tuple(_station(s.station_id, held) if s.station_id == "S2" else s for s in survey.stations)
    free, found = adjust_cleaned(survey), adjust_cleaned(replace(survey, stations=stations))
    station = found.estimates["world_from_station", "S2"]
    moved = Pose3.Logmap(poses[2].between(station.value))
    assert abs(moved[5]) < 1e-11
    assert np.abs(moved[:5]).min() > 1e-7
    assert station.status == ("free",) * 5 + ("held",)
    assert station.cov[5, 5] == 0.0
    assert (found.n_unknowns, found.redundancy) == (free.n_unknowns - 1, free.redundancy + 1)
    # the same numbers as beside observations of another kind, which the whole way of adjusting takes
    general = adjust(replace(survey, stations=stations))
    np.testing.assert_allclose(station.cov, general.estimates["world_from_station", "S2"].cov, atol=1e-12)


def _rig(off):
    """Two calibrated cameras and a target on one station, pairs from the cameras to a marker and one between them."""
    poses = {"a": Pose3(Rot3.Ry(0.4), [0.1, 0, 0]), "b": Pose3(Rot3.Ry(-0.3), [-0.1, 0.02, 0]),
             "m": Pose3(Rot3.Rx(0.2), [0.5, 0.4, 3.0])}  # fmt: skip
    lens = LensParameter("brown", (), np.array([1000.0, 1000, 0, 640, 480, *[0.0] * 8]))
    known = {"a": PoseParameter(poses["a"], "held"), "b": PoseParameter(poses["b"], "prior", 4.0 * COV)}
    cameras = tuple(Camera(i, "head", (1280, 960), lens, known[i]) for i in "ab")

    def measured(name, a, b, error):
        ends = [FrameRef("camera", x) if x in "ab" else FrameRef("station", x) for x in (a, b)]
        return Pair(name, *ends, (poses[b].inverse() * poses[a]).retract(error), COV)

    pairs = (measured("ab", "a", "b", off), measured("am", "a", "m", 0 * off), measured("bm", "b", "m", -0.5 * off))
    return Survey(cameras=cameras, stations=(_station("head", HELD), _station("m", PoseParameter(poses["m"]))),
                  pairs=pairs), poses  # fmt: skip


def test_loops_through_a_calibrated_rig_are_listed_and_close_after_the_adjustment():
    off = np.array([3e-4, -2e-4, 1e-4, 1e-3, 2e-3, -1e-3])
    survey, poses = _rig(off)
    loops, counts = pair_loops(survey), network_dict(pair_network(survey))
    through = [k for k in range(len(loops.test)) if "head" in loops.basis.stations(k)]
    assert (len(loops.test), len(through)) == (2, 1)
    alone = pair_loops(replace(survey, pairs=survey.pairs[:1]))
    assert set(alone.basis.stations(0)) == {"camera:a", "camera:b", "head"}
    # by hand: the pair against the way through the rig, whose second camera has a covariance of its own
    back = (poses["b"].inverse() * poses["a"]).inverse().AdjointMap()
    expected = off @ np.linalg.solve(COV + back @ (4.0 * COV) @ back.T, off)
    np.testing.assert_allclose(alone.test, expected, rtol=2e-3)
    assert counts["conditions_through_given_stations"] == 1
    assert pair_network(replace(survey, pairs=survey.pairs[:1])).uncontrolled == ()
    lenses = {c.camera_id: c.lens.values for c in survey.cameras}
    start = StartValues(lenses, {("world_from_station", "m"): poses["m"], ("station_from_camera", "b"): poses["b"]}, {})
    after = loops_after(adjust(survey, start), loops)
    assert np.abs(loops.vector).max() > 1e-4
    assert np.abs(after).max() < 1e-9
    # a camera whose place only pairs tell closes no loop through its station
    free = replace(survey.cameras[1], station_from_camera=PoseParameter(poses["b"]))
    assert len(pair_loops(replace(survey, cameras=(survey.cameras[0], free))).test) == 1


def test_a_target_held_in_the_world_controls_the_way_to_it():
    survey, poses = _network(3, [(0, 1), (1, 2)])
    end = replace(survey.pairs[1], b=FrameRef("target", "T"))
    target = Target("T", ("c",), np.zeros((1, 3)), None, carrier_from_target=PoseParameter(poses[2], "held"))
    survey = replace(survey, stations=survey.stations[:2], pairs=(survey.pairs[0], end), targets=(target,))
    found = network_dict(pair_network(survey))
    assert found["uncontrolled_pairs"] == []
    assert (found["redundancy"], found["conditions_through_given_stations"]) == (6, 1)
    assert adjust_cleaned(survey).redundancy == 6
    (loop,) = range(len(pair_loops(survey).test))
    assert set(pair_loops(survey).basis.stations(loop)) == {"S0", "S1", "target:T", "world"}
    moving = replace(target, motion="epoch")
    assert pair_network(replace(survey, targets=(moving,))).uncontrolled == ("p0-1", "p1-2")


def test_two_held_stations_control_the_way_between_them():
    survey, poses = _network(3, [(0, 1), (1, 2)])
    assert pair_network(survey).uncontrolled == ("p0-1", "p1-2")
    known = PoseParameter(poses[2], "held")
    survey = replace(survey, stations=(*survey.stations[:2], _station("S2", known)))
    found = network_dict(pair_network(survey))
    assert found["uncontrolled_pairs"] == []
    assert (found["redundancy"], found["conditions_through_given_stations"]) == (6, 1)
    assert adjust_cleaned(survey).redundancy == 6
    # the loop is that from one held station over the pairs to the other
    off = Pose3(Rot3.Rz(3e-4), np.zeros(3))
    pairs = (survey.pairs[0], replace(survey.pairs[1], b_from_a=survey.pairs[1].b_from_a.compose(off)))
    loops = loops_dict(pair_loops(replace(survey, pairs=pairs)))
    assert loops["n_loops"] == 1
    assert loops["worst_first"][0]["pairs"] == ["p0-1", "p1-2"]
    assert loops["worst_first"][0]["misclosure_arcsec"] == pytest.approx(3e-4 * ARCSEC_PER_RAD, rel=1e-6)


def test_a_prior_without_position_gives_no_pose():
    cov = np.diag([1e-6] * 3 + [np.inf] * 3)
    survey, poses = _network(3, [(0, 1), (1, 2)])
    survey = replace(survey, stations=(*survey.stations[:2], _station("S2", PoseParameter(poses[2], "prior", cov))))
    assert pair_network(survey).uncontrolled == ("p0-1", "p1-2")


def test_rotations_among_poses_are_counted_by_themselves():
    survey, _ = _network(3, [(0, 1), (1, 2), (2, 0)])
    turned = replace(survey.pairs[0], b_from_a=survey.pairs[0].b_from_a.rotation(), cov=COV[:3, :3])
    survey = replace(survey, pairs=(turned, *survey.pairs[1:]))
    # three equations of the loop of rotations, none of positions: two pairs of them close no loop
    assert pair_network(survey).redundancy == 3
    assert adjust_cleaned(survey).redundancy == 3


def test_a_station_without_pairs_is_a_part_of_its_own():
    survey, _ = _network(4, [(0, 1), (1, 2), (2, 0)])
    found = network_dict(pair_network(survey))
    assert found["parts"] == [["S0", "S1", "S2"], ["S3"]]
    assert found["isolated_stations"] == ["S3"]
    with pytest.raises(SurveyError, match="no measured pair ties S3 to the datum"):
        adjust_cleaned(survey)


def test_a_loop_closes_as_its_product_says():
    survey, _ = _network(3, [(0, 1), (1, 2), (2, 0)])
    wrong = survey.pairs[2].b_from_a.compose(Pose3(Rot3.Rx(1e-3), np.array([0.0, 4e-3, 0.0])))
    survey = replace(survey, pairs=(*survey.pairs[:2], replace(survey.pairs[2], b_from_a=wrong)))
    loop = loops_dict(pair_loops(survey))["worst_first"][0]
    assert loop["misclosure_arcsec"] == pytest.approx(1e-3 * ARCSEC_PER_RAD, rel=1e-9)
    # three independent rotations of equal sigma about every axis
    assert loop["sigma_misclosure_arcsec"] == pytest.approx(np.sqrt(3) * 1e-4 * ARCSEC_PER_RAD, rel=1e-3)
    assert loop["p_value"] == pytest.approx(chi2.sf(loop["test"], 6))
    assert not loop["closes"]
    assert loop["stations"][0] in ("S0", "S1", "S2")


def test_tests_of_loops_are_distributed_as_they_claim():
    tests = []
    for seed in range(60):
        survey, _ = _network(3, [(0, 1), (1, 2), (0, 2)], 1.0, seed)
        tests.append(loops_dict(pair_loops(survey))["worst_first"][0]["test"])
    # the sum of 60 chi-square (6) is chi-square (360): 360 +- 27; five sigmas
    assert abs(sum(tests) - 360) < 135


def test_every_loop_is_told_with_its_sigma_along_it_however_many_there_are():
    survey, _ = _network(48, combinations(range(48), 2), 1.0)
    loops = pair_loops(survey)
    found = loops_dict(loops)["worst_first"]
    assert len(found) == 48 * 47 // 2 - 47 > 1000
    assert [e["p_value"] for e in found] == sorted(e["p_value"] for e in found)
    at = {loops.basis.pairs(k): k for k in range(len(loops.test))}
    for entry in found[::97]:
        k = at[tuple(entry["pairs"])]
        for unit, of, factor in (("arcsec", slice(3), ARCSEC_PER_RAD), ("mm", slice(3, 6), 1e3)):
            w, length = loops.vector[k, of], np.linalg.norm(loops.vector[k, of])
            sigma = np.sqrt(w @ loops.cov[k, of, of] @ w) / length
            got = [entry[f"misclosure_{unit}"], entry[f"sigma_misclosure_{unit}"]]
            assert got == pytest.approx([factor * length, factor * sigma], rel=1e-12)


def test_both_ways_of_adjusting_a_pure_network_agree():
    survey, _ = _network(6, combinations(range(6), 2), 1.0)
    mixed = _mixed(survey)
    assert network_of_pairs(survey) is not None
    assert network_of_pairs(mixed) is None
    one, two = adjust_cleaned(survey), adjust(mixed, options=AdjustOptions())
    assert one.omega == pytest.approx(two.omega, rel=1e-9)
    assert one.redundancy == two.redundancy
    assert (one.n_unknowns, one.n_observations) == (two.n_unknowns - 3, two.n_observations - 3)
    for name, estimate in one.estimates.items():
        estimate = two.estimates[name]
        np.testing.assert_allclose(one.estimates[name].value.matrix(), estimate.value.matrix(), atol=1e-10)
        np.testing.assert_allclose(one.estimates[name].cov, estimate.cov, rtol=1e-6, atol=1e-16)
    mine, theirs = (solution_dict(x, RunInfo("", ""))["pairs"] for x in (one, two))
    for pair in mine:
        for key in ("sigma_rotation_arcsec", "sigma_translation_mm"):
            # in the tangents at the adjusted and at the measured pair, half a residual (1e-4 rad) apart
            np.testing.assert_allclose(mine[pair]["adjusted"][key], theirs[pair]["adjusted"][key], rtol=1e-4)
        assert mine[pair]["test"] == pytest.approx(theirs[pair]["test"], rel=1e-5)


def test_sigmas_of_an_adjusted_pair_in_a_ring_follow_from_its_redundancy():
    survey, _ = _network(3, [(0, 1), (1, 2), (2, 0)], 1.0, rotations=True)
    result = adjust_cleaned(survey)
    pairs = solution_dict(result, RunInfo("", "", sigmas="a_priori"))["pairs"]
    # three equal rotations share the misclosure: each keeps two thirds of its variance
    for entry in pairs.values():
        expected = np.sqrt(2 / 3) * 1e-4 * ARCSEC_PER_RAD
        np.testing.assert_allclose(entry["adjusted"]["sigma_rotation_arcsec"], expected, rtol=1e-3)
        np.testing.assert_allclose(entry["redundancy"], 1 / 3, rtol=1e-3)
    assert scale_of(result, "a_priori").factor == 1.0


def test_a_wrong_pair_in_a_survey_with_other_observations_is_left_out():
    survey, poses = _network(5, combinations(range(5), 2), 1.0)
    wrong = survey.pairs[3].b_from_a.compose(Pose3(Rot3.Rz(0.02), np.array([0.05, 0.0, 0.0])))
    pairs = (*survey.pairs[:3], replace(survey.pairs[3], b_from_a=wrong), *survey.pairs[4:])
    origin = [PositionRef(None, FrameRef("station", f"S{i}")) for i in range(5)]
    length = float(np.linalg.norm(poses[1].translation() - poses[2].translation()))
    survey = replace(survey, pairs=pairs, distances=(Distance("d", origin[1], origin[2], length, 1e-3),))
    result = adjust_cleaned(survey)
    assert [p.pair_id for p in result.survey.pairs if not p.used] == [survey.pairs[3].pair_id]
    assert result.global_test.passed
    assert [w for w in result.warnings if w.startswith("left out: pair p0-4: off by ")]
    kept = adjust_cleaned(survey, CleanOptions(reject_pairs=False))
    assert all(p.used for p in kept.survey.pairs)
    assert not kept.global_test.passed


def _with_loose_reading(survey):
    """With a distance of no weight between two stations: no survey of pairs alone any more."""
    ends = [PositionRef(None, FrameRef("station", f"S{i}")) for i in (1, 2)]
    return replace(survey, distances=(Distance("d", *ends, 1.0, 1e6),))


@pytest.mark.parametrize("beside", ["distance", "point"])
@pytest.mark.slow
def test_a_survey_of_pairs_is_one_with_anything_beside(beside):
    """Estimates, covariances, tests, exclusions, decisions and variance components, whatever else is observed."""
    survey, _ = _network(7, combinations(range(7), 2), 2.0)
    wrong = dict.fromkeys((3, 11), Pose3(Rot3.Rz(0.02), np.array([0.05, 0.0, 0.0])))
    pairs = [replace(p, b_from_a=p.b_from_a.compose(wrong[i])) if i in wrong else p for i, p in enumerate(survey.pairs)]
    survey = replace(survey, pairs=tuple(pairs))
    options = CleanOptions(variance_components=True)
    other = _with_loose_reading(survey) if beside == "distance" else _mixed(survey)
    one, two = (adjust_cleaned(each, options) for each in (survey, other))
    assert [p.pair_id for p in one.survey.pairs if not p.used] == [survey.pairs[i].pair_id for i in wrong]
    assert [p.used for p in one.survey.pairs] == [p.used for p in two.survey.pairs]
    for name, estimate in one.estimates.items():
        np.testing.assert_allclose(estimate.value.matrix(), two.estimates[name].value.matrix(), atol=1e-8)
        np.testing.assert_allclose(estimate.cov, two.estimates[name].cov, rtol=1e-4, atol=1e-14)
    theirs = {o.ids: o for o in two.other_residuals}
    for o in one.other_residuals:
        assert o.test == pytest.approx(theirs[o.ids].test, rel=1e-4)
        np.testing.assert_allclose(o.redundancy, theirs[o.ids].redundancy, atol=1e-6)
    assert {(d.action, d.ids) for d in one.decisions} == {(d.action, d.ids) for d in two.decisions}
    mine, same = ({c.group: c for c in x.variance_components.components} for x in (one, two))
    assert mine["pair"].factor == pytest.approx(same["pair"].factor, rel=1e-4)
    assert mine["pair"].factor == pytest.approx(4.0, rel=0.4)
    told = [{w for w in x.warnings if w.startswith("left out: pair ")} for x in (one, two)]
    assert len(told[0]) == len(told[1]) == len(wrong)


def test_sigmas_too_small_throughout_reject_no_pair():
    survey, _ = _network(12, combinations(range(12), 2), 5.0)
    for each in (survey, _mixed(survey)):
        result = adjust_cleaned(each)
        assert all(p.used for p in result.survey.pairs)
        assert result.sigma0 == pytest.approx(5.0, rel=0.15)


def _mixed(survey):
    """With a point that is measured for itself, so that it is no pose network."""
    seen = Coordinates((PositionRef("B"),), np.zeros((1, 3)), np.eye(3) * 1e-6)
    return replace(survey, points=(Point("B", PointParameter()),), coordinates=(seen,))


def test_sigmas_too_large_throughout_reject_no_pair():
    """One pair at seven sigmas among residuals of a tenth: together they are far below what the sigmas say."""
    survey, _ = _network(12, combinations(range(12), 2), 0.1)
    off = Pose3(Rot3(), np.array([7e-3, 0.0, 0.0]))
    pairs = (replace(survey.pairs[30], b_from_a=survey.pairs[30].b_from_a.compose(off)),)
    survey = replace(survey, pairs=survey.pairs[:30] + pairs + survey.pairs[31:])
    for each in (survey, _mixed(survey)):
        result = adjust_cleaned(each)
        assert all(p.used for p in result.survey.pairs)
        assert result.sigma0 < 0.5
        assert max(o.test for o in result.other_residuals if o.kind == "pair") > 38.0  # the limit of a single pair


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_sigmas_too_small_throughout_reject_no_pair_of_a_few(seed):
    survey, _ = _network(6, combinations(range(6), 2), 5.0, seed=seed)
    for each in (survey, _mixed(survey)):
        assert all(p.used for p in adjust_cleaned(each).survey.pairs)
    wrong = survey.pairs[4].b_from_a.compose(Pose3(Rot3.Rz(0.02), np.array([0.1, 0.0, 0.0])))
    pairs = survey.pairs[:4] + (replace(survey.pairs[4], b_from_a=wrong),) + survey.pairs[5:]
    for each in (replace(survey, pairs=pairs), _mixed(replace(survey, pairs=pairs))):
        assert [p.pair_id for p in adjust_cleaned(each).survey.pairs if not p.used] == [survey.pairs[4].pair_id]


def test_a_pair_without_which_there_is_no_solution_stays(monkeypatch):
    survey, _ = _network(6, combinations(range(6), 2), 1.0)
    wrong = survey.pairs[4].b_from_a.compose(Pose3(Rot3.Rz(0.02), np.array([0.1, 0.0, 0.0])))
    survey = _mixed(replace(survey, pairs=survey.pairs[:4] + (replace(survey.pairs[4], b_from_a=wrong),)
                            + survey.pairs[5:]))  # fmt: skip
    name = survey.pairs[4].pair_id

    def fragile(given, *arguments):
        if any(p.pair_id == name and not p.used for p in given.pairs):
            raise IndeterminateError("2 directions are undetermined", ("S1",))
        return adjust(given, *arguments)

    monkeypatch.setattr("adjust.statistics.outliers.search.adjust", fragile)
    result = adjust_cleaned(survey)
    assert next(p for p in result.survey.pairs if p.pair_id == name).used
    assert [w for w in result.warnings if w.startswith(f"fails its test, but cannot be left out: pair {name}")]


def test_covariances_of_two_stations_of_a_network_of_rotations(tmp_path):
    made, _ = _network(5, combinations(range(5), 2), 1.0, rotations=True)
    write_project(tmp_path / "lab", made)
    solution = solve(problem(read(tmp_path / "lab")))
    cov = solution.covariance("S2", "S4", sigmas="a_priori")
    assert cov.labels[3:] == tuple(f"world_from_station/S4/{c}" for c in ("rx", "ry", "rz"))
    estimates = solution.adjustment.estimates
    for at, name in ((0, "S2"), (3, "S4")):
        own = estimates["world_from_station", name].cov[:3, :3]
        np.testing.assert_allclose(cov.matrix[at : at + 3, at : at + 3], own, rtol=1e-9)
    # both hang on the held S0 by independent and by common pairs: in rotations of one frame a third of S2 is S4's
    a, b = (estimates["world_from_station", n].value.rotation().matrix() for n in ("S2", "S4"))
    np.testing.assert_allclose(a @ cov.matrix[:3, 3:] @ b.T, 0.5 * a @ cov.matrix[:3, :3] @ a.T, rtol=0.02, atol=1e-11)
    shown = solution.precision.correlations
    assert shown is not None
    assert len(shown.labels) == len(shown.matrix)


def test_networks_of_rotations_go_through_the_command(tmp_path, capsys):
    survey, poses = _network(6, combinations(range(6), 2), 1.0, rotations=True)
    write_project(tmp_path / "lab", survey, title="Rotations")
    assert main(["plan", str(tmp_path / "lab")]) == 0
    assert "independent unknown rotations        5" in capsys.readouterr().out
    assert main(["adjust", str(tmp_path / "lab"), "--quiet"]) == 0
    assert "10 independent conditions (30 equations)" in capsys.readouterr().out
    more = Survey(stations=survey.stations, pairs=(
        _pair("n1", "S1", "new", poses[1].rotation()), _pair("n2", "S2", "new", poses[2].rotation())))  # fmt: skip
    (tmp_path / "more" / "observations").mkdir(parents=True)
    (tmp_path / "more" / "survey.toml").write_text("[stations.new]\n")
    rows = [f"{p.pair_id},{p.a.frame_id},new,{','.join(map(str, _wxyz(p.b_from_a)))},20" for p in more.pairs]
    (tmp_path / "more" / "observations" / "pairs.csv").write_text(
        "pair_id,a_id,b_id,qw,qx,qy,qz,sigma_rotation_arcsec\n" + "\n".join(rows) + "\n"
    )
    assert main(["add", str(tmp_path / "lab"), str(tmp_path / "more"), "--quiet"]) == 0
    assert "redundancy 30 -> 33" in capsys.readouterr().out


def _wxyz(rotation):
    q = rotation.toQuaternion()
    return q.w(), q.x(), q.y(), q.z()


def test_surveys_with_more_than_pairs_grow_from_their_last_solution(tmp_path, capsys):
    survey, poses = _network(5, combinations(range(4), 2), 1.0)
    origin = [PositionRef(None, FrameRef("station", f"S{i}")) for i in range(5)]

    def taped(i, j):
        return float(np.linalg.norm(poses[i].translation() - poses[j].translation())) + 2e-4

    tape = Distance("d1", origin[0], origin[3], taped(0, 3), 1e-3)
    first = replace(survey, stations=survey.stations[:4], distances=(tape,))
    write_project(tmp_path / "lab", first)
    assert main(["adjust", str(tmp_path / "lab"), "--quiet"]) == 0
    everything = _network(5, combinations(range(5), 2), 1.0)[0]
    later = [p for p in everything.pairs if p.b.frame_id == "S4"]
    second = Survey(stations=everything.stations, pairs=tuple(later),
                    distances=(Distance("d2", origin[1], origin[4], taped(1, 4), 1e-3),))  # fmt: skip
    write_project(tmp_path / "more", second)
    (tmp_path / "more" / "survey.toml").write_text("format = 1\n[stations.S4]\n")
    capsys.readouterr()
    assert main(["add", str(tmp_path / "lab"), str(tmp_path / "more"), "--quiet"]) == 0
    assert "from the previous solution" in capsys.readouterr().out
    grown = adjust_cleaned(replace(
        first, stations=everything.stations, pairs=(*first.pairs, *later), distances=first.distances + second.distances
    ))  # fmt: skip
    found = json.loads((tmp_path / "lab" / "results" / "solution.json").read_text())
    assert found["summary"]["omega"] == pytest.approx(grown.omega, rel=1e-7)
    for name, entry in found["stations"].items():
        expected = 1e3 * grown.estimates["world_from_station", name].value.translation()
        np.testing.assert_allclose(entry["world_from_station"]["translation_mm"], expected, atol=1e-7)


@pytest.mark.slow
def test_what_is_wrong_in_what_is_added_is_named_with_its_own_line(tmp_path, capsys):
    """A new pair given the other way round: the line is that of the folder that holds what is new."""
    survey, _ = _network(6, combinations(range(6), 2), 1.0)
    old = [p for p in survey.pairs if p.b.frame_id != "S5"]
    later = [p for p in survey.pairs if p.b.frame_id == "S5"]
    later[2] = replace(later[2], b_from_a=later[2].b_from_a.inverse())
    write_project(tmp_path / "lab", replace(survey, stations=survey.stations[:5], pairs=tuple(old)))
    assert main(["adjust", str(tmp_path / "lab"), "--quiet"]) == 0
    write_project(tmp_path / "more", Survey(stations=survey.stations, pairs=tuple(later)))
    (tmp_path / "more" / "survey.toml").write_text("format = 1\n[stations.S5]\n")
    table = tmp_path / "more" / "observations" / "pairs.csv"
    line = next(i for i, row in enumerate(table.read_text().splitlines(), 1) if row.startswith(later[2].pair_id))
    capsys.readouterr()
    main(["add", str(tmp_path / "lab"), str(tmp_path / "more"), "--quiet"])
    found = json.loads((tmp_path / "lab" / "results" / "solution.json").read_text())
    assert found["warnings"][0].startswith(f"probable cause: pair {later[2].pair_id}: its values are a_from_b")
    assert found["diagnosis"][0]["where"] == f"{table}:{line}"
    assert main(["adjust", str(tmp_path / "lab"), "--quiet", "--try", "1"]) == 0


def test_stations_in_braces_cannot_be_added_to(tmp_path):
    """Those below one header for all of them can."""
    texts = {"lab": "stations = { a = {}, b = {} }", "more": "[stations.c]", "rows": "[stations]\na = {}"}
    for name, said in texts.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / "survey.toml").write_text(f"format = 1\n{said}\n")
    (tmp_path / "place").mkdir()
    with pytest.raises(SurveyError, match=r"lab/survey\.toml: nothing can be added below its tables"):
        merge(tmp_path / "lab", tmp_path / "more", tmp_path / "place")
    merged = merge(tmp_path / "rows", tmp_path / "more", tmp_path / "place")
    assert [s.station_id for s in read(merged.place).survey.stations] == ["a", "c"]


def test_tables_with_other_columns_are_merged_under_one_header(tmp_path):
    survey, _ = _network(3, [(0, 1), (1, 2)])
    write_project(tmp_path / "lab", survey)
    more = tmp_path / "more"
    (more / "observations").mkdir(parents=True)
    (more / "observations" / "pairs.csv").write_text(
        "b_id,a_id,pair_id,euler_x_deg,euler_y_deg,euler_z_deg,sigma_rotation_deg\n\nS0,S2,late,1,2,3,0.01\n"
    )
    (tmp_path / "place").mkdir()
    merged = merge(tmp_path / "lab", more, tmp_path / "place")
    lines = (tmp_path / "place" / "observations" / "pairs.csv").read_text().splitlines()
    old = (tmp_path / "lab" / "observations" / "pairs.csv").read_text().splitlines()
    assert lines[0] == old[0] + ",euler_x_deg,euler_y_deg,euler_z_deg,sigma_rotation_deg"
    assert lines[1] == old[1] + ",,,,"
    assert lines[3].startswith("late,S2,S0,,")
    assert lines[3].endswith(",1,2,3,0.01")
    assert merged.origins["observations/pairs.csv"][3] == (more / "observations" / "pairs.csv", 3)
    name = "observations/pairs.csv"
    error = merged.translated(SurveyError(f"{tmp_path}/place/{name}:4: wrong, stands already in line 2"))
    assert str(error) == f"{more}/{name}:3: wrong, stands already in {tmp_path}/lab/{name}:2"


def test_a_free_network_needs_no_held_station():
    survey, _ = _network(4, combinations(range(4), 2), 1.0)
    free = replace(survey, stations=tuple(_station(s.station_id) for s in survey.stations), datum=Datum("inner"))
    assert adjust_cleaned(free).omega == pytest.approx(adjust_cleaned(survey).omega, rel=1e-8)


def test_what_is_there_stays_as_it_is_written(tmp_path: Path) -> None:
    """New rows go behind it, in its columns; a new column alone has all rows written anew."""
    old = '"p1",a,b,1.0,0,0,0\r\n'
    new = {"q": "pair_id,qw,qx,qy,qz,b_id,a_id\np2,1,0,0,0,b,a\n",
           "group": "pair_id,a_id,b_id,qw,qx,qy,qz,group\np2,a,b,1,0,0,0,g\n"}  # fmt: skip
    (tmp_path / "lab" / "observations").mkdir(parents=True)
    (tmp_path / "lab" / "survey.toml").write_text("format = 1\n[stations.a]\n[stations.b]\n")
    table = tmp_path / "lab" / "observations" / "pairs.csv"
    table.write_bytes(f"pair_id,a_id,b_id,qw,qx,qy,qz\r\n{old}\r\n".encode())
    found = {}
    for name, text in new.items():
        (tmp_path / name / "observations").mkdir(parents=True)
        (tmp_path / name / "observations" / "pairs.csv").write_text(text)
        place = tmp_path / f"{name}-place"
        place.mkdir()
        merged = merge(tmp_path / "lab", tmp_path / name, place)
        found[name] = (place / "observations" / "pairs.csv").read_text()
        lines = merged.origins["observations/pairs.csv"]
        assert len(lines) == found[name].count("\n")
        assert (lines[1], lines[-1][0].parent.parent.name, lines[-1][1]) == ((table, 2), name, 2)
    assert found["q"] == 'pair_id,a_id,b_id,qw,qx,qy,qz\n"p1",a,b,1.0,0,0,0\n\np2,a,b,1,0,0,0\n'
    assert found["group"].splitlines()[1:] == ["p1,a,b,1.0,0,0,0,", "p2,a,b,1,0,0,0,g"]
