"""Small pieces of HTML that look well in a notebook, on light and on dark ground."""

from collections.abc import Iterable, Sequence

from markupsafe import Markup

from survey.report.markup import part

Cell = str | tuple[str, str]
_OF = "notebook.html"


def heading(title: str, said: str = "") -> Markup:
    """A title with a remark; both are escaped."""
    return part("heading", title, said, of=_OF)


def verdict(colour: str, said: str) -> Markup:
    """What an adjustment comes to, in a colour of CSS."""
    return part("verdict", colour, said, of=_OF)


def html_table(columns: Sequence[str], rows: Iterable[Sequence[Cell]]) -> Markup:
    """A table of texts, first column left, others right; a cell may be a text with its style. Texts are escaped."""
    cells = [[cell if isinstance(cell, tuple) else (cell, "") for cell in row] for row in rows]
    return part("table", columns, cells, of=_OF)
