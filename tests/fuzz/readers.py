"""Every reader of a file, with good files to start from and a folder around them."""

import io
import shutil
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path

import cv2
import numpy as np

from tests.fuzz.camera_readers import CAMERA_READERS
from tests.fuzz.capture_readers import CAPTURE_READERS
from tests.fuzz.job_readers import JOB_READERS
from tests.fuzz.reader import Read, Reader, in_file
from tests.fuzz.small import adjusted, put
from tests.survey import faults
from tests.survey.interop_samples import AICON, CSV, DBAT, DBAT_FILES, GKF, KRUMM, LGC


@cache
def _projects() -> tuple[dict[str, bytes], dict[str, bytes]]:
    """The files of two good projects that use most of the format; tables as CSV."""
    from survey.project import write_project
    from tests.survey.test_files_terrestrial import everything

    with tempfile.TemporaryDirectory() as folder:
        one, two = Path(folder) / "one", Path(folder) / "two"
        faults.write_good_project(one)
        survey, sigmas = everything()
        write_project(two, survey, sigmas=sigmas)
        return _texts(one), _texts(two)


@cache
def _parquet() -> dict[str, bytes]:
    from survey.project import write_project
    from tests.survey.test_files_terrestrial import everything

    with tempfile.TemporaryDirectory() as folder:
        survey, sigmas = everything()
        write_project(Path(folder), survey, sigmas=sigmas, parquet=True)
        return {p.name: p.read_bytes() for p in Path(folder).rglob("*.parquet")}


def _texts(folder: Path) -> dict[str, bytes]:
    files = [p for p in folder.rglob("*") if p.suffix in (".toml", ".csv")]
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in files}


_ALIGN = b"""
[align.board]
body = "target:board"
onto = "table:turntable"
tolerance_arcsec = 60
pitch_mm = 0.5
feet_mm = { a = [0, 0], b = [10, 0], c = [0, 10] }
"""


def _definition(folder: Path) -> Read:
    from survey.project import read_definition

    faults.write_good_project(folder)
    shutil.rmtree(folder / "images")
    for name, data in _projects()[1].items():
        if "/" not in name and name.endswith(".csv"):
            (folder / name).write_bytes(data)
    return in_file("survey.toml", lambda path: read_definition(path.parent))(folder)


def _table(name: str, number: int) -> Callable[[Path], Read]:
    """One table of observations; what stands in survey.toml was read once."""

    def prepare(folder: Path) -> Read:
        from survey.project import reading
        from survey.project.tables.kinds import KINDS

        main = {kind.beside.name: kind.layout.name for kind in KINDS if kind.beside is not None}
        beside = {main.get(Path(name).stem)} | ({"table_angles"} if "laser_spots" in name else set())
        for other, data in _projects()[number].items():
            if "/" not in other or Path(other).stem in beside:
                (folder / other).parent.mkdir(exist_ok=True)
                (folder / other).write_bytes(data)
        read_whole, known = reading._read_definition, reading._read_definition(folder)
        reading._read_definition = lambda at, *more: known if at == folder else read_whole(at, *more)
        (folder / "observations").mkdir(exist_ok=True)
        path = folder / "observations" / name

        def run(data: bytes) -> object:
            path.write_bytes(data)
            return reading.read(folder)

        return run

    return prepare


def _in_pieces(folder: Path) -> Read:
    """A table of quoted words, taken three rows at a time instead of tens of thousands."""
    from survey.project.tables import files as table_reading

    table_reading.CHUNK = 3
    return _table("table_angles.csv", 0)(folder)


def _by_arrow(folder: Path) -> Read:
    """A small table through the reader of large ones; the rows must say the same of it."""
    from survey.project.tables import arrow as arrow_columns
    from survey.project.tables import files as table_reading
    from survey.project.tables.layouts import IMAGE_POINTS

    arrow_columns.LARGE = 0
    path = folder / "image_points.csv"

    def run(data: bytes) -> object:
        path.write_bytes(data)
        found = arrow_columns.csv_columns(data, IMAGE_POINTS)
        arrow_columns.LARGE = 2**60
        try:
            table = table_reading.read_table(path, IMAGE_POINTS)
        finally:
            arrow_columns.LARGE = 0
        for name, column in (found or {}).items():
            same = repr(column) if IMAGE_POINTS.is_text(name) else column.tobytes()
            other = repr(table.text(name)) if IMAGE_POINTS.is_text(name) else table.numbers(name).tobytes()
            if same != other:
                raise AssertionError(f"Arrow reads {name} in another way than row by row")
        return table

    return run


