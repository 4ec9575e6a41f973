"""What a capture reads: plans, dialects of tables, and everything a session leaves in its folder."""

import tempfile
from functools import cache
from pathlib import Path

from tests.fuzz.reader import Read, Reader, in_file
from tests.fuzz.small import put

_PLAN = b"""format = 1
project = "lab"
[table]
id = "turntable"
driver = "ascii"
address = "socket://localhost:1"
dialect = "two-axis"
sigma_arcsec = 8.0
axes.axis1 = { limits_deg = [-60, 60], speed_deg_s = 200, acceleration_deg_s2 = 4000, sign = -1, zero_deg = 3 }
axes.axis2 = { limits_deg = [-60, 60], wraps = true, channel = "2" }
settle = { window_s = 0.01, stall_s = 0.3, poll_s = 0.003 }
home = true
[cameras.X]
address = "simulated:X"
settings = { Width = 96, Height = 64, ExposureTime = 500.0 }
[capture]
repeats = 2
trigger = "software"
fetch_timeout_s = 0.1
retry_pause_s = 0.02
quality = false
[poses.t]
kind = "grid"
axis1_deg = { from = -12, to = 12, count = 2 }
axis2_deg = { from = -12, to = 12, count = 3 }
[poses.l]
kind = "list"
angles_deg = [[1, 2], [3, 4]]
"""
_TEMPLATE = b"""format = 1
[cameras.X]
station = "head"
image_size_px = [96, 64]
lens = { model = "brown", free = ["fx", "fy", "u0", "v0"] }
[stations.head]
motion = "table"
table = "turntable"
[tables.turntable]
axes = ["x", "z"]
[targets.board]
kind = "checkerboard"
columns = 5
rows = 4
square_mm = 30.0
"""


def _plan(path: Path) -> object:
    from capture.plan.plan import check_plan_limits, estimate, read_plan

    plan = read_plan(path)
    check_plan_limits(plan)
    return plan.shots, estimate(plan)


def _dialect(path: Path) -> object:
    from capture.devices.turntables.dialect import read_dialect

    return read_dialect(path.name, path.parent)


def _dialects() -> list[bytes]:
    from capture.devices.turntables.dialect import FOLDER

    return [p.read_bytes() for p in sorted(FOLDER.glob("*.toml"))]


def _template(folder: Path) -> Read:
    """A survey.toml that a plan names: copied, and read in an empty folder."""
    from capture.plan.poses import definition_of

    tempfile.tempdir = str(folder)
    return in_file("lab/template.toml", definition_of)(folder)


@cache
def _run() -> dict[str, bytes]:
    """A plan and the folder of its finished session with simulated cameras and table."""
    from capture.plan.plan import read_plan
    from capture.session.run import run_plan
    from tests.capture.session_runs import write_plan

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        plan = write_plan(folder, n=(1, 2), options='[poses.l]\nkind = "list"\nangles_deg = [[1, 2]]')
        text = plan.read_text().replace("quality = false", "quality = true", 1)
        plan.write_text(text)
        run_plan(read_plan(plan), shown=False)
        files = [p for p in folder.rglob("*") if p.is_file()]
        return {p.relative_to(folder).as_posix(): p.read_bytes() for p in files}


def _journals() -> list[bytes]:
    whole = _run()["lab/capture/journal.jsonl"]
    lost = b'{"n": %d, "kind": "lost", "epoch_id": "t01"}\n' % whole.count(b"\n")
    return [whole, whole + lost, whole + b'{"n": 2, "kind": "ev']


def _in_run(name: str, read) -> "Read":
    """One file in the folder of a session, all others whole."""

    def prepare(folder: Path) -> Read:
        put(folder, _run())
        return in_file(name, lambda path: read(folder))(folder)

    return prepare


def _resumed(folder: Path) -> object:
    """What a session does with the journal before it moves anything."""
    from capture.plan.plan import read_plan
    from capture.session.folder import write_table_angles
    from capture.session.journal import Journal, read_journal, taken_sets
    from capture.session.resume import last_readback, verified_sets

    taken_sets(read_journal(folder / "lab" / "capture" / "journal.jsonl")[0])
    last_readback(folder / "lab")
    journal = Journal(folder / "lab" / "capture" / "journal.jsonl")
    try:
        verified_sets(read_plan(folder / "plan.toml"), journal, lambda line: None)
    finally:
        journal.close()
    return write_table_angles(folder / "lab", "turntable", journal.taken(), None)


def _exported(folder: Path) -> object:
    from capture.session.nexus import export

    (folder / "out.nxs").unlink(missing_ok=True)
    return export(folder / "lab", folder / "out.nxs")


def _angles_table(folder: Path) -> object:
    """Readings of other epochs that stand in the project already are kept."""
    from capture.session.folder import write_table_angles

    return write_table_angles(folder / "lab", "turntable", {}, None)


def _shown(folder: Path) -> object:
    from capture.plan.plan import read_plan
    from capture.web.state import SessionView

    view = SessionView(read_plan(folder / "plan.toml"))
    return view.status(), view.shown("X"), view.shown("Y")


def _held(folder: Path) -> object:
    """Who holds the lock, as another process is told."""
    import fcntl

    from survey.folder.locking import SESSION_LOCK, holder_of

    with (folder / "lab" / "capture" / "lock").open("rb") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        return holder_of(folder / "lab" / SESSION_LOCK)


def _simulated_lab(path: Path) -> object:
    from capture.simulated.folder import read_lab

    return read_lab(path.parent, 1)


def _simulated_angles(path: Path) -> object:
    from capture.simulated.angles import AnglesFile

    return AnglesFile(path)()


_LAB = (b'{"format": 1, "seed": 3, "poses": [{"epoch_id": "t1", "axis1_rad": 0.1, "axis2_rad": 0.2, "camera_ids": '
        b'["X", "Y"], "exposure_us": 500.0}]}')  # fmt: skip
CAPTURE_READERS: dict[str, Reader] = {
    "capture-plan": Reader(lambda: [_PLAN], in_file("plan.toml", _plan)),
    "capture-template": Reader(lambda: [_TEMPLATE], _template),
    "dialect": Reader(_dialects, in_file("mine.toml", _dialect)),
    "journal": Reader(_journals, _in_run("lab/capture/journal.jsonl", _resumed)),
    "nexus": Reader(_journals, _in_run("lab/capture/journal.jsonl", _exported)),
    "quality": Reader(lambda: [_run()["lab/capture/quality.jsonl"]], _in_run("lab/capture/quality.jsonl", _shown)),
    "capture-status": Reader(lambda: [_run()["lab/capture/status.json"]], _in_run("lab/capture/status.json", _shown),
                             dictionary=[b"../../secret.png", b"images/X/t02.png"]),
    "capture-lock": Reader(lambda: [b'{"pid": 12, "host": "lab"}'], _in_run("lab/capture/lock", _held)),
    "capture-angles": Reader(lambda: [_run()["lab/observations/table_angles.csv"]],
                             _in_run("lab/observations/table_angles.csv", _angles_table)),
    "simulated-angles": Reader(lambda: [b'{"axis1_rad": 0.5, "axis2_rad": -1e-3}'],
                               in_file("angles.json", _simulated_angles)),
    "simulated-lab": Reader(lambda: [_LAB], in_file("lab.json", _simulated_lab)),
}  # fmt: skip
