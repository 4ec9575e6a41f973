"""Pieces of HTML: escaped text, numbers as people read them, tables."""

import html
import math
from collections.abc import Iterable, Sequence
from typing import Any

from survey.report.language import known, localised, t

MISSING = "–"
MINUS = "−"


TURNING = {ord(sign): f"\\u{ord(sign):04x}" for sign in "\u061c\u200e\u200f\u202a\u202b\u202c\u202d\u202e"
           "\u2066\u2067\u2068\u2069"}  # fmt: skip
"""Signs that let what follows them be shown in another order, with what stands for them on a page."""


def esc(value: object) -> str:
    """Text that cannot be taken for markup, and shows its characters in the order in which they stand."""
    return html.escape(str(value).translate(TURNING), quote=True)


def fixed(value: float | None, decimals: int) -> str:
    """A number with its decimals, a real minus sign; a dash where there is none."""
    if value is None or not math.isfinite(value):
        return MISSING
    text = f"{value:.{decimals}f}"
    if float(text) == 0.0:
        text = text.lstrip("-")
    return localised(text.replace("-", MINUS))


def general(value: float | None, digits: int = 4) -> str:
    """A number of unknown size with its significant digits."""
    if value is None or not math.isfinite(value):
        return MISSING
    # adding zero takes the sign off a negative one
    return localised(f"{value + 0.0:.{digits}g}".replace("-", MINUS))


def decimals_for(sigma: float | None, most: int = 7) -> int | None:
    """Decimals that show two digits of a sigma; None where there is no sigma."""
    if not sigma or not math.isfinite(sigma):
        return None
    return min(max(1 - math.floor(math.log10(sigma)), 0), most)


def value_text(value: float | None, sigma: float | None) -> str:
    """A value with the decimals that its sigma deserves; in full where it has none."""
    decimals = decimals_for(sigma)
    return general(value, 9) if decimals is None else fixed(value, decimals)


def sigma_text(sigma: float | None) -> str:
    """A sigma with two significant digits."""
    decimals = decimals_for(sigma)
    return MISSING if decimals is None else fixed(sigma, decimals)


def with_sigma(value: float | None, sigma: float | None, typical: float | None = None) -> str:
    """A cell of two lines: the value, and its sigma below; ``typical`` sets the decimals of a column or row."""
    decimals = decimals_for(sigma)
    if decimals is None:
        return f'{value_text(value, typical)}<span class="s">{t("held")}</span>'
    decimals = max(decimals_for(typical) or 0, 0 if typical else decimals)
    below = fixed(sigma, decimals) if sigma and sigma >= 2 * 10.0**-decimals else sigma_text(sigma)
    return f'{fixed(value, decimals)}<span class="s">± {below}</span>'


def count(value: int) -> str:
    """A whole number with thin spaces between thousands."""
    return f"{value:,}".replace(",", "\u2009")


def pill(kind: str, text: str) -> str:
    """A word on a coloured ground; ``kind`` is good, warn, bad or quiet."""
    return f'<span class="pill {kind}">{esc(text)}</span>'


def table(
    columns: Sequence[str], rows: Iterable[Sequence[str]], caption: str = "", row_classes: Sequence[str] = ()
) -> str:
    """A table of ready cells. A column whose heading starts with ``<`` holds text and is set left, the others right."""
    left = [c.startswith("<") for c in columns]
    heads = "".join(
        f'<th class="{"l" if a else "r"}">{known(c.removeprefix("<"))}</th>' for c, a in zip(columns, left, strict=True)
    )
    body = []
    for i, row in enumerate(rows):
        cells = "".join(f'<td class="{"l" if a else "r"}">{c}</td>' for c, a in zip(row, left, strict=True))
        kind = f' class="{row_classes[i]}"' if i < len(row_classes) and row_classes[i] else ""
        body.append(f"<tr{kind}>{cells}</tr>")
    note = f"<caption>{caption}</caption>" if caption else ""
    return f'<div class="t"><table>{note}<thead><tr>{heads}</tr></thead><tbody>{"".join(body)}</tbody></table></div>'


def section(anchor: str, title: str, body: str, note: str = "") -> str:
    """A section of the page; empty where there is nothing to show. ``title`` is English, ``note`` ready."""
    if not body:
        return ""
    lead = f'<p class="note">{note}</p>' if note else ""
    return f'<section id="{anchor}"><h2>{esc(t(title))}</h2>{lead}{body}</section>'


def definition(pairs: Iterable[tuple[str, Any]]) -> str:
    """A list of names and ready values."""
    return "<dl>" + "".join(f"<div><dt>{esc(k)}</dt><dd>{v}</dd></div>" for k, v in pairs) + "</dl>"
