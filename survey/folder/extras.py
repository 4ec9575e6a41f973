"""Libraries that come with an extra of the package."""

from importlib import import_module
from typing import Any

from adjust.model.errors import SurveyError


def library(name: str, extra: str, who: str, error: type[SurveyError] = SurveyError) -> Any:
    """The library of that name for ``who`` ("data frames need pandas"). Raises ``error`` where it is not installed."""
    try:
        return import_module(name)
    except ImportError as cause:
        raise error(f"{who}, which is not installed; install it: pip install 'labsurvey[{extra}]'") from cause
