"""Places of a project, as the page, the report and the terminal name them: ``#image=X/hX05``, ``#point=B07``."""

import re
from urllib.parse import quote

ANCHORED = ("image", "obs", "point", "reading", "param", "camera", "epoch", "target", "group", "station", "table")
"""Kinds of things that have a place."""
_IN_MESSAGE = re.compile(r"camera '?(?P<camera>[^\s',]+)'?(?: at|,) epoch '?(?P<epoch>[^\s',:]+)|"
                         r"table (?P<table>\S+), epoch (?P<read>[^\s,:]+)|"
                         r"images/(?P<image>[^\s/:]+/[^\s/:,]+?)(?:\.[A-Za-z]+)?(?=[\s:,]|$)")  # fmt: skip


def anchor(kind: str, text: str) -> str:
    """The part of an address that names a thing: ``#image=X/hX05``."""
    return f"#{kind}={quote(text, safe='/:@,.-_')}"


def anchors_in(text: str) -> list[str]:
    """The places that a message of an adjustment names, each once."""
    return list(dict.fromkeys(
        anchor("reading", f"table_angles:{m['table']}/{m['read']}") if m["table"] else
        anchor("image", m["image"] or f"{m['camera']}/{m['epoch']}") for m in _IN_MESSAGE.finditer(text)
    ))  # fmt: skip
