"""What jobs leave for later runs, or are given beside a project: caches, journals, times, parts to be added."""

import json
import shutil
import tempfile
from functools import cache
from pathlib import Path

from tests.fuzz.reader import Read, Reader, in_file
from tests.fuzz.small import adjusted, put, small_project

_KEY = "0123"


@cache
def _journal() -> bytes:
    """The journal of a batch of a folder that was adjusted and one that failed."""
    from survey.batch.journal import Journal
    from survey.batch.record import FAILED, Record, solved_record

    with tempfile.TemporaryDirectory() as name:
        with Journal(Path(name), []) as journal:
            for i in range(2):
                record = solved_record(f"e{i}", json.loads(adjusted()["results/solution.json"]), {"report.html": "r"})
                journal.add(Path(f"/data/e{i}"), "ab" * 32, record)
            journal.add(Path("/data/e2"), "cd" * 32, Record("e2", FAILED, cause="files", error="no table"))
        return (Path(name) / "journal.jsonl").read_bytes()


def _batch_journal(path: Path) -> object:
    from survey.batch.journal import read_journal

    records = [record for _, record in read_journal(path.parent).values()]
    return [r.exit_code for r in records], _overview(records, path.parent)


def _overview(records: list, place: Path) -> object:
    """Whatever was read of a record must do for the pages that are made of it."""
    from survey.batch.page import overview_html
    from survey.batch.tables import folders_csv, overview_json, trends_csv
    from survey.batch.trends import trends_of

    trends = trends_of(records)
    page = overview_html(records, trends, place, "2026-01-01", "en") if records else ""
    return page, folders_csv(records), trends_csv(records, trends), overview_json(records, trends)


def _cache(folder: Path) -> Read:
    """results/solution.json of a folder whose inputs did not change, as a batch takes it instead of adjusting."""
    from survey.batch.run import BatchOptions, _known

    put(folder / "lab", adjusted())
    for name in ("residuals.csv", "residuals_other.csv", "report.html"):
        (folder / "lab" / "results" / name).touch()

    def read(path: Path) -> object:
        record = _known("lab", path.parent.parent, BatchOptions(), {})
        return None if record is None else _overview([record, record], folder)

    return in_file("lab/results/solution.json", read)(folder)


def _kept(folder: Path) -> Read:
    """A solution on disk, of the inputs as they are, which the page shows before it adjusts."""
    from survey.workbench.kept import kept_results
    from survey.workbench.session import Workbench

    put(folder / "lab", adjusted())
    situation = Workbench(folder / "lab", read_only=True).situation
    return in_file("lab/results/solution.json", lambda path: kept_results(situation))(folder)


@cache
def _calibrations() -> list[bytes]:
    """A calibration kept by ``labsurvey navigate``, with and without a table."""
    import numpy as np
    from gtsam import Pose3

    from adjust.model.survey import TABLE_GEOMETRY
    from adjust.navigation import Beacons, Head, HeadCamera, HeadTable
    from survey.jobs.navigating.calibration import Calibration, keep

    cameras = tuple(HeadCamera(c, (640, 480), "brown", np.arange(9.0), np.ones(2), Pose3()) for c in "XY")
    beacons = Beacons(("B1", "B2"), np.ones((2, 3)), np.eye(6), None)
    table = HeadTable(("x", "z"), Pose3(), dict.fromkeys(TABLE_GEOMETRY, 0.0), Pose3())
    out = []
    with tempfile.TemporaryDirectory() as name:
        for head in (Head(cameras, np.eye(30), None), Head(cameras, np.eye(30), table)):
            keep(Path(name) / "c.npz", _KEY, Calibration(head, beacons, 1.0))
            out.append((Path(name) / "c.npz").read_bytes())
    return out


def _calibration(path: Path) -> object:
    from survey.jobs.navigating.calibration import kept

    return kept(path, _KEY)


def _times(path: Path) -> object:
    from survey.jobs.navigating.task import NavigateRequest, chosen_times

    return chosen_times(["t1", "t2", "t3"], NavigateRequest(times=path))


def _adding(which: str):
    """One file of a folder of what is to be added to an adjusted project."""

    def prepare(folder: Path) -> Read:
        from survey.project.merging import merge

        small_project(folder / "lab")
        for name, text in _NEW.items():
            (folder / "new" / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / "new" / name).write_bytes(text)

        def read(path: Path) -> object:
            shutil.rmtree(folder / "place", ignore_errors=True)
            (folder / "place").mkdir()
            return merge(folder / "lab", folder / "new", folder / "place")

        return in_file(f"new/{which}", read)(folder)

    return prepare


_NEW = {
    "survey.toml": b'[stations.d]\n[stations.e]\nworld_from_station = { treatment = "free" }\n',
    "observations/pairs.csv": (
        b"pair_id,a_id,b_id,qw,qx,qy,qz,tx_mm,ty_mm,tz_mm,sigma_rotation_arcsec,sigma_translation_mm\n"
        b"p4,c,d,1,0,0,0,-1000,0,0,10,0.1\np5,d,e,1,0,0,0,-1000,0,0,10,0.1\n"
    ),
}
JOB_READERS: dict[str, Reader] = {
    "batch-journal": Reader(lambda: [_journal()], in_file("journal.jsonl", _batch_journal)),
    "batch-cache": Reader(lambda: [adjusted()["results/solution.json"]], _cache),
    "kept-solution": Reader(lambda: [adjusted()["results/solution.json"]], _kept),
    "navigation-calibration": Reader(_calibrations, in_file("calibration.npz", _calibration), is_text=False),
    "navigation-times": Reader(lambda: [b"epoch_id,time_s\nt1,0.5\nt2,1.0\nt3,1.5\n"], in_file("times.csv", _times)),
    "added-definition": Reader(lambda: [_NEW["survey.toml"]], _adding("survey.toml")),
    "added-table": Reader(lambda: [_NEW["observations/pairs.csv"]], _adding("observations/pairs.csv")),
}
