"""Runs of a project, kept under ``runs/NNNN`` so that any two can be compared and any can come back.

``run.json``: when, by whom, what came out, what was excluded, hashes of all inputs. ``survey.toml``: as it was then.
``estimates.npz``: the ``covariance.npz`` of the results. ``solution.json``: as in the results. A run of the
same inputs, options and versions as the last one is not kept again; of runs that nobody pinned the last ``MOST`` stay.
Images are never kept.
"""

import hashlib
import json
import os
import platform
import re
import shlex
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from survey.folder.plain import plain
from survey.folder.replacing import changing, replace_parts
from survey.folder.text import NOT_OURS, atomic_write, json_text, read_bytes, read_text
from survey.project.exclusions import Exclusion, Name
from survey.project.project import DEFINITION_FILE, RESULTS
from survey.solution.covariances import read_estimates
from survey.solution.earlier.changes import Snapshot, in_short

if TYPE_CHECKING:  # loads what adjusts
    from survey.solution.dictionary import RunInfo

RUNS, MOST = "runs", 50
_RUN, _ESTIMATES, _SOLUTION = "run.json", "estimates.npz", "solution.json"
_PACKAGES = ("labsurvey", "gtsam", "numpy", "scipy", "opencv-contrib-python-headless")
_FILES = (_RUN, _ESTIMATES, _SOLUTION, DEFINITION_FILE)


class Clock:
    """How long each step took."""

    def __init__(self, seconds: Mapping[str, float] = MappingProxyType({})) -> None:
        self.seconds: dict[str, float] = dict(seconds)

    @contextmanager
    def step(self, name: str) -> Iterator[None]:
        """Time what is done inside."""
        begin = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - begin


@cache
def installed_versions() -> Mapping[str, str]:
    """Versions of Python and of the packages that results depend on, as far as they are installed."""
    found = {"python": platform.python_version()}
    for package in _PACKAGES:
        with suppress(PackageNotFoundError):
            found[package] = version(package)
    return MappingProxyType(found)


def same_versions(versions: Mapping[str, str]) -> bool:
    """Whether this Python and these packages are installed in these versions."""
    return bool(versions) and versions.items() <= installed_versions().items()


def command_line(command: str, folder: Path, *words: str | Path, **flags: object) -> str:
    """A command as it can be given again, with its options; folders by their names, as results may be moved."""
    said = [f"--{name}" if value is True else f"--{name} {_shown(value)}" for name, value in flags.items() if value]
    return " ".join(["labsurvey", command, _shown(folder), *map(_shown, words), *said])


def _shown(value: object) -> str:
    return shlex.quote(plain_name(value) if isinstance(value, Path) else
                       str(value).encode("utf-8", "surrogateescape").decode("utf-8", "replace"))  # fmt: skip


def plain_name(folder: Path) -> str:
    """The name alone: results of a copied folder stay the same; by its bytes: a terminal without UTF-8 garbles it."""
    return os.fsencode(folder.resolve().name).decode("utf-8", "replace")


@frozen
class Run:
    """A run by its number. summary: verdict, sigma0, redundancy and so on. hashes: of the inputs, by path."""

    number: int
    time: str
    author: str
    command: str
    pinned: bool
    summary: Mapping[str, Any]
    hashes: Mapping[str, str]
    exclusions: tuple[Exclusion, ...]
    fingerprint: str

    def as_dict(self) -> dict[str, Any]:
        """As it stands in ``run.json``."""
        left = [{k: v for k, v in e.as_dict().items() if k != "name"} | {"at": e.at and list(e.at)}
                for e in self.exclusions]  # fmt: skip
        return {**vars(self), "exclusions": left}

    def text(self) -> str:
        """One line for people."""
        sigma0, mark = self.summary.get("sigma0"), "*" if self.pinned else " "
        shown, verdict = "-" if sigma0 is None else f"{sigma0:.4f}", self.summary.get("verdict", "")
        return (f"{self.number:4d}{mark} {self.time}  {verdict:<7} sigma0 {shown}  redundancy "
                f"{self.summary.get('redundancy')}  excluded {len(self.exclusions)}  {self.author}")  # fmt: skip


