"""What a batch keeps of one folder: how it went, its key figures, and the numbers whose trends are watched."""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, field
from pathlib import Path
from typing import Any, TypeGuard

from adjust.frames.unknowns import POSE_COMPONENTS
from adjust.model.errors import IndeterminateError, NotConvergedError, SurveyError
from adjust.model.frozen import frozen
from survey.batch.common_datum import FreeDatum, Place, free_datum
from survey.folder.locking import BusyError
from survey.folder.shapes import NUMBER, POSITIVE, REAL, WHOLE, Each, Either, misfit
from survey.solution.quantities import Status, components_of
from survey.solution.verdict import misfits

DONE, TEST_FAILED, FAILED = "done", "test_failed", "failed"
ORIGINS, VERDICTS = ("adjusted", "unchanged", "resumed"), ("passed", "check", "failed")
EXIT_CODES = {DONE: 0, FAILED: 1, TEST_FAILED: 3}
CAUSES = {
    "project": "no project",
    "files": "error in the project's files",
    "undetermined": "not determined",
    "convergence": "did not converge",
    "survey": "cannot be adjusted",
    "access": "file or folder not accessible",
    "busy": "another command works on it",
    "memory": "out of memory",
    "process": "its process ended abruptly",
    "cluster": "lost on the cluster",
    "internal": "internal error",
}
"""Kind of failure and how it is called."""

MAY_PASS = frozenset({"access", "busy", "memory", "process"})
"""What a second try may mend: everything else would end the same way again."""

_LINE_OF_FILE = re.compile(r"\.(toml|csv|parquet)(:|\b)")
_SINGLE_POSES = (
    ("cameras", "station_from_camera"), ("stations", "mount_from_station"), ("stations", "world_from_station"),
    ("tables", "world_from_table"), ("targets", "world_from_target"), ("targets", "station_from_target"),
)  # fmt: skip
_VECTORS = (("cameras", "lens"), ("tables", "geometry"), ("targets", "warp"), ("cameras", "clock"), ("tables", "clock"),
            ("stations", "clock"))  # fmt: skip
KEPT = ("summary", "warnings", "groups", "points", "cameras", "stations", "tables", "targets", "free_datum")
"""The entries of a solution from which a record is made."""
_ROTATION = POSE_COMPONENTS[:3]


_SUMMARY = {
    "sigma0?": Either((POSITIVE, None)), "redundancy?": WHOLE, "n_observations?": WHOLE, "n_unknowns?": WHOLE,
    "verdict?": lambda word: word in VERDICTS, "title?": str, "reason?": str, "suspects?": {"n_not_used?": WHOLE},
}  # fmt: skip
_SOLVED = {"redundancy": WHOLE, "sigma0": Either((POSITIVE, None)),
           "global_test": Either((None, {"omega": POSITIVE, "lower": POSITIVE, "upper": POSITIVE}))}  # fmt: skip
_GROUP = {name: Either((REAL, None)) for name in ("deviation?", "sigma_scale?", "redundancy?")}
_FREE = {
    "open_motions": [lambda row: _is_row(row, 7)], "carried_by": [str],
    "places": [{"name": str, "x_mm": lambda x: _is_row(x, 3), "wxyz": Either((None, lambda q: _is_turn(q, 4))),
                "cov": lambda c: _is_row(c, 9) or _is_row(c, 36)}],
}  # fmt: skip
_RECORD = {
    "folder": str, "state": lambda word: word in EXIT_CODES, "origin": lambda word: word in ORIGINS,
    "cause": lambda word: word == "" or word in CAUSES, "error": str,
    "traceback": str, "summary": _SUMMARY, "warnings": [str], "groups": Each(_GROUP), "written": Each(str),
    "numbers": [{"name": str, "unit": str, "value": REAL, "sigma": REAL}], "tries": WHOLE, "seconds": POSITIVE,
    "turns": [{"name": str, "wxyz": lambda q: _is_turn(q, 4), "sigmas_arcsec": lambda s: _is_turn(s, 3)}],
    "free_datum?": Either((None, _FREE)),
}  # fmt: skip


def _is_row(values: object, n: int, of: Callable[[object], bool] = NUMBER) -> TypeGuard[Sequence[float]]:
    return isinstance(values, list | tuple) and len(values) == n and all(map(of, values))


def _is_turn(values: object, n: int) -> bool:
    """Three sigmas, or a quaternion whose length is about 1."""
    if n == 3:
        return _is_row(values, n, REAL)
    return _is_row(values, n) and abs(sum(v * v for v in values) - 1.0) < 1e-3


@frozen
class Number:
    """An estimated number that is there once in a survey: name ``kind/id/component``, in the unit of result files."""

    name: str
    unit: str
    value: float
    sigma: float


@frozen
class Turn:
    """An estimated rotation: quaternion w x y z of ``a_from_b``, sigmas (arcsec) of small rotations about b's axes."""

    name: str
    wxyz: tuple[float, ...]
    sigmas_arcsec: tuple[float, ...]


