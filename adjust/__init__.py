"""The mathematics of a photogrammetric survey adjustment: values in, values out.

    adjustment = adjust.solve(survey)     a solved survey with its precision, from start values that are found
    adjustment.estimates["point", "B3"]   value, covariance, status
    adjustment.precision.joint([...])     joint covariances

The names in ``__all__`` stay; everything is loaded when it is first used.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from adjust.adjustment import AdjustOptions
    from adjust.adjustment import adjust as solve
    from adjust.epochs.congruence import joint_congruence
    from adjust.epochs.joint import joint_survey
    from adjust.model.errors import IndeterminateError, NotConvergedError, SurveyError
    from adjust.model.result import Adjustment, Estimate
    from adjust.model.survey import Datum, Survey
    from adjust.precision.other_datum import in_datum
    from adjust.relay.session import NetworkSession

_PLACES = {
    "AdjustOptions": ("adjust.adjustment", "AdjustOptions"),
    "Adjustment": ("adjust.model.result", "Adjustment"),
    "Datum": ("adjust.model.survey", "Datum"),
    "Estimate": ("adjust.model.result", "Estimate"),
    "IndeterminateError": ("adjust.model.errors", "IndeterminateError"),
    "NotConvergedError": ("adjust.model.errors", "NotConvergedError"),
    "NetworkSession": ("adjust.relay.session", "NetworkSession"),
    "Survey": ("adjust.model.survey", "Survey"),
    "SurveyError": ("adjust.model.errors", "SurveyError"),
    "in_datum": ("adjust.precision.other_datum", "in_datum"),
    "joint_congruence": ("adjust.epochs.congruence", "joint_congruence"),
    "joint_survey": ("adjust.epochs.joint", "joint_survey"),
    "solve": ("adjust.adjustment", "adjust"),
}

__all__ = [
    "AdjustOptions",
    "Adjustment",
    "Datum",
    "Estimate",
    "IndeterminateError",
    "NetworkSession",
    "NotConvergedError",
    "Survey",
    "SurveyError",
    "in_datum",
    "joint_congruence",
    "joint_survey",
    "solve",
]


def __getattr__(name: str) -> Any:
    """A public name, loaded now."""
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, attribute = _PLACES[name]
    value = getattr(import_module(module), attribute)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Public names first."""
    return sorted(__all__)
