"""Batches through the command line: many nights with two broken ones, killed and resumed; the same on Dask."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from survey.batch.run import BatchOptions, run_batch
from survey.cli import main
from tests.sizes import size
from tests.survey.epochs import write_epochs

ROOT = Path(__file__).resolve().parents[2]
N = size(50, 20)


@pytest.fixture(scope="module")
def nights(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    return write_epochs(tmp_path_factory.mktemp("batch") / "nights", N)


def journal(place: Path) -> list[dict[str, Any]]:
    """Whole lines of a journal that is being written."""
    path = place / "journal.jsonl"
    lines = path.read_text().splitlines(keepends=True) if path.is_file() else []
    return [json.loads(line) for line in lines if line.endswith("\n")]


def children(pid: int) -> list[int]:
    """Processes whose parent it is, by Linux's list of processes."""
    out = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            if int(stat.read_text().rsplit(")", 1)[1].split()[1]) == pid:
                out.append(int(stat.parent.name))
        except (OSError, ValueError, IndexError):
            continue
    return out


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


@pytest.fixture(scope="module")
def killed(nights: list[Path]) -> tuple[list[Path], Path, dict[str, int]]:
    """The batch, ended by SIGKILL after some nights; when each of its solutions was written."""
    place = nights[0].parent.parent / "overview"
    command = [sys.executable, "-m", "survey", "adjust", "--quiet", "--report", str(place), *map(str, nights)]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        end = time.monotonic() + 300
        while len(journal(place)) < 9 and process.poll() is None and time.monotonic() < end:
            time.sleep(0.02)
        workers = children(process.pid)
        process.send_signal(signal.SIGKILL)
        process.communicate()
    assert process.returncode == -signal.SIGKILL
    assert workers
    while any(alive(pid) for pid in workers) and time.monotonic() < end:
        time.sleep(0.05)
    assert not any(alive(pid) for pid in workers)  # nobody works on after the kill
    written = {str(f): path.stat().st_mtime_ns for f in nights if (path := f / "results" / "solution.json").is_file()}
    assert 7 <= len(written) < N - 2
    return nights, place, written


def test_nights_killed_and_resumed(
    killed: tuple[list[Path], Path, dict[str, int]], capsys: pytest.CaptureFixture[str]
) -> None:
    nights, place, before = killed
    finished = {entry["path"] for entry in journal(place)}
    assert {str(nights[2]), str(nights[4])} <= finished
    code = main(["adjust", "--report", str(place), "--resume", "--quiet", "--json", *map(str, nights)])
    out, err = capsys.readouterr()
    assert (code, err) == (1, "")
    rows = json.loads(out)["folders"]
    assert [r["folder"] for r in rows] == [str(f) for f in nights]  # nothing lost, in their order
    # nothing twice: what was written before the kill is as it was, and said to be
    for folder, when in before.items():
        assert Path(folder, "results", "solution.json").stat().st_mtime_ns == when
    origins = {r["folder"]: r["origin"] for r in rows}
    assert {f for f, o in origins.items() if o == "unchanged"} == set(before)
    assert [origins[str(nights[i])] for i in (2, 4)] == ["resumed", "resumed"]
    # the failures are explained
    failed = [r for r in rows if r["exit_code"] == 1]
    assert [r["folder"] for r in failed] == [str(nights[2]), str(nights[4])]
    assert "image_points.csv:8: u_px: found '6x1.2', expected a number" in failed[0]["error"]
    assert "there is nothing to adjust; put images" in failed[1]["error"]
    assert len({entry["path"] for entry in journal(place)}) == len(journal(place)) == N
    _check_overview(nights, place)