@frozen
class Record:
    """One folder of a batch.

    folder: as it was named. state: ``done``, ``test_failed`` (residuals larger than the sigmas say) or ``failed``.
    origin: ``adjusted`` now, ``unchanged`` (its results were there), ``resumed`` (failed in the run that is resumed).
    cause: kind of a failure, a key of ``CAUSES``. error: its message. summary, warnings, groups:
    of the solution. free_datum: what its world takes to a common datum, None where its datum is given. tries: how often
    it was adjusted in this run. seconds: of the last try.
    """

    folder: str
    state: str
    origin: str = "adjusted"
    cause: str = ""
    error: str = ""
    traceback: str = ""
    summary: Mapping[str, Any] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    groups: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    numbers: tuple[Number, ...] = ()
    turns: tuple[Turn, ...] = ()
    written: Mapping[str, str] = field(default_factory=dict)
    tries: int = 1
    seconds: float = 0.0
    free_datum: FreeDatum | None = None

    @property
    def exit_code(self) -> int:
        """As the command line has it."""
        return EXIT_CODES[self.state]

    def plain(self) -> dict[str, Any]:
        """As plain values, for JSON."""
        return asdict(self)


def record_from(plain: Mapping[str, Any]) -> Record:
    """The inverse of :meth:`Record.plain`. Raises ValueError for what is no record of this program."""
    said = misfit(plain, _RECORD)
    if said is None and plain["state"] != FAILED:
        said = misfit(plain["summary"], _SOLVED)
    if said is not None:
        raise ValueError(f"no record of a batch: {said}")
    more = {
        "warnings": tuple(plain["warnings"]),
        "numbers": tuple(Number(**n) for n in plain["numbers"]),
        "turns": tuple(Turn(t["name"], tuple(t["wxyz"]), tuple(t["sigmas_arcsec"])) for t in plain["turns"]),
        "free_datum": _free_from(plain.get("free_datum")),
    }
    return Record(**{**plain, **more})


def _free_from(plain: Mapping[str, Any] | None) -> FreeDatum | None:
    if plain is None:
        return None
    places = tuple(
        Place(p["name"], tuple(p["x_mm"]), None if p["wxyz"] is None else tuple(p["wxyz"]), tuple(p["cov"]))
        for p in plain["places"]
    )
    return FreeDatum(tuple(tuple(row) for row in plain["open_motions"]), tuple(plain["carried_by"]), places)


def cause_of(error: BaseException) -> str:
    """The kind of a failure."""
    if isinstance(error, IndeterminateError):
        return "undetermined"
    if isinstance(error, NotConvergedError):
        return "convergence"
    if isinstance(error, BusyError):
        return "busy"
    if isinstance(error, SurveyError):
        text = str(error)
        if "no such folder" in text or "there is no survey.toml" in text:
            return "project"
        return "files" if _LINE_OF_FILE.search(text.split("; ")[0]) else "survey"
    if isinstance(error, OSError):
        return "access"
    return "memory" if isinstance(error, MemoryError) else "internal"


def solved_record(
    folder: str, solution: Mapping[str, Any], written: Mapping[str, str], seconds: float = 0.0, origin: str = "adjusted"
) -> Record:
    """The record of a folder that was adjusted, from what ``solution.json`` holds."""
    return Record(
        folder, TEST_FAILED if misfits(solution["summary"]) else DONE, origin, summary=solution["summary"],
        warnings=tuple(solution["warnings"]), groups=solution["groups"], numbers=tuple(_numbers(solution)),
        turns=tuple(_turns(solution)), written=dict(written), seconds=seconds,
        free_datum=free_datum(solution, Path(written["covariance.npz"])) if "covariance.npz" in written else None,
    )  # fmt: skip


def _numbers(solution: Mapping[str, Any]) -> Iterator[Number]:
    for section, key in _VECTORS:
        for name, entry in solution[section].items():
            if key in entry:
                yield from _components(f"{key}/{name}", entry[key])
    for name, entry in solution["points"].items():
        free = _free(entry["status"], ("x", "y", "z"))
        for axis in "xyz":
            if axis in free:
                yield Number(f"point/{name}/{axis}", "mm", entry[f"{axis}_mm"], entry[f"sigma_{axis}_mm"])
    for section, key in _SINGLE_POSES:
        for name, entry in solution[section].items():
            if entry.get(key, {}).get("status") == "free":
                pose = entry[key]
                for axis, value, sigma in zip("xyz", pose["translation_mm"], pose["sigma_translation_mm"], strict=True):
                    yield Number(f"{key}/{name}/{axis}", "mm", value, sigma)


def _free(status: Status, components: tuple[str, ...]) -> tuple[str, ...]:
    """Components that the observations alone determine: a prior would be the same in every epoch."""
    if isinstance(status, str):
        return components if status == "free" else ()
    return tuple(name for name, word in status.items() if word == "free")


def _components(path: str, entry: Mapping[str, object]) -> Iterator[Number]:
    """Number and sigma of every free component of a lens, table, warp or clock, whose keys end with their units."""
    for c in components_of(entry):
        if c.status == "free" and c.value is not None and c.sigma is not None:
            factor = 3600.0 if (c.unit, c.sigma_unit) == ("deg", "arcsec") else 1.0
            yield Number(f"{path}/{c.name}", c.unit, c.value, c.sigma / factor)


def _turns(solution: Mapping[str, Any]) -> Iterator[Turn]:
    for section, key in _SINGLE_POSES:
        for name, entry in solution[section].items():
            # in networks of rotations the translations are held
            if key in entry and set(_ROTATION) <= set(_free(entry[key]["status"], POSE_COMPONENTS)):
                pose = entry[key]
                quaternion = tuple(pose["rotation_quaternion_wxyz"])
                yield Turn(f"{key}/{name}", quaternion, tuple(pose["sigma_rotation_arcsec"]))
