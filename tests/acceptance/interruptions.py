"""Commands that are killed or fail half way: before each of the steps in which they change the disk, or at any instant.

A command runs in a copy of this process, which has everything imported. In that copy every step that changes the disk
below a folder is counted by an audit hook; before the one that is wanted something happens: the process is killed, the
disk is full, the process waits.
"""

import errno
import os
import re
import shutil
import signal
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from gtsam import Pose3, Rot3

import survey.folder.exchange
from adjust.model.observations import FrameRef, Pair
from adjust.model.survey import PoseParameter, Station, Survey
from survey.cli import main
from survey.examples.alignment import alignment_files
from survey.folder.replacing import changing
from survey.jobs.adjusting.job import adjust_job
from survey.jobs.aligning import align_job
from survey.jobs.converting import convert_job
from survey.project import read, write_project
from survey.solution.earlier.previous import read_previous

Files = Mapping[str, bytes]
Happens = Callable[[int, str], None]
_STEPS = ("open", "os.rename", "os.link", "os.remove", "os.mkdir", "os.rmdir", "os.chmod", "os.truncate")
_TIMES = re.compile(rb"\d{4}-\d\d-\d\d[T ]\d\d:\d\d(:\d\d)?(\+00:00| UTC)?")
_SIGMAS = np.array([1e-4] * 3 + [1e-3] * 3)


# what is run


@dataclass(frozen=True)
class Case:
    """A command on a folder. prepare: writes ``home`` and gives the arguments. target: what it changes, in home."""

    prepare: Callable[[Path], list[str]]
    target: str = "lab"


def ring(seed: int = 1, n: int = 5) -> Survey:
    """Stations in a ring with a chord; the last one hangs on by a single pair."""
    rng = np.random.default_rng(seed)
    poses = [Pose3()] + [Pose3(Rot3.Expmap(rng.normal(0, 1, 3)), rng.uniform(-5, 5, 3)) for _ in range(n - 1)]
    ends = [(i, (i + 1) % (n - 1)) for i in range(n - 1)] + [(0, 2), (n - 2, n - 1)]
    frames = [FrameRef("station", f"S{i}") for i in range(n)]
    pairs = tuple(
        Pair(f"p{i}-{j}", frames[i], frames[j],
             poses[j].between(poses[i]).retract(_SIGMAS * rng.standard_normal(6)), np.diag(_SIGMAS**2))
        for i, j in ends
    )  # fmt: skip
    held = PoseParameter(Pose3(), "held")
    stations = tuple(Station(f"S{i}", world_from_station=PoseParameter() if i else held) for i in range(n))
    return Survey(stations=stations, pairs=pairs)


def adjusted_ring(home: Path) -> Path:
    """``home/lab``, adjusted, with a file of somebody else among its results."""
    write_project(home / "lab", ring())
    adjust_job(home / "lab", progress=False)
    (home / "lab" / "results" / "notes").mkdir()
    (home / "lab" / "results" / "notes" / "mine.txt").write_text("the only copy")
    return home / "lab"


def _adjust(home: Path) -> list[str]:
    table = adjusted_ring(home) / "observations" / "pairs.csv"
    lines = table.read_text().splitlines()
    table.write_text("\n".join(line for line in lines if not line.startswith("p0-2,")) + "\n")
    return ["adjust", str(home / "lab")]


def _add(home: Path) -> list[str]:
    adjusted_ring(home)
    more = ring(seed=2)
    pair = Pair("new", FrameRef("station", "S4"), FrameRef("station", "S9"), more.pairs[0].b_from_a, more.pairs[0].cov)
    write_project(home / "all", Survey(stations=(more.stations[4], Station("S9")), pairs=(pair,)))
    shutil.rmtree(home / "new", ignore_errors=True)
    (home / "new" / "observations").mkdir(parents=True)
    (home / "all" / "observations" / "pairs.csv").rename(home / "new" / "observations" / "pairs.csv")
    (home / "new" / "survey.toml").write_text("[stations.S9]\n")
    shutil.rmtree(home / "all")
    return ["add", str(home / "lab"), str(home / "new")]


def _remove(home: Path) -> list[str]:
    return ["remove", str(adjusted_ring(home)), "p0-2"]


def _align(home: Path) -> list[str]:
    for seed in (1, 2):  # a round, then other readings
        for name, text in alignment_files(seed).items():
            (home / "lab" / name).parent.mkdir(parents=True, exist_ok=True)
            (home / "lab" / name).write_text(text)
        if seed == 1:
            align_job(home / "lab", progress=False)
    return ["align", str(home / "lab")]