def _quoted() -> bytes:
    head, *rows = _projects()[0]["observations/table_angles.csv"].splitlines()
    return b"\n".join([head, *(b",".join(b'"%s"' % word for word in row.split(b",")) for row in rows)]) + b"\n"


def _tables() -> dict[str, Reader]:
    out = {}
    for number, project in enumerate(_projects()):
        for name, data in project.items():
            if name.startswith("observations/"):
                file = name.split("/")[1]
                out[f"table-{number + 1}-{Path(file).stem}"] = Reader(lambda d=data: [d], _table(file, number))
    for file, data in _parquet().items():
        out[f"parquet-{Path(file).stem}"] = Reader(lambda d=data: [d], _table(file, 1), is_text=False)
    return out


def _points(folder: Path) -> Read:
    from survey.project import read_definition

    (folder / "survey.toml").write_text('format = 1\n[targets.sheet]\nkind = "points"\nfile = "sheet_points.csv"\n')
    return in_file("sheet_points.csv", lambda path: read_definition(path.parent))(folder)


def _images() -> list[bytes]:
    rng = np.random.default_rng(1)
    small = rng.integers(0, 255, (9, 12), dtype=np.uint8)
    deep = rng.integers(0, 65535, (7, 5, 3), dtype=np.uint16)
    made = [(ending, image) for ending in (".png", ".tif") for image in (small, deep)]
    made += [(".jpg", small), (".bmp", small)]
    return [cv2.imencode(ending, image)[1].tobytes() for ending, image in made]


def _image(folder: Path) -> Read:
    from survey.detection.gray import read_image

    return in_file("image.png", read_image)(folder)


def _results(which: str) -> Callable[[Path], Read]:
    def prepare(folder: Path) -> Read:
        from survey.project import read
        from survey.solution.earlier.previous import read_previous

        put(folder, adjusted())
        project = read(folder)
        path = folder / "results" / which

        def run(data: bytes) -> object:
            path.write_bytes(data)
            return read_previous(project)

        return run

    return prepare


def _run(which: str) -> Callable[[Path], Read]:
    def prepare(folder: Path) -> Read:
        from survey.solution.earlier.runs import definition_of, list_runs, load_run

        put(folder, adjusted())
        path = folder / "runs/0001" / which

        def run(data: bytes) -> object:
            path.write_bytes(data)
            return list_runs(folder), definition_of(folder, 1), load_run(folder, 1)

        return run

    return prepare


def _npz() -> list[bytes]:
    """Compressed as written, and stored: a flipped byte of a compressed one mostly fails its checksum alone."""
    with np.load(io.BytesIO(adjusted()["results/covariance.npz"])) as found:
        out = io.BytesIO()
        np.savez(out, **{k: found[k] for k in found.files})
    lone = io.BytesIO()
    np.save(lone, np.zeros(3))
    pickled = io.BytesIO()
    np.savez(pickled, covariance=np.array([{}], dtype=object))
    return [adjusted()["results/covariance.npz"], out.getvalue(), lone.getvalue(), pickled.getvalue()][:2]


def _planning(folder: Path) -> Read:
    from survey.planning.plan_file import read_plan
    from survey.project import read

    put(folder / "lab", _planned_lab())
    survey = read(folder / "lab").survey
    return in_file("lab/plan.toml", lambda path: read_plan(path.parent, survey))(folder)


@cache
def _planned_lab() -> dict[str, bytes]:
    """A project with values for everything and its plan, by name; simulating it takes a while."""
    from tests.survey.planning_lab import write_lab

    with tempfile.TemporaryDirectory() as folder:
        write_lab(Path(folder) / "lab", epochs=2)
        return _texts(Path(folder) / "lab")


def _trajectory(path: Path) -> object:
    from survey.jobs.relay import read_trajectories

    return read_trajectories({"a": path})


_TRAJECTORY = b"".join(
    b"%.1f,%.3f,0.5,1.0,0,0,0,1\n" % (0.1 * i, 0.01 * i) for i in range(6)
)
_G2O = b"""VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1
VERTEX_SE3:QUAT 1 1 0 0 0 0 0 1
FIX 0
EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1 1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 4 0 0 4 0 4
"""


def _g2o(path: Path) -> object:
    from survey.interop.networks.g2o import read_g2o_file

    return read_g2o_file(path).survey, read_g2o_file(path, "quaternion").survey


def _foreign(name: str) -> Callable[[Path], object]:
    def read(path: Path) -> object:
        from survey.interop.networks.foreign import with_safe_ids
        from survey.jobs.converting import READERS as FOREIGN

        return with_safe_ids(FOREIGN[name](path).survey)

    return read


