"""Errors and texts as a terminal may show them."""

import re
import unicodedata

from adjust.model.errors import SurveyError

_UNUSUAL = re.compile(r"[^\n\t -~]")


def message(error: SurveyError | OSError) -> str:
    """An error as its reader should see it."""
    if isinstance(error, OSError):
        where = "" if error.filename is None else f"{error.filename}: "
        text = f"{where}{error.strerror}; check the name, the permissions and the free space"
    else:
        text = str(error)
    return shown(text)


def shown(text: str) -> str:
    """A text with escapes for what is no letter: names and titles out of a file must not drive a terminal."""
    return _UNUSUAL.sub(lambda c: c[0] if _is_harmless(c[0]) else c[0].encode("unicode_escape").decode(), text)


def _is_harmless(sign: str) -> bool:
    return sign.isprintable() or unicodedata.category(sign) == "Zs"  # narrow spaces