def _check_overview(nights: list[Path], place: Path) -> None:
    value = json.loads((place / "overview.json").read_text())
    assert value["counts"]["failed"] == 2
    assert value["counts"]["done"] + value["counts"]["test_failed"] == N - 2
    charts = value["trends"]["charts"]
    assert set(charts) >= {"sigma0", "lens/left/fx", "station_from_camera/right/x", "station_from_camera/right/rz"}
    solutions = [json.loads((f / "results" / "solution.json").read_text()) for f in nights
                 if (f / "results" / "solution.json").is_file()]  # fmt: skip
    for chart, key in ((charts["lens/left/fx"], "fx_px"), (charts["lens/left/k1"], "k1")):
        found = [s["cameras"]["left"]["lens"][key] for s in solutions]
        assert [e["value"] for e in chart["epochs"]] == found
    # the same cameras with fresh noise: sigmas explain the scatter, nothing drifts
    within = 1.0 / (2 * (N - 2)) ** 0.5
    ratios = [c["rms_deviation_over_sigma"] for c in charts.values()]
    assert all(abs(r - 1.0) < 4.0 * within for r in ratios)
    assert sum(ratios) / len(ratios) == pytest.approx(1.0, abs=1.5 * within)
    page = (place / "overview.html").read_text()
    assert page.count('href="../nights/night-') >= N - 2
    assert "found &#x27;6x1.2&#x27;" in page


def test_the_table_ends_with_the_count(
    killed: tuple[list[Path], Path, dict[str, int]], capsys: pytest.CaptureFixture[str]
) -> None:
    nights, _, before = killed
    done = [f for f in nights if str(f) in before][:3]
    assert main(["adjust", *map(str, done)]) in (0, 3)
    out, _ = capsys.readouterr()
    assert re.search(r"^3 folders: .*; 3 not adjusted again, their inputs are unchanged$", out, re.M)
    assert main(["adjust", "--quiet", "--jobs", "1", *map(str, nights[2:5:2])]) == 1
    out, err = capsys.readouterr()
    assert err == ""
    assert [line.split()[1] for line in out.splitlines()[1:3]] == ["error", "error"]
    assert "2 folders: 0 done, 2 failed" in out


@pytest.mark.parametrize("arguments", [["a", "b", "--resume"], ["a", "--resume"], ["a", "b", "--jobs", "0"],
                                       ["a", "--report", "r", "--out", "o"]])  # fmt: skip
def test_wrong_usage_of_a_batch_is_2(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["adjust", *arguments])
    assert stop.value.code == 2


def _results(folder: Path) -> dict[str, bytes]:
    """All result files but for the time stamp."""
    found = {p.name: p.read_bytes() for p in sorted((folder / "results").iterdir())}
    for name in ("solution.json", "report.html"):
        found[name] = re.sub(rb"\d{4}-\d\d-\d\dT[\d:+]+", b"", found[name])
    return found


@pytest.mark.filterwarnings("default")  # of Dask
def test_a_dask_cluster_gives_the_same_bits(nights: list[Path], tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed")
    places = [tmp_path / "here" / "night-x", tmp_path / "cluster" / "night-x"]
    for place in places:
        shutil.copytree(nights[10], place, ignore=shutil.ignore_patterns("results"))
    broken = tmp_path / "cluster" / "none"
    here = run_batch(places[:1], BatchOptions(progress=False))
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=2, processes=False, dashboard_address=None, protocol="tcp://"
    ) as cluster:
        there = run_batch([places[1], broken], BatchOptions(scheduler=cluster.scheduler_address, progress=False))
    assert [r.state for r in there] == [here[0].state, "failed"]
    assert there[1].cause == "project"
    assert there[0].numbers == here[0].numbers
    assert _results(places[0]) == _results(places[1])


def test_a_run_killed_by_its_user_says_interrupted(nights: list[Path], tmp_path: Path) -> None:
    """Ctrl-C ends the workers too, and leaves a journal to go on from."""
    command = [sys.executable, "-m", "survey", "adjust", "--fresh", "--quiet", "--report", str(tmp_path),
               *map(str, nights[5:9])]  # fmt: skip
    # a test run in the background of a shell inherits an ignored SIGINT
    with subprocess.Popen(
        command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # one thread at this point
    ) as process:  # fmt: skip
        while not children(process.pid) and process.poll() is None:
            time.sleep(0.02)
        workers = children(process.pid)
        os.kill(process.pid, signal.SIGINT)
        _, err = process.communicate(timeout=60)
    assert process.returncode == 130
    assert b"interrupted" in err
    assert not any(alive(pid) for pid in workers)
    assert (tmp_path / "journal.jsonl").is_file()
