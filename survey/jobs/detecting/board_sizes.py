"""Targets that the images show otherwise than ``survey.toml`` says: size, dictionary, print; told once for each."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from survey.project import Definition
from survey.project.targets import Charuco, Checkerboard, MarkerBlock, MarkerGrid

if TYPE_CHECKING:  # brings in OpenCV
    from survey.detection import ImageReport
    from survey.detection.markers import OtherMarkers

_LOOKED_AT = 3  # images in which a board of another size is looked for where the one wanted is in none


def wrong_sizes(folder: Path, definition: Definition, reports: "Sequence[ImageReport]") -> dict[str, str]:
    """By target id what is wrong with its numbers of columns and rows, and the keys to change; mostly empty."""
    boards = {t: k for t, k in definition.target_kinds.items() if isinstance(k, Checkerboard)}
    known = {frozenset((k.columns, k.rows)) for k in boards.values()}
    told = {}
    for target_id, board in boards.items():
        mine = [r for r in reports if target_id in r.detections]
        found = sum(len(r.detections[target_id]) > 0 for r in mine)
        seen = [size for r in mine if (size := r.detections[target_id].other_size) is not None]
        seen = seen or ([] if found else _other_boards(mine, board))
        sizes = Counter(_as_declared(size, board) for size in seen if frozenset(size) not in known)
        if sizes.total() > found:
            (columns, rows), _ = max(sizes.items(), key=lambda item: (item[1], sum(item[0])))
            told[target_id] = (
                f"{folder}/survey.toml: [targets.{target_id}] says columns = {board.columns}, rows = {board.rows}, but "
                f"the images show a board of {columns} x {rows} inner corners; set columns = {columns}, rows = {rows} "
                "(inner corners are counted, not squares)"
            )
    return told | _other_markers(folder, definition, reports)


def _other_markers(folder: Path, definition: Definition, reports: "Sequence[ImageReport]") -> dict[str, str]:
    """Of targets with markers that were found in no image: what is in the images instead."""
    told = {}
    for target_id, kind in definition.target_kinds.items():
        if not isinstance(kind, Charuco | MarkerGrid | MarkerBlock):
            continue
        mine = [r for r in reports if target_id in r.detections and r.status != "failed"]
        if not mine or any(len(r.detections[target_id]) for r in mine):
            continue
        from survey.detection.gray import for_finding, gray_values, read_image
        from survey.detection.markers import other_markers

        some = mine[:: max(1, len(mine) // _LOOKED_AT)][:_LOOKED_AT]
        seen = [o for r in some if (o := other_markers(for_finding(gray_values(read_image(r.path))), kind)) is not None]
        if seen:
            best = max(seen, key=lambda o: o.n)
            told[target_id] = f"{folder}/survey.toml: [targets.{target_id}] {_said(kind.dictionary, best)}"
    return told


def _said(declared: str, seen: "OtherMarkers") -> str:
    if seen.legacy is not None:
        return (f"begins with the other colour in the images (a board of {'before' if seen.legacy else 'after'} OpenCV "
                f"4.6); set legacy = {str(seen.legacy).lower()}")  # fmt: skip
    other = seen.dictionary != declared.upper().removeprefix("DICT_")
    parts = [f'says dictionary = "{declared}", but the images show markers of {seen.dictionary}; set dictionary = '
             f'"{seen.dictionary}"'] if other else []  # fmt: skip
    if seen.inverted:
        parts.append("is printed with black and white exchanged: its markers are found in the negative; print it anew, "
                     "or invert the images")  # fmt: skip
    if seen.mirrored:
        parts.append("is mirrored in the images: its markers are found in the mirror image; mirror the images back, or "
                     "print it anew")  # fmt: skip
    return "; and ".join(parts)


def _as_declared(size: tuple[int, int], board: Checkerboard) -> tuple[int, int]:
    """Columns and rows in the order that is nearer to the declared one: a quarter turn makes one the other."""
    a, b = size
    straight, turned = abs(a - board.columns) + abs(b - board.rows), abs(b - board.columns) + abs(a - board.rows)
    return (a, b) if straight <= turned else (b, a)


def _other_boards(reports: "Sequence[ImageReport]", board: Checkerboard) -> list[tuple[int, int]]:
    from survey.detection.checkerboard import other_boards
    from survey.detection.gray import for_finding, gray_values, read_image

    some = [r for r in reports if r.status != "failed"][:: max(1, len(reports) // _LOOKED_AT)][:_LOOKED_AT]
    grays = [gray_values(read_image(report.path)) for report in some]
    return other_boards([(gray, for_finding(gray)) for gray in grays], board)
