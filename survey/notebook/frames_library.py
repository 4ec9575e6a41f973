"""pandas, which only notebooks need."""

from typing import Any

from adjust.model.errors import SurveyError


def pandas() -> Any:
    """The library. Raises SurveyError where it is not installed."""
    try:
        import pandas as library
    except ImportError as error:
        raise SurveyError(
            "data frames need pandas, which is not installed; install it: pip install 'labsurvey[notebook]'"
        ) from error
    return library
