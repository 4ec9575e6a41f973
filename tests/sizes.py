"""How large statistical tests are: a tenth by default, whole with ``pytest --whole``."""

whole = False  # set by tests/conftest.py before any test module is imported


def size(n: int, least: int = 1) -> int:
    """Repetitions of a test that is meant to have ``n``; never fewer than ``least``."""
    return n if whole else max(least, n // 10)
