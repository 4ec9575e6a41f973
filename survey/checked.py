"""An adjustment whose failure, or whose contradictions, are explained where the images can tell."""

from collections.abc import Callable
from dataclasses import replace

from adjust.errors import SurveyError
from adjust.model import Survey
from adjust.result import Adjustment
from adjust.table_checks import probable_causes, sign_warnings
from survey.epoch_names import separate_epochs


def checked(survey: Survey, run: Callable[[], Adjustment]) -> Adjustment:
    """``run()`` with the probable causes of what went wrong as its first warnings. Nothing is repaired.

    Raises what ``run`` raises, with the probable causes in front where there are any.
    """
    try:
        result = run()
    except SurveyError as error:
        causes = separate_epochs(survey) + probable_causes(survey)
        if not causes:
            raise
        lines = "\n  - ".join(["probable cause:", *causes])
        raise SurveyError(f"{lines}\nwithout that: {error}") from error
    causes = sign_warnings(survey, result)
    if _contradicted(survey, result):
        causes += tuple(c for c in probable_causes(survey, result) if c not in causes)
    return replace(result, warnings=tuple(f"probable cause: {c}" for c in causes) + result.warnings)


def _contradicted(survey: Survey, result: Adjustment) -> bool:
    """Whether residuals are too large, or whole images take no part."""
    test = result.global_test
    if test is not None and test.omega > test.upper:
        return True
    taking_part = sum(1 for b in result.survey.image_blocks if b.used is None or b.used.any())
    return taking_part < sum(1 for b in survey.image_blocks if b.used is None or b.used.any())
