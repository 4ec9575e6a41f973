"""The mathematics of a photogrammetric survey adjustment: values in, values out.

    adjustment = adjust.solve(survey)     a solved survey with its precision, from start values that are found
    adjustment.estimates["point", "B3"]   value, covariance, status
    adjustment.precision.joint([...])     joint covariances

The names in ``__all__`` stay; everything is loaded when it is first used.
"""

from typing import TYPE_CHECKING

from adjust.model.loading import lazily

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
    "AdjustOptions": "adjust.adjustment",
    "Adjustment": "adjust.model.result",
    "Datum": "adjust.model.survey",
    "Estimate": "adjust.model.result",
    "IndeterminateError": "adjust.model.errors",
    "NotConvergedError": "adjust.model.errors",
    "NetworkSession": "adjust.relay.session",
    "Survey": "adjust.model.survey",
    "SurveyError": "adjust.model.errors",
    "in_datum": "adjust.precision.other_datum",
    "joint_congruence": "adjust.epochs.congruence",
    "joint_survey": "adjust.epochs.joint",
    "solve": "adjust.adjustment:adjust",
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

__getattr__ = lazily(globals(), _PLACES)


def __dir__() -> list[str]:
    """Public names first."""
    return sorted(__all__)
