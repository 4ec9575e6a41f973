"""What a survey cannot give, told before it is adjusted: from its observations, single views and its start values.

Nothing is adjusted: sigmas are those that the observation equations have at the start values
(:func:`adjust.design.expectation.expect`). What an adjustment contradicts belongs to the rooms beside this one.
"""

from adjust.diagnosis.beforehand.images import coverage
from adjust.diagnosis.beforehand.look import Beforehand, look_beforehand
from adjust.diagnosis.hypothesis import Finding

__all__ = ["Beforehand", "Finding", "coverage", "look_beforehand"]
