"""Boards that the images show in another size than ``survey.toml`` says, told once for each board."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from survey.project import Definition
from survey.project.targets import Checkerboard

if TYPE_CHECKING:  # brings in OpenCV
    from survey.detection import ImageReport

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
    return told


def _as_declared(size: tuple[int, int], board: Checkerboard) -> tuple[int, int]:
    """Columns and rows in the order that is nearer to the declared one: a quarter turn makes one the other."""
    a, b = size
    straight, turned = abs(a - board.columns) + abs(b - board.rows), abs(b - board.columns) + abs(a - board.rows)
    return (a, b) if straight <= turned else (b, a)


def _other_boards(reports: "Sequence[ImageReport]", board: Checkerboard) -> list[tuple[int, int]]:
    from survey.detection.checkerboard import other_board
    from survey.detection.gray import for_finding, gray_values, read_image

    sizes = []
    for report in [r for r in reports if r.status != "failed"][:: max(1, len(reports) // _LOOKED_AT)][:_LOOKED_AT]:
        gray = gray_values(read_image(report.path))
        size = other_board(gray, for_finding(gray), board)
        sizes += [] if size is None else [size]
    return sizes
