"""What pages are made of: numbers as people read them, and the components of the templates as functions of values.

Every text that is not markup already is escaped on its way into a page; the HTML stands in ``templates/`` alone.
"""

import json
import math
from collections.abc import Iterable, Sequence
from functools import cache
from itertools import zip_longest
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined, Template
from markupsafe import Markup

from survey.report.drawing import DARK
from survey.report.language import TURNING, esc, known, language, localised, plain_text, t, unturned
from survey.report.modules import looks

MISSING = "–"
_MOST_IN_FULL = 1e9  # a larger number of unknown size has a power of ten
MINUS = "−"
_HERE = Path(__file__).parent
_PLACE = Markup("%s")


@cache
def _environment() -> Environment:
    made = Environment(
        loader=FileSystemLoader(_HERE / "templates"), autoescape=True, undefined=StrictUndefined, trim_blocks=True,
        lstrip_blocks=True, finalize=plain_text,
    )  # fmt: skip
    made.globals |= {"t": t, "language": language}
    made.globals["parts"] = made.get_template("parts.html").module
    return made


@cache
def _module(template: str) -> Any:
    return _environment().get_template(template).module


def part(name: str, *values: object, of: str = "parts.html") -> Markup:
    """A piece of a page by its macro in the template ``of``."""
    return Markup(getattr(_module(of), name)(*values))


@cache
def _form(name: str, *values: object) -> str:
    """A piece that is there many times, with the :data:`_PLACE` of what differs; no value is data."""
    return str(part(name, *values))


def _filled(form: str, *values: object) -> Markup:
    """A form with what differs; what is no markup is escaped."""
    return Markup(form % tuple(map(esc, values)))


def element(tag: str, body: object, kind: str = "") -> Markup:
    """``body`` as an element, of class ``kind`` where one is given; neither tag nor kind is data."""
    return _filled(_form("element", tag, _PLACE, kind), body)


def joined(pieces: Iterable[object], between: object = "") -> Markup:
    """Pieces one after the other; what is no markup is escaped."""
    return esc(between).join(esc(x) for x in pieces)


def document(title: str, body: Markup, after: Markup | str = "") -> str:
    """A page: one HTML file that needs nothing but itself, on paper, on a phone, on a dark screen.

    On a dark screen the pictures follow the page; ``after`` follows the body's main part.
    """
    style = Markup(looks("colours", "parts") + (_HERE / "style.css").read_text(encoding="utf-8"))
    page: Template = _environment().get_template("document.html")
    values = {"title": title, "style": style, "colours": tuple(DARK.items()), "body": body, "after": after}
    return unturned(page.render(values), TURNING) + "\n"


def json_script(anchor: str, text: str) -> Markup:
    """JSON of :func:`json_of` as a block with an id."""
    return part("data", anchor, Markup(text))


def json_of(value: object) -> str:
    """Plain values as JSON, in a form that cannot end a script or become markup."""
    text = json.dumps(value, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    for sign in "<>&\u2028\u2029":
        text = text.replace(sign, f"\\u{ord(sign):04x}")
    return unturned(text, {sign: f"\\{shown}" for sign, shown in TURNING.items()})  # the script shows the escape


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
    text = f"{value + 0.0:.{digits}g}"  # adding zero takes the sign off a negative one
    if "e+" in text and abs(value) < _MOST_IN_FULL:
        return fixed(float(text), 0)
    return localised(text.replace("-", MINUS))


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


def p_text(p: float | None) -> str:
    """A probability; what underflows is not zero."""
    return "< 1e−300" if p is not None and p < 1e-300 else general(p, 2)


def with_sigma(value: float | None, sigma: float | None, typical: float | None = None) -> Markup:
    """A cell of two lines: the value, and its sigma below; ``typical`` sets the decimals of a column or row."""
    decimals = decimals_for(sigma)
    if decimals is None:
        return _below(value_text(value, typical), t("held"))
    decimals = max(decimals_for(typical) or 0, 0 if typical else decimals)
    below = fixed(sigma, decimals) if sigma and sigma >= 2 * 10.0**-decimals else sigma_text(sigma)
    return _below(fixed(value, decimals), f"± {below}")


def _below(value: str, said: str) -> Markup:
    return _filled(_form("below", _PLACE, _PLACE), value, said)


def count(value: int) -> str:
    """A whole number with thin spaces between thousands."""
    return f"{value:,}".replace(",", "\u2009")


def more(n: int) -> Markup:
    """How many more ``solution.json`` holds than are shown, after a space; nothing where it is none."""
    return " " + t("{n} more in solution.json.", n=count(n)) if n > 0 else Markup()


def code(text: object) -> Markup:
    """A name as it stands in files."""
    return element("code", text)


def note(body: object) -> Markup:
    """A paragraph of small print."""
    return element("p", body, "note")


def pill(kind: str, text: str) -> Markup:
    """A word on a coloured ground; ``kind`` is good, warn, bad, soft, plain or quiet."""
    return element("span", text, f"pill {kind}")


def heads(columns: Iterable[str]) -> list[tuple[str, str]]:
    """Headings in the language with their side: one that starts with ``<`` is of text and set left, others right."""
    return [(known(c.removeprefix("<")), "l" if c.startswith("<") else "r") for c in columns]


def table(
    columns: Sequence[str], rows: Iterable[Sequence[object]], caption: str = "", row_classes: Sequence[str] = ()
) -> Markup:
    """A table with columns as of :func:`heads`; a heading that is data is escaped first."""
    named = heads(columns)
    cells = _form("cells", tuple(side for _, side in named), _PLACE)
    return part("table", named, zip_longest(row_classes, (_filled(cells, *row) for row in rows), fillvalue=""), caption)


def section(anchor: str, title: str, body: Markup | str, note: str = "") -> Markup:
    """A section of the page; empty where there is nothing to show. ``title`` is English."""
    return part("section", anchor, t(title), body, note) if body else Markup()


def listed(items: Iterable[object], kind: str = "problems") -> Markup:
    """A list of points; nothing where there is none."""
    items = list(items)
    return part("listed", items, kind) if items else Markup()


def definition(pairs: Iterable[tuple[object, object]]) -> Markup:
    """A list of names and values."""
    return part("definition", list(pairs))


def figures(drawn: Iterable[Markup], kind: str = "figures") -> Markup:
    """Pictures side by side; nothing where there is none."""
    drawn = list(drawn)
    return part("figures", drawn, kind) if drawn else Markup()
