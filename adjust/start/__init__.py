"""Start values for a whole survey from its observations alone, and which of several an adjustment begins with.

Closed forms, how knowledge spreads from frame to frame, readings by themselves, and image points that no start fits.
What is solved to the end belongs to :mod:`adjust.adjustment`.
"""

from adjust.start.search import Start, find_start, turns_of_views

__all__ = ["Start", "find_start", "turns_of_views"]
