"""Why an adjustment failed, or what contradicts in it, where the images can tell. Nothing is repaired."""

from dataclasses import replace

from adjust.model.errors import IndeterminateError, NotConvergedError, SurveyError
from adjust.model.result import Adjustment
from adjust.model.survey import Survey
from survey.project.epoch_names import separate_epochs


def explained(survey: Survey, error: SurveyError) -> SurveyError:
    """What an adjustment of ``survey`` raised, with the probable causes in front where there are any."""
    apart, contradictions = separate_epochs(survey), _probable_causes(survey)
    if not apart and not contradictions:
        return error
    lines = "\n  - ".join(["probable cause:", *apart, *contradictions])
    said = _consequence(error) if contradictions else f"without that: {error}"
    return SurveyError(f"{lines}\n{said}")


def with_probable_causes(survey: Survey, result: Adjustment) -> Adjustment:
    """The adjustment of ``survey`` with the probable causes of what contradicts as its first warnings."""
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
