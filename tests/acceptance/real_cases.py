"""Real measurements, and surveys simulated by other code, with one thing wrong: what does ``labsurvey adjust`` name?

``python -m tests.acceptance.real_cases RESULTS`` runs what RESULTS (a file of lines) does not have yet, and prints the
table: named first, among three, later, refused (naming the right set-up, not the cause), another, silent; of what is
right: passes.
``--again NAME`` runs what is known once more, ``--only NAME`` nothing else.
"""

import argparse
import csv
import io
import json
import re
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gtsam import Point3, Pose3, Rot3

from survey.cli import main as labsurvey
from tests.data import data_folder

Rows = list[dict[str, str]]
_POSE = ("qw", "qx", "qy", "qz", "tx_mm", "ty_mm", "tz_mm")
NOTHING = ""


@dataclass(frozen=True)
class Case:
    """A project, what is wrong with it, and how a line that names it reads (a regular expression).

    says: ``NOTHING`` where all is right. plant: what is done to its measured pairs before it is adjusted. least: what a
    refusal has to name where it does not tell the cause.
    """

    name: str
    folder: tuple[str, ...]
    wrong: str
    says: str
    plant: Callable[[Rows], Rows] | None = None
    least: str = "(?!)"


def inverted(rows: Rows) -> Rows:
    """Each pose given as that of the base in the hand."""
    out = []
    for row in rows:
        w, x, y, z, *shift = (float(row[c]) for c in _POSE)
        pose = Pose3(Rot3.Quaternion(w, x, y, z), Point3(*shift)).inverse()
        q = pose.rotation().toQuaternion()
        values = (q.w(), q.x(), q.y(), q.z(), *pose.translation())
        out.append(row | {c: repr(float(v)) for c, v in zip(_POSE, values, strict=True)})
    return out


def metric(rows: Rows) -> Rows:
    """Metres in the columns of millimetres."""
    return [row | {c: repr(float(row[c]) / 1e3) for c in _POSE[4:]} for row in rows]


def shifted(rows: Rows) -> Rows:
    """Each pose given to the next image, the last one to the first."""
    return [row | {c: before[c] for c in _POSE} for row, before in zip(rows, [rows[-1], *rows[:-1]], strict=True)]


def cases() -> Iterator[Case]:
    """All of them."""
    robot = "hand_eye_ds1"
    for which in ("every8", "every6", "all"):
        yield Case(f"robot {which}", (robot, which), "sigmas too small throughout, board not flat",
                   r"sigmas of group|bent|not flat|its shape|contradicts the rest")  # fmt: skip
        for plant, wrong, says in (
            (inverted, "all robot poses inverted", r"pairs are a_from_b"),
            (metric, "robot poses in metres", r"pairs.*metres|metres.*pairs"),
            (shifted, "robot poses one image late", r"poses of hand.*(late|shift|epoch)"),
        ):
            yield Case(f"robot {which} {plant.__name__}", (robot, which), wrong, says, plant)
    yield Case("unsynchronised", ("unsynchronised",), "four cameras that do not expose together",
               r"do not expose at the same time.* cam1 ")  # fmt: skip
    yield Case("upside_down", ("upside_down",), "a symmetric board seen from its other end",
               r"board.*(half a turn|turned by 180|other end)")  # fmt: skip
    for name, wrong, says in (
        ("rough0.02", "nothing: rough start values", NOTHING),
        ("navN4", "nothing: the head off its table twice", NOTHING),
        ("start18", "nothing: few epochs", NOTHING),
        ("F200ecc12", "encoder of axis 1 eccentric by 12 arcsec", r"table tt.*axis ?1"),
        ("focal", "focal length of A 0.05 % longer from e019", r"camera A.*e019"),
        ("crophalf", "images of B shifted from e019", r"camera B.*e019"),
        ("mirror", "images of B mirrored", r"camera B.*mirror"),
        ("bent", "boards W05 and W08 bent by 2 mm", r"W0[58].*(bent|flat|sag|shape)"),
        ("nonsquare", "all boards 0.3 % wider than given", r"(target|board).*(wide|stretch|shape|square)"),
        ("m_ccw_S2", "directions of S2a count the other way", r"S2a.*(clockwise|other way|sense|turned round)"),
        ("m_gon_S2", "directions of S2a are gon", r"S2a.*gon"),
        ("m_swap_ts2", "B03 and B11 exchanged at S2", r"B03 and B11|B11 and B03"),
        ("m_pair1_inv", "pair p23 inverted", r"pair p23: its values are a_from_b"),
    ):
        setup = r"look first at setup S2a" if name.endswith("S2") or name.endswith("ts2") else "(?!)"
        yield Case(name, ("wobbling", name), wrong, says, None, setup)


