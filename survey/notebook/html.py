"""Small pieces of HTML that look well in a notebook, on light and on dark ground."""

from collections.abc import Iterable, Sequence

from survey.report.markup import esc

_CELL = "padding:2px 9px;text-align:{side};white-space:nowrap;{more}"
Cell = str | tuple[str, str]


def heading(title: str, said: str = "") -> str:
    """A title with a remark; both are escaped."""
    return f'<div style="margin:4px 0"><b>{esc(title)}</b> <span style="opacity:.7">{esc(said)}</span></div>'


def html_table(columns: Sequence[str], rows: Iterable[Sequence[Cell]]) -> str:
    """A table of texts, first column left, others right; a cell may be a text with its style. Texts are escaped."""
    head = "".join(f'<th style="{_style(i)}">{esc(c)}</th>' for i, c in enumerate(columns))
    body = "".join(f"<tr>{''.join(_td(i, cell) for i, cell in enumerate(row))}</tr>" for row in rows)
    return f'<table style="border-collapse:collapse"><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>'


def _style(i: int, more: str = "") -> str:
    return _CELL.format(side="left" if i == 0 else "right", more=more)


def _td(i: int, cell: Cell) -> str:
    text, more = cell if isinstance(cell, tuple) else (cell, "")
    return f'<td style="{_style(i, more)}">{esc(text)}</td>'
