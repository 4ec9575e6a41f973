"""The order of names, as people count: epochs and points that are numbered."""

import re


def natural_key(name: str) -> tuple[tuple[int, int, str], ...]:
    """Key that sorts ``e2`` before ``e10``; different names have different keys."""
    parts = re.split(r"(\d+)", name)
    # 4000: the interpreter refuses to take longer numbers apart
    numbers = [(0, int(part[:4000]), part) if part.isdecimal() else (1, 0, part) for part in parts if part]
    return tuple(numbers)