def record_run(
    folder: Path, place: Path, run: "RunInfo", solution: Mapping[str, Any], author: str
) -> tuple[str, ...]:
    """Keep a run: its files made in ``place`` with its results, while ``folder`` is changed; old files that go then."""
    runs, there = _readable(folder), [int(path.parent.name) for path in _places(folder)]
    of = [dict(run.input_hashes), plain(run.options), dict(run.versions), sorted(solution)]
    fingerprint = hashlib.sha256(json.dumps(of, sort_keys=True, allow_nan=False).encode()).hexdigest()
    if runs and runs[-1].fingerprint == fingerprint:
        return ()
    number = max(there, default=0) + 1
    said = Run(number, run.date, author, run.command, False, in_short(solution["summary"]), dict(run.input_hashes),
               tuple(one.exclusion for one in run.left_out), fingerprint)  # fmt: skip
    into = place / RUNS / f"{number:04d}"
    atomic_write(into / _RUN, json_text(said.as_dict()))
    for name, result in ((_SOLUTION, _SOLUTION), (_ESTIMATES, "covariance.npz")):
        atomic_write(into / name, (place / RESULTS / result).read_bytes())
    atomic_write(into / DEFINITION_FILE, read_bytes(folder / DEFINITION_FILE)[0])
    light = [r.number for r in runs if not r.pinned]
    return tuple(f"{RUNS}/{n:04d}/{name}" for n in light[: max(0, len(light) + 1 - MOST)] for name in _FILES)


def list_runs(folder: Path) -> tuple[Run, ...]:
    """All runs of a project in their order. Raises SurveyError for one that is not as it was written."""
    return tuple(_read(path) for path in _places(folder))


def _places(folder: Path) -> list[Path]:
    found = [p for p in (folder / RUNS).glob(f"*/{_RUN}") if re.fullmatch(r"\d{4,9}", p.parent.name)]
    return sorted(found, key=lambda path: int(path.parent.name))


def _readable(folder: Path) -> list[Run]:
    """Runs that are as they were written: a damaged one must not keep anybody from adjusting."""
    out = []
    for path in _places(folder):
        with suppress(SurveyError):
            out.append(_read(path))
    return out


def find_run(folder: Path, number: int) -> Run:
    """A run by its number; raises SurveyError where there is none."""
    path = folder / RUNS / f"{number:04d}" / _RUN
    if not path.is_file():
        known = ", ".join(str(r.number) for r in list_runs(folder)[-12:]) or "none yet; 'labsurvey adjust' keeps one"
        raise SurveyError(f"{folder}: there is no run {number}; known: {known}")
    return _read(path)


def _read(path: Path) -> Run:
    try:
        found = json.loads(read_bytes(path)[0])
        left = tuple(
            Exclusion(Name(str(e["what"]), str(e["id"])), str(e["reason"]), str(e["author"]), str(e["time"]),
                      at=None if e["at"] is None else (float(e["at"][0]), float(e["at"][1])))
            for e in found["exclusions"]
        )  # fmt: skip
        texts = {k: str(found[k]) for k in ("time", "author", "command", "fingerprint")}
        hashes = {str(k): str(v) for k, v in found["hashes"].items()}
        return Run(number=int(path.parent.name), pinned=found["pinned"] is True, summary=dict(found["summary"]),
                   hashes=hashes, exclusions=left, **texts)  # fmt: skip
    except NOT_OURS as error:
        raise SurveyError(f"{path}: cannot be read as a run ({error}); remove its folder") from error


def definition_of(folder: Path, number: int) -> str:
    """The text of survey.toml at a run."""
    path = folder / RUNS / f"{find_run(folder, number).number:04d}" / DEFINITION_FILE
    return read_text(path)


def load_run(folder: Path, number: int) -> Snapshot:
    """The solution of a run. Raises SurveyError."""
    run, path = find_run(folder, number), folder / RUNS / f"{number:04d}" / _ESTIMATES
    try:
        return Snapshot(read_estimates(path), run.summary)
    except NOT_OURS as error:
        raise SurveyError(f"{path}: cannot be read as a run ({error}); remove its folder") from error


def pin_run(folder: Path, number: int, pinned: bool = True) -> Run:
    """Keep a run for ever, or no longer. Raises SurveyError."""
    with changing(folder) as place:
        said = find_run(folder, number).as_dict() | {"pinned": pinned}
        atomic_write(place / RUNS / f"{number:04d}" / _RUN, json_text(said))
        replace_parts(folder)
    return find_run(folder, number)


def remove_empty(folder: Path, gone: Iterable[str]) -> None:
    """Folders of runs whose files are gone."""
    for place in {(folder / name).parent for name in gone}:
        try:
            place.rmdir()
        except OSError:  # somebody keeps a file of their own in it
            continue
