"""Start values for a whole survey from its observations alone."""

from adjust.start.result import Start
from adjust.start.search import find_start, turns_of_views

__all__ = ["Start", "find_start", "turns_of_views"]
