"""``observations/exclusions.csv``: what people left out, why, who and when. Rows are only ever added; the last counts.

    what,id,state,reason,author,time,u_px,v_px
    image_point,X/hX05/board/r7c2,excluded,reflection on the glass,A. Smith,2026-11-22T14:35:11+00:00,,
    image,R4/cR402,excluded,motion blur,A. Smith,2026-11-22T14:36:02+00:00,,

What is named, by its id and never by its row, so that it survives detection:

===========  ========================================================================================
what         id
===========  ========================================================================================
image_point  ``camera/epoch/target/point``; ``camera/epoch/point`` for a point of the world
image        ``camera/epoch``
target       ``target`` in all images, or ``camera/epoch/target`` in one
point        ``target/point`` in all images; ``point`` of the world: its image points and all readings
epoch        ``epoch``: its images, spots and readings
camera       ``camera``: all its images and spots
reading      ``table:id``, such as ``distances:B01-B02``, ``table_angles:turntable/t09``
spot         ``camera/epoch/spot``; u_px and v_px tell which one it was when it was excluded
===========  ========================================================================================
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from survey.folder.plain import attributes
from survey.folder.text import csv_rows, csv_text, decode, read_bytes, read_text, suggestion
from survey.project.tables.reading import LARGEST_ROWS, Layout, check_header

EXCLUSIONS_FILE = "exclusions.csv"
WHAT = ("image_point", "image", "target", "point", "epoch", "camera", "reading", "spot")
EXCLUDED, INCLUDED = "excluded", "included"
EXCLUSIONS = Layout("exclusions", ("what", "id"), (), ("state", "reason", "author", "time"), ("u_px", "v_px"))
_FORMS = {
    "image_point": ("camera/epoch/target/point", "camera/epoch/point"), "image": ("camera/epoch",),
    "target": ("target", "camera/epoch/target"), "point": ("target/point", "point"), "epoch": ("epoch",),
    "camera": ("camera",), "spot": ("camera/epoch/spot",),
}  # fmt: skip


@frozen
class Name:
    """What is excluded: one of ``WHAT`` and its id."""

    what: str
    id: str

    def __str__(self) -> str:
        """As commands take it: a reading by its table, all else by what it is."""
        return self.id if self.what == "reading" else f"{self.what}:{self.id}"

    @property
    def meant(self) -> dict[str, str]:
        """The ids that make up the id, by what they are; of any but a reading."""
        forms = [form.split("/") for form in _FORMS[self.what]]
        parts = self.id.rsplit("/", max(map(len, forms)) - 1)
        return dict(zip(next(form for form in forms if len(form) == len(parts)), parts, strict=True))


@frozen
class Exclusion:
    """A row in force. line: where it stands. at: image coordinates (u, v) px of a spot when it was excluded."""

    name: Name
    reason: str = ""
    author: str = ""
    time: str = ""
    line: int = 0
    at: tuple[float, float] | None = None

    def as_dict(self) -> dict[str, object]:
        """Who left what out, and why."""
        return {"name": str(self.name), "what": self.name.what, "id": self.name.id,
                **attributes(self, "reason", "author", "time")}  # fmt: skip


@frozen
class Row:
    """A row as it stands in the file, in force or not."""

    excluded: bool
    exclusion: Exclusion


def name_problem(what: str, text: str) -> str | None:
    """Why this is no id of that kind, or None; whether anything has it is not asked."""
    if what not in WHAT:
        return f"what: unknown {what!r}; {suggestion(what, WHAT)}"
    if what == "reading":
        table, colon, rest = text.partition(":")
        return None if table and colon and rest else f"id: found {text!r}; a reading is table:id, as distances:B1-B2"
    if what == "point":
        return None if text else "id: is blank; fill it in"
    parts = text.split("/")
    if all(parts) and any(form.count("/") + 1 == len(parts) for form in _FORMS[what]):
        return None
    return f"id: found {text!r}; {what.replace('_', ' ')} is written {' or '.join(_FORMS[what])}"


def read_exclusions(folder: Path) -> tuple[tuple[Row, ...], str]:
    """All rows of ``folder/exclusions.csv`` in their order, and its sha256 ("" where it is not there).

    Lines that begin with # and blank lines are passed over. Raises SurveyError with file and line.
    """
    path = folder / EXCLUSIONS_FILE
    if path.with_suffix(".parquet").exists():
        raise SurveyError(f"{path.with_suffix('.parquet')}: exclusions are lines to be read; write them as {path.name}")
    if not path.is_file():
        return (), ""
    data, digest = read_bytes(path)
    lines = _lines(path, decode(path, data))
    _, header = next(lines, (1, None))
    if header is None:
        raise SurveyError(f"{path}:1: the file is empty; the first line names the columns: what,id,state,reason")
    check_header(path, header, EXCLUSIONS)
    rows: list[Row] = []
    for line, cells in lines:
        rows.append(_row(path, line, header, cells))
        if len(rows) > LARGEST_ROWS:
            raise SurveyError(f"{path}:{line}: more than {LARGEST_ROWS} rows; exclude whole images or epochs")
    return tuple(rows), digest


def _lines(path: Path, text: str) -> Iterator[tuple[int, list[str]]]:
    """The header and the rows, each with its line."""
    return ((n, cells) for n, cells in csv_rows(path, text) if any(cells) and not cells[0].lstrip().startswith("#"))


def _row(path: Path, line: int, header: Sequence[str], cells: Sequence[str]) -> Row:
    if len(cells) > len(header):
        hint = "; put a reason that holds a comma into quotes"
        raise SurveyError(f"{path}:{line}: found {len(cells)} cells, the header has {len(header)}{hint}")
    row = dict.fromkeys(header, "") | dict(zip(header, (c.strip() for c in cells), strict=False))
    what, name, state = row["what"], row["id"], row.get("state") or EXCLUDED
    problem = name_problem(what, name)
    if problem is None and state not in (EXCLUDED, INCLUDED):
        problem = f"state: found {state!r}; {suggestion(state, (EXCLUDED, INCLUDED))}"
    if problem is not None:
        raise SurveyError(f"{path}:{line}: {problem}")
    at = _pixel(path, line, row)
    said = Exclusion(Name(what, name), row.get("reason", ""), row.get("author", ""), row.get("time", ""), line, at)
    return Row(state == EXCLUDED, said)


def _pixel(path: Path, line: int, row: Mapping[str, str]) -> tuple[float, float] | None:
    texts = [row.get("u_px", ""), row.get("v_px", "")]
    if not any(texts):
        return None
    try:
        u, v = (float(t) for t in texts)
    except ValueError as error:
        raise SurveyError(f"{path}:{line}: u_px, v_px: found {','.join(texts)!r}, expected two numbers") from error
    if not (abs(u) < 1e6 and abs(v) < 1e6):
        raise SurveyError(f"{path}:{line}: u_px, v_px: found {','.join(texts)!r}, no place in an image")
    return u, v


def in_force(rows: Sequence[Row], before: Mapping[Name, Exclusion] = MappingProxyType({})) -> dict[Name, Exclusion]:
    """What is excluded: of every name the last row counts, none where nothing was excluded ``before``."""
    found = dict(before)
    for row in rows:
        found.pop(row.exclusion.name, None)
        if row.excluded:
            found[row.exclusion.name] = row.exclusion
    return found


def appended(path: Path, rows: Sequence[Row]) -> str:
    """The file's text with rows added behind what is there, which stays to the letter, in the order of its columns.

    A column that the new rows need and the file has not is added to its header; the cells of old rows are then blank.
    """
    text = read_text(path) if path.is_file() else ""
    cells = [_cells(row) for row in rows]
    if not text.strip():
        header, text = list(EXCLUSIONS.columns), text + ",".join(EXCLUSIONS.columns) + "\n"
    else:
        line, header = next(_lines(path, text))
        needed = [name for name in EXCLUSIONS.columns
                  if name not in header and any(c[name] not in ("", EXCLUDED) for c in cells)]  # fmt: skip
        lines = text.splitlines(keepends=True)
        end = lines[line - 1][len(lines[line - 1].rstrip("\r\n")) :]
        lines[line - 1] = ",".join([lines[line - 1].rstrip("\r\n"), *needed]) + end
        header, text = [*header, *needed], "".join(lines)
    text += "" if text.endswith("\n") else "\n"
    return text + csv_text([one[name] for name in header] for one in cells)


def _cells(row: Row) -> dict[str, str]:
    """The cells of a row by their columns."""
    one = row.exclusion
    u, v = ("", "") if one.at is None else (repr(one.at[0]), repr(one.at[1]))
    state = EXCLUDED if row.excluded else INCLUDED
    said = {"state": state, "reason": one.reason, "author": one.author, "time": one.time}
    return {"what": one.name.what, "id": one.name.id, **said, "u_px": u, "v_px": v}