def adjusted(case: Case) -> tuple[int, list[str]]:
    """Exit code of ``adjust`` on a copy of the case, and what it says is wrong, the first thing first."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / "lab"
        shutil.copytree(data_folder("calibration", *case.folder), folder)
        if case.plant is not None:
            _replant(folder / "observations" / "pairs.csv", case.plant)
        out, err = io.StringIO(), io.StringIO()
        with redirect_stdout(out), redirect_stderr(err):
            code = labsurvey(["adjust", str(folder), "--quiet", "--json"])
        if code in (0, 3):
            return code, list(json.loads(out.getvalue())["warnings"])
        return code, err.getvalue().replace("labsurvey: error: probable cause:\n", "").strip().splitlines()


def _replant(path: Path, plant: Callable[[Rows], Rows]) -> None:
    rows = list(csv.DictReader(path.read_text(encoding="utf-8").splitlines()))
    with path.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.DictWriter(stream, list(rows[0]))
        writer.writeheader()
        writer.writerows(plant(rows))


def outcome_of(case: Case, code: int, said: Sequence[str]) -> str:
    """What became of a case."""
    if case.says == NOTHING:
        return "passes" if code == 0 and not any("probable cause" in s for s in said) else "blamed"
    at = next((i for i, line in enumerate(said) if re.search(case.says, line)), None)
    causes = [s for s in said if "probable cause" in s or "or else" in s]
    if at is None and code == 1 and any(re.search(case.least, line) for line in said[:3]):
        return "refused"
    if at is None:
        return "another" if causes or code == 1 else "silent"
    return "first" if at == 0 else "among three" if at < 3 else "later"


def run(results: Path, again: Sequence[str], only: Sequence[str]) -> None:
    """Run what is not known yet, and add a line for each."""
    known = read(results)
    for case in cases():
        if (only and case.name not in only) or (case.name in known and case.name not in again):
            continue
        begin = time.process_time()
        code, said = adjusted(case)
        line = {"name": case.name, "outcome": outcome_of(case, code, said), "code": code, "said": said[:3],
                "seconds": round(time.process_time() - begin, 1)}  # fmt: skip
        with results.open("a", encoding="utf-8") as stream:
            stream.write(json.dumps(line) + "\n")
        print(line["name"], line["outcome"], line["seconds"], said[:1], flush=True)


def read(results: Path) -> dict[str, dict[str, Any]]:
    """The last line of every case."""
    if not results.exists():
        return {}
    lines = [json.loads(line) for line in results.read_text(encoding="utf-8").splitlines()]
    return {line["name"]: line for line in lines}


def table(results: Path) -> str:
    """The table of the documentation."""
    known, lines = read(results), ["| project | what is wrong | outcome | says |", "|---|---|---|---|"]
    for case in cases():
        found = known.get(case.name)
        if found is not None:
            said = found["said"][0].removeprefix("probable cause: ").split(" (explains")[0] if found["said"] else ""
            lines.append(f"| {case.name} | {case.wrong} | {found['outcome']} | {said[:160]} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("results", type=Path)
    parser.add_argument("--again", action="append", default=[], metavar="NAME")
    parser.add_argument("--only", action="append", default=[], metavar="NAME")
    said = parser.parse_args()
    run(said.results, said.again, said.only)
    print(table(said.results))


if __name__ == "__main__":
    main()
