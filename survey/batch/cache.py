"""Whether a folder's results are still those of its inputs: then it need not be adjusted again."""

import hashlib
from collections.abc import Mapping
from pathlib import Path

from adjust.model.errors import SurveyError
from survey.batch.record import KEPT
from survey.folder.text import NOT_OURS
from survey.project.detected import read_detected, same_file
from survey.project.project import IMAGES_FOLDER
from survey.solution.earlier.previous import input_hashes, tables_in
from survey.solution.earlier.runs import installed_versions, same_versions
from survey.solution.records import sections

_BESIDE = ("covariance.npz", "residuals.csv", "residuals_other.csv", "report.html")


def unchanged_solution(folder: Path) -> dict[str, object] | None:
    """What a batch keeps of ``results/solution.json`` where it was made from the files of now, by these versions.

    The files read, the images their points come from, the sha256 of all and the versions stand in the solution itself;
    options are in ``survey.toml``.
    """
    results = folder / "results"
    try:
        solution = sections((results / "solution.json").read_bytes(), "inputs", *KEPT)
        inputs = solution["inputs"]
        if not all((results / name).is_file() for name in _BESIDE) or not inputs["hashes"]:
            return None
        same = same_versions(inputs["versions"]) and input_hashes(folder, inputs["hashes"]) == inputs["hashes"]
        same = same and _images_are(folder, inputs["images"])
        return solution if same else None
    except (SurveyError, *NOT_OURS):
        return None  # no results, or not ours: adjusting says what is wrong


def _images_are(folder: Path, recorded: Mapping[str, Mapping[str, object]]) -> bool:
    """Whether the images are those of a solution; they are read only where size or time say nothing."""
    hashes = {entry["file"]: entry["sha256"] for entry in recorded.values()}
    images = folder / IMAGES_FOLDER
    there = {p.relative_to(folder).as_posix(): p for p in images.glob("*/*") if not p.name.startswith(".")}
    if set(there) != set(hashes):
        return False
    known = {entry.file: entry for entry in read_detected(folder / "observations").values()} if hashes else {}
    found = {name: same_file(path, known.get(name)) for name, path in there.items()}
    return all(entry is not None and entry.sha256 == hashes[name] for name, entry in found.items())


def fingerprint(folder: Path) -> str:
    """One hash of all that decides how a folder fails: definition, tables, names of images, versions; "" for none."""
    digest = hashlib.sha256(str(dict(installed_versions())).encode())
    try:
        own = sorted(p for p in folder.iterdir() if p.suffix in (".toml", ".csv", ".parquet") and p.is_file())
        for path in (*own, *(folder / name for name in sorted(tables_in(folder)))):
            digest.update(path.relative_to(folder).as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
        for path in sorted((folder / "images").glob("*/*")):
            status = path.stat()
            digest.update(f"{path.relative_to(folder).as_posix()} {status.st_size} {status.st_mtime_ns}\n".encode())
    except OSError:
        return ""
    return digest.hexdigest()
