"""An adjustment whose failure, or whose contradictions, are explained where the images can tell."""

from collections.abc import Callable
from dataclasses import replace

from adjust.model.errors import IndeterminateError, NotConvergedError, SurveyError
from adjust.model.result import Adjustment
from adjust.model.survey import Survey
from survey.project.epoch_names import separate_epochs


def checked(survey: Survey, run: Callable[[], Adjustment]) -> Adjustment:
    """``run()`` with the probable causes of what went wrong as its first warnings. Nothing is repaired.

    Raises what ``run`` raises, with the probable causes in front where there are any.
    """
    try:
        result = run()
    except SurveyError as error:
        apart, contradictions = separate_epochs(survey), _probable_causes(survey)
        if not apart and not contradictions:
            raise
        lines = "\n  - ".join(["probable cause:", *apart, *contradictions])
        said = _consequence(error) if contradictions else f"without that: {error}"
        raise SurveyError(f"{lines}\n{said}") from error
    warnings: tuple[str, ...] = ()
    if survey.tables:
        from adjust.diagnosis.table import sign_warnings  # here: a survey without a table starts without it

        warnings = sign_warnings(survey, result)
    if _contradicted(survey, result):
        # what does not fit may have spoilt the lenses too: then those that the images alone give
        causes = _probable_causes(survey, result) or _probable_causes(survey)
        warnings += tuple(c for c in causes if c not in warnings)
    return replace(result, warnings=tuple(f"probable cause: {c}" for c in warnings) + result.warnings)


def _consequence(error: SurveyError) -> str:
    """What failed. Directions and steps are those of a survey that contradicts itself: they would mislead."""
    if isinstance(error, IndeterminateError | NotConvergedError):
        return "mend that first: as it is, the observations lead to no solution"
    return f"without that: {error}"


def _probable_causes(survey: Survey, result: Adjustment | None = None) -> tuple[str, ...]:
    if not survey.tables:
        return ()
    from adjust.diagnosis.table import probable_causes  # here: as above

    return probable_causes(survey, result)


def _contradicted(survey: Survey, result: Adjustment) -> bool:
    """Whether residuals are too large, or whole images take no part."""
    test = result.global_test
    if test is not None and test.omega > test.upper:
        return True
    taking_part = sum(1 for b in result.survey.image_blocks if b.used is None or b.used.any())
    return taking_part < sum(1 for b in survey.image_blocks if b.used is None or b.used.any())
