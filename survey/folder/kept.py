"""A folder that a command is given: is it a project, and are its files whole."""

import sys
from pathlib import Path

from adjust.model.errors import SurveyError


def require_project(folder: Path, out: Path | None = None) -> None:
    """Raises SurveyError where a folder is no project; there and in ``out`` undoes what was killed half way."""
    for place in (folder, *([out] if out is not None else [])):
        undo_killed(place)
    if folder.is_file():
        raise SurveyError(f"{folder}: is a file; give the folder that holds survey.toml, here {_holder(folder)}")
    if not folder.is_dir():
        meant = _nearest(folder)
        raise SurveyError(f"{folder}: no such folder; {meant}'labsurvey example full-lab lab' writes a ready one")
    if not (folder / "survey.toml").is_file():
        inside = _projects(folder)
        hint = f", as {inside[0]} does" if inside else ""
        raise SurveyError(f"{folder}: there is no survey.toml in it; give the folder that holds one{hint}")


def _holder(file: Path) -> str:
    """The nearest folder above a file that is a project, or where to look."""
    return next((str(p) for p in file.parents if (p / "survey.toml").is_file()), "none above it does")


def _nearest(folder: Path) -> str:
    """The project beside a folder that is not there whose name is the most like its own."""
    from survey.folder.text import suggestion

    by_name = {p.name: str(p) for p in _projects(folder.parent)}
    near = suggestion(folder.name, by_name)
    found = next((by_name[name] for name in by_name if near == f"did you mean {name!r}?"), None)
    return "" if found is None else f"did you mean {found!r}? "


def _projects(place: Path) -> list[Path]:
    """The folders in ``place`` that hold a survey.toml."""
    try:
        return sorted(p.parent for p in place.glob("*/survey.toml"))
    except OSError:
        return []


def undo_killed(folder: Path) -> None:
    """A mixture of old and new must not be taken for a project."""
    if (folder / ".before").is_dir():
        from survey.folder.replacing import recover_killed

        if recover_killed(folder):
            print(f"labsurvey: {folder}: a command that was killed while it replaced files has been undone",
                  file=sys.stderr)  # fmt: skip
