"""Design: what a survey will tell before it is measured, and what to measure next."""

from adjust.design.candidates import Candidate, with_candidates
from adjust.design.exact import exact
from adjust.design.expectation import WeakDirection, expect, group_redundancy, shared_names, weak_directions
from adjust.design.prediction import Predictor, Seeing, predict
from adjust.design.selection import Component, Gain, Selection, components_of, select
from adjust.design.tolerances import Budget, Tolerance, budget, tolerances
from adjust.design.trials import Trials, run_trials

__all__ = [
    "Budget",
    "Candidate",
    "Component",
    "Gain",
    "Predictor",
    "Seeing",
    "Selection",
    "Tolerance",
    "Trials",
    "WeakDirection",
    "budget",
    "components_of",
    "exact",
    "expect",
    "group_redundancy",
    "predict",
    "run_trials",
    "select",
    "shared_names",
    "tolerances",
    "weak_directions",
    "with_candidates",
]