def _one_of(kind: str, files: dict[str, str], opened: str, file: str) -> Callable[[Path], Read]:
    """One file of a network that consists of several, all others whole."""

    def prepare(folder: Path) -> Read:
        read = _foreign(kind)
        for name, text in files.items():
            (folder / name).write_text(text)
        path = folder / file

        def run(data: bytes) -> object:
            path.write_bytes(data)
            return read(folder / opened)

        return run

    return prepare


def _aicon(file: str) -> Callable[[Path], Read]:
    return _one_of("aicon", AICON, "net.phc", file)


def _dbat(file: str) -> Callable[[Path], Read]:
    return _one_of("dbat", {**DBAT_FILES, "net.xml": DBAT}, "net.xml", file)


def _recover(folder: Path) -> Read:
    """The list that a killed run leaves: what it names is restored or removed, inside the project only."""
    from survey.folder.replacing import recover
    from tests.fuzz.replaced import unfinished_project

    def run(data: bytes) -> object:
        unfinished_project(folder, data)
        return recover(folder / "lab")

    return run


def _alignment_rounds() -> list[bytes]:
    from survey.jobs.aligning import ROUND_COLUMNS

    return [",".join(ROUND_COLUMNS).encode() + b"\n2025-01-01,board,turn,1,2,3,0.1,0.1,0.1\n"]


def _rounds(path: Path) -> object:
    from survey.jobs.aligning import _rounds as read

    return read(path)


def _rows(path: Path) -> object:
    """As detection keeps them: every image's hash, who is marked, and the text again."""
    from survey.project.tables.layouts import IMAGE_POINTS
    from survey.project.tables.rows import read_rows

    found = read_rows(path.parent, IMAGE_POINTS)
    return [found.digest(key) for key in found.images], found.marked_unused(), found.text()


READERS: dict[str, Reader] = {
    "definition": Reader(
        lambda: [_projects()[0]["survey.toml"], _projects()[0]["survey.toml"] + _ALIGN, _projects()[1]["survey.toml"]],
        _definition,
    ),
    "points-file": Reader(lambda: [_projects()[0]["sheet_points.csv"]], _points),
    **_tables(),
    "table-by-arrow": Reader(lambda: [_projects()[0]["observations/image_points.csv"]], _by_arrow),
    "table-rows": Reader(lambda: [_projects()[0]["observations/image_points.csv"]], in_file("image_points.csv", _rows)),
    "table-in-pieces": Reader(lambda: [_quoted()], _in_pieces, dictionary=[b'"', b'""', b'"\n']),
    "image": Reader(_images, _image, is_text=False),
    "solution": Reader(lambda: [adjusted()["results/solution.json"]], _results("solution.json")),
    "covariance": Reader(_npz, _results("covariance.npz"), is_text=False),
    "run": Reader(lambda: [adjusted()["runs/0001/run.json"]], _run("run.json")),
    "run-estimates": Reader(lambda: [adjusted()["runs/0001/estimates.npz"]], _run("estimates.npz"), is_text=False),
    "replaced-list": Reader(lambda: [b'{"survey.toml": true, "results": false, "observations/pairs.csv": true}'],
                            _recover, dictionary=[b"../victim", b"..", b".", b"images/../..", b"victim"]),
    "alignment-rounds": Reader(_alignment_rounds, in_file("alignment_rounds.csv", _rounds)),
    "planning": Reader(lambda: [_planned_lab()["plan.toml"]], _planning),
    "trajectory": Reader(lambda: [_TRAJECTORY, _TRAJECTORY.replace(b",", b" ")], in_file("a.csv", _trajectory)),
    "g2o": Reader(lambda: [_G2O], in_file("net.g2o", _g2o)),
    "gama": Reader(lambda: [GKF.encode()], in_file("net.gkf", _foreign("gama"))),
    "krumm": Reader(lambda: [KRUMM.encode()], in_file("net.dat", _foreign("krumm"))),
    "lgc": Reader(lambda: [LGC.encode()], in_file("net.lgc", _foreign("lgc"))),
    "csv": Reader(lambda: [CSV.encode()], in_file("net.csv", _foreign("csv"))),
    "dbat": Reader(lambda: [DBAT.encode()], _dbat("net.xml")),
    **{f"dbat-{n.split('.')[0]}": Reader(lambda t=t: [t.encode()], _dbat(n))
       for n, t in DBAT_FILES.items()},
    **{f"aicon-{n.split('.')[1]}": Reader(lambda t=t: [t.encode()], _aicon(n))
       for n, t in AICON.items()},
    **CAMERA_READERS,
    **JOB_READERS,
    **CAPTURE_READERS,
}