def _convert(home: Path) -> list[str]:
    write_project(home / "from", ring())
    convert_job(home / "from", home / "ring.g2o")
    return ["convert", str(home / "ring.g2o"), str(home / "lab")]


def _export(home: Path) -> list[str]:
    adjusted_ring(home)
    (home / "out").mkdir()
    return ["convert", str(home / "lab"), str(home / "out" / "ring.g2o")]


CASES = {
    "adjust": Case(_adjust),
    "add": Case(_add),
    "remove": Case(_remove),
    "align": Case(_align),
    "convert": Case(_convert),
    "export": Case(_export, "out"),
}


# running it in a copy of this process


@dataclass(frozen=True)
class Ended:
    """How a copy of the process ended. code: negative for a signal. said: stdout and stderr."""

    code: int
    said: str
    seconds: float


def start(argv: list[str], home: Path, happens: Happens | None = None) -> int:
    """Run a command line in a copy of this process; its pid. ``happens`` is told every step below ``home``."""

    def command() -> int:
        if happens is not None:
            os.environ["LABSURVEY_THREADS"] = "1"  # in the copy alone: the same steps in the same order every time
            _tell(home, happens)
        return main([*argv, "--quiet"])

    return in_a_copy(command, home)


def in_a_copy(action: Callable[[], int], home: Path) -> int:
    """Run something in a copy of this process, which ends with the code that it returns; the pid of the copy."""
    (home / "said.txt").touch()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # no thread of this process holds a lock now
        pid = os.fork()
    if pid:
        return pid
    code = 70
    try:
        handle = os.open(home / "said.txt", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(handle, 1)
        os.dup2(handle, 2)
        sys.stdout, sys.stderr = os.fdopen(1, "w", closefd=False), os.fdopen(2, "w", closefd=False)
        code = action()
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def wait(pid: int, home: Path) -> Ended:
    """The end of a process that was started."""
    begin = time.perf_counter()
    code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    return Ended(code, (home / "said.txt").read_text(errors="replace"), time.perf_counter() - begin)


def run(argv: list[str], home: Path, happens: Happens | None = None) -> Ended:
    """Start and wait."""
    return wait(start(argv, home, happens), home)


def _tell(home: Path, happens: Happens) -> None:
    """Call ``happens(number, step)`` before every change of the disk; never undone, the process ends soon."""
    root, count, armed = os.path.realpath(home), [0], [True]

    def step(name: str) -> None:
        if armed[0]:
            armed[0] = False
            count[0] += 1
            try:
                happens(count[0], name)
            finally:
                armed[0] = True

    def event(name: str, arguments: tuple[Any, ...]) -> None:
        if name in _STEPS and _changes(name, arguments) and _concerns(arguments, root):
            step(f"{name} {arguments[0]}")

    real_sync, real_trade = os.fsync, survey.folder.exchange._renameat2

    def fsync(handle: int) -> None:
        step("fsync")
        real_sync(handle)

    def renameat2(new: Path, there: Path) -> int:
        step(f"renameat2 {there}")
        return real_trade(new, there)

    os.fsync, survey.folder.exchange._renameat2 = fsync, renameat2
    sys.addaudithook(event)


def _changes(name: str, arguments: tuple[Any, ...]) -> bool:
    return name != "open" or (isinstance(arguments[2], int) and bool(arguments[2] & os.O_CREAT))


def _concerns(arguments: tuple[Any, ...], root: str) -> bool:
    names = [os.fsdecode(a) for a in arguments[:2] if isinstance(a, str | bytes | os.PathLike)]
    # within rmtree names are relative to an open folder
    return any((n.startswith(root) and not n.endswith("said.txt")) or not n.startswith("/") for n in names)


# what happens


def kill_before(number: int) -> Happens:
    """Killed before this step."""

    def happens(count: int, _: str) -> None:
        if count == number:
            os.kill(os.getpid(), signal.SIGKILL)

    return happens


def full_from(number: int) -> Happens:
    """From this step on nothing can be created; names can be changed and removed as on any full disk."""

    def happens(count: int, step: str) -> None:
        is_new = count >= number and step.startswith(("open", "os.mkdir", "os.link"))
        if is_new or (count == number and step == "fsync"):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), step.partition(" ")[2])

    return happens


def steps_of(argv: list[str], home: Path) -> list[str]:
    """All steps of a command, in their order."""
    log = home / "steps.txt"
    with log.open("w") as stream:

        def note(_: int, step: str) -> None:
            stream.write(step.replace("\n", " ") + "\n")
            stream.flush()

        ended = run(argv, home, note)
    if ended.code not in (0, 3):
        raise RuntimeError(f"{argv}: {ended}")
    found = log.read_text().splitlines()
    log.unlink()
    return found


