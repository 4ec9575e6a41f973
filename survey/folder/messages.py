"""Errors and texts as a terminal may show them."""

import unicodedata

from adjust.model.errors import SurveyError


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
    if text.isprintable():
        return text
    return "".join(c if _is_harmless(c) else c.encode("unicode_escape").decode() for c in text)


def _is_harmless(sign: str) -> bool:
    return sign.isprintable() or sign in "\n\t" or unicodedata.category(sign) == "Zs"  # narrow spaces
