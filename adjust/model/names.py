"""The order of names, as people count: epochs and points that are numbered."""

import re

_PARTS = re.compile(r"\d+|\D+")


def natural_key(name: str) -> tuple[tuple[int, int, str], ...]:
    """Key that sorts ``e2`` before ``e10``; different names have different keys."""
    # 4000: the interpreter refuses to take longer numbers apart
    return tuple([(0, int(part[:4000]), part) if part.isdecimal() else (1, 0, part) for part in _PARTS.findall(name)])
