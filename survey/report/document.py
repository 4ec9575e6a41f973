"""A page of the program: one HTML file that needs nothing but itself, on paper, on a phone, on a dark screen."""

from pathlib import Path

from survey.report.drawing import dark_rules
from survey.report.language import language
from survey.report.markup import esc


def page_style() -> str:
    """The style sheet of all pages; on a dark screen the pictures follow the page, on paper nothing is dark."""
    style = Path(__file__).with_name("style.css").read_text(encoding="utf-8")
    return f"{style}@media screen and (prefers-color-scheme: dark) {{ {dark_rules()} }}\n"


def document(title: str, body: str, after: str = "") -> str:
    """The page with ``body`` as ready HTML; ``title`` is text, ``after`` what follows the body's main part."""
    return (
        f'<!doctype html>\n<html lang="{language()}"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{esc(title)}</title><style>{page_style()}</style></head>\n<body><main>{body}</main>{after}"
        "</body></html>\n"
    )