# what must hold then


_DATED = re.compile(rb"(exclusions\.csv\D{1,60}?)[0-9a-f]{64}")
"""The hash of a file that holds an instant."""


def content(folder: Path) -> dict[str, bytes]:
    """All files of a folder that its owner sees, by name, without the instants that are written in them."""
    found = (p for p in sorted(folder.rglob("*")) if p.is_file() and not _hidden(p.relative_to(folder)))
    return {str(p.relative_to(folder)): _DATED.sub(rb"\1(hash)", _TIMES.sub(b"(time)", p.read_bytes())) for p in found}


def _hidden(name: Path) -> bool:
    return any(part.startswith(".") for part in name.parts)


def results(files: Files) -> dict[str, bytes]:
    """Those below ``results``."""
    return {name: data for name, data in files.items() if name.startswith("results/")}


def leftovers(home: Path) -> list[str]:
    """Everything hidden: nothing of it is to stay."""
    return [str(p.relative_to(home)) for p in home.rglob(".*")]


@dataclass(frozen=True)
class Ground:
    """A case ready to be tried: a pristine copy, and what it looks like before and after the command."""

    case: Case
    home: Path
    argv: list[str]
    before: Files
    after: Files
    steps: list[str]
    seconds: float

    def afresh(self) -> None:
        """Put everything back as it was before the command."""
        shutil.rmtree(self.home)
        shutil.copytree(self.home.with_name("pristine"), self.home)

    @property
    def target(self) -> Path:
        """The folder that the command changes."""
        return self.home / self.case.target

    def faults(self) -> Iterator[str]:
        """What is wrong after a command was killed; then the next command comes, and what is wrong after that."""
        found = content(self.target)
        if results(found) not in (results(self.before), results(self.after)):
            yield f"results are neither the old nor the new set: {_differences(found, self.before)}"
        if self.argv[0] == "convert":
            ended = run(self.argv, self.home)
            if ended.code != (1 if found else 0):
                yield f"convert again: {ended}"
        with changing(self.target):  # as every command begins that writes there
            pass
        found = content(self.target)
        if found not in (self.before, self.after):
            yield f"neither the old nor the new state: {_differences(found, self.before)}"
        if left := leftovers(self.home):
            yield f"left over: {left}"
        if self.argv[0] in ("add", "remove"):
            read_previous(read(self.target))  # results are those of the inputs, else it raises


def _differences(found: Files, wanted: Files) -> list[str]:
    return [name for name in {*found, *wanted} if found.get(name) != wanted.get(name)]


def prepare(case: Case, folder: Path) -> Ground:
    """Make the pristine copy and run the command once to its end."""
    home = folder / "home"
    home.mkdir(parents=True)
    argv = case.prepare(home)
    shutil.copytree(home, folder / "pristine")
    before = content(home / case.target)
    steps = steps_of(argv, home)
    after = content(home / case.target)
    ground = Ground(case, home, argv, before, after, steps, 0.0)
    ground.afresh()
    ended = run(argv, home)  # once more, for the time that it takes and to see that it does the same
    if content(ground.target) != after or results(after) == results(before) != {}:
        raise RuntimeError(f"{argv} cannot be tried: {_differences(content(ground.target), after)}")
    ground.afresh()
    return Ground(case, home, argv, before, after, steps, ended.seconds)


def killed_at_step(ground: Ground, number: int) -> list[str]:
    """What is wrong after a kill before this step."""
    ground.afresh()
    ended = run(ground.argv, ground.home, kill_before(number))
    if ended.code != -signal.SIGKILL:
        return [f"not killed: {ended}"]
    return list(ground.faults())


def killed_at_instant(ground: Ground, after_s: float) -> tuple[bool, list[str]]:
    """Whether the command was still at work after this time, and what is wrong then."""
    ground.afresh()
    pid = start(ground.argv, ground.home)
    time.sleep(after_s)
    os.kill(pid, signal.SIGKILL)
    ended = wait(pid, ground.home)
    return ended.code == -signal.SIGKILL, list(ground.faults())


def full_at_step(ground: Ground, number: int) -> list[str]:
    """What is wrong after a disk that is full from this step on."""
    ground.afresh()
    ended = run(ground.argv, ground.home, full_from(number))
    found = content(ground.target)
    out = []
    if (ended.code == 1 and "No space left on device" not in ended.said) or "Traceback" in ended.said:
        out.append(f"no clear message: {ended}")
    wanted = ground.before if ended.code == 1 else ground.after
    if found != wanted:
        out.append(f"exit code {ended.code}, but changed: {_differences(found, wanted)}")
    if left := leftovers(ground.home):
        out.append(f"left over: {left}")
    return out
