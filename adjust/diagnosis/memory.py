"""Own start values of surveys that are tried, each found once."""

from adjust.graph.assembly import StartValues
from adjust.model.errors import SurveyError
from adjust.model.memory import remembered
from adjust.model.survey import Survey
from adjust.start import find_start


def own_start(survey: Survey) -> StartValues:
    """The survey's own start values. Raises as :func:`find_start`, each time."""
    found = remembered(_start_or_error, survey)
    if isinstance(found, StartValues):
        return found
    raise found


def _start_or_error(survey: Survey) -> StartValues | SurveyError | RuntimeError:
    try:
        return find_start(survey)
    except (SurveyError, RuntimeError) as error:  # GTSAM raises the latter where what is not meant fits nothing
        return error
