"""What pages are made of: numbers as people read them, and components as functions of values.

Every text that is not markup already is escaped on its way into a page.
"""

import json
import math
from collections.abc import Iterable, Sequence
from itertools import zip_longest
from pathlib import Path

from markupsafe import Markup

from survey.report.drawing import DARK
from survey.report.language import TURNING, esc, known, language, localised, t, unturned
from survey.report.modules import looks

MISSING = "–"
_MOST_IN_FULL = 1e9  # a larger number of unknown size has a power of ten
MINUS = "−"
_HERE = Path(__file__).parent
_DOCUMENT = """\
<!doctype html>
<html lang="{}"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">\
<title>{}</title><style>{}@media screen and (prefers-color-scheme: dark) {{ {} }}
</style></head>
<body><main>{}</main>{}</body></html>
"""


def filled(form: str, *values: object) -> Markup:
    """HTML with ``{}`` for each value; what is no markup is escaped. The form is never data."""
    return Markup(form.format(*map(esc, values)))


def each(form: str, rows: Iterable[Sequence[object]]) -> Markup:
    """A form filled with every row, one after the other."""
    return Markup("".join(filled(form, *row) for row in rows))


def joined(pieces: Iterable[object], between: object = "") -> Markup:
    """Pieces one after the other; what is no markup is escaped."""
    return esc(between).join(esc(x) for x in pieces)


def _of_class(kind: str) -> Markup:
    return filled(' class="{}"', kind) if kind else Markup()


def element(tag: str, body: object, kind: str = "") -> Markup:
    """``body`` as an element, of class ``kind`` where one is given; neither tag nor kind is data."""
    return filled("<{0}{1}>{2}</{0}>", tag, _of_class(kind), body)


def document(title: str, body: Markup, after: Markup | str = "") -> str:
    """A page: one HTML file that needs nothing but itself, on paper, on a phone, on a dark screen.

    On a dark screen the pictures follow the page; ``after`` follows the body's main part.
    """
    style = Markup(looks("colours", "parts") + (_HERE / "style.css").read_text(encoding="utf-8"))
    dark = each('svg [{0}="{1}"]{{{0}:{2}}}', ((at, *pair) for pair in DARK.items() for at in ("fill", "stroke")))
    return unturned(filled(_DOCUMENT, language(), title, style, dark, body, after), TURNING)


def json_script(anchor: str, text: str) -> Markup:
    """JSON of :func:`json_of` as a block with an id."""
    return filled('<script type="application/json" id="{}">{}</script>', anchor, Markup(text))


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
        return below(value_text(value, typical), t("held"))
    decimals = max(decimals_for(typical) or 0, 0 if typical else decimals)
    shown = fixed(sigma, decimals) if sigma and sigma >= 2 * 10.0**-decimals else sigma_text(sigma)
    return below(fixed(value, decimals), f"± {shown}")


def below(value: object, said: object) -> Markup:
    """A value with what is said of it in small print below."""
    return filled('{}<span class="s">{}</span>', value, said)


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
    titles = each('<{0} class="{1}">{2}</{0}>', (("th" if text else "td", side, text) for text, side in named))
    cells = "".join(f'<td class="{side}">{{}}</td>' for _, side in named)
    shown = zip_longest(map(_of_class, row_classes), (filled(cells, *row) for row in rows), fillvalue=Markup())
    return filled(
        '<div class="t"><table>{}<thead><tr>{}</tr></thead><tbody>{}</tbody></table></div>',
        element("caption", caption) if caption else "", titles, each("<tr{}>{}</tr>", shown),
    )  # fmt: skip


def section(anchor: str, title: str, body: Markup | str, note: str = "") -> Markup:
    """A section of the page; empty where there is nothing to show. ``title`` is English."""
    if not body:
        return Markup()
    said = element("p", note, "note") if note else ""
    return filled('<section id="{}"><h2>{}</h2>{}{}</section>', anchor, t(title), said, body)


def listed(items: Iterable[object], kind: str = "problems") -> Markup:
    """A list of points; nothing where there is none."""
    points = each("<li>{}</li>", ((item,) for item in items))
    return element("ul", points, kind) if points else points


def definition(pairs: Iterable[tuple[object, object]]) -> Markup:
    """A list of names and values."""
    return element("dl", each("<div><dt>{}</dt><dd>{}</dd></div>", pairs))


def figures(drawn: Iterable[Markup], kind: str = "figures") -> Markup:
    """Pictures side by side; nothing where there is none."""
    shown = each("<figure>{}</figure>", ((svg,) for svg in drawn))
    return element("div", shown, kind) if shown else shown


def details(summary: object, body: object, opened: bool = False) -> Markup:
    """What opens at a click."""
    return filled("<details{}><summary>{}</summary>{}</details>", " open" if opened else "", summary, body)


def cards(values: Iterable[tuple[object, object]]) -> Markup:
    """Large numbers with their names."""
    return element("div", each("<div><b>{}</b><span>{}</span></div>", values), "cards")


def verdict(kind: str, word: object, said: object) -> Markup:
    """What it comes to, on a ground of its colour."""
    return filled('<div class="verdict {}"><b>{}</b><span>{}</span></div>', kind, word, said)


def header(kind: object, title: object, meta: object) -> Markup:
    """How a page begins."""
    return filled('<header><p class="meta">{}</p><h1>{}</h1><p class="meta">{}</p></header>', kind, title, meta)


def nav(sections: Iterable[tuple[str, object]]) -> Markup:
    """Links to sections by their anchors."""
    return element("nav", each('<a href="#{}">{}</a>', sections))


def lines(texts: Iterable[object]) -> Markup:
    """Lines one below the other."""
    return joined(texts, Markup("<br>"))
