"""Everything that is told beforehand, in the order in which it is to be mended."""

from collections.abc import Iterator

import numpy as np

from adjust.design.expectation import expect, weak_directions
from adjust.diagnosis.beforehand.images import moved, pictured
from adjust.diagnosis.beforehand.observations import observed
from adjust.diagnosis.beforehand.values import valued
from adjust.diagnosis.case import Case
from adjust.diagnosis.hypothesis import Finding
from adjust.model.errors import IndeterminateError, SurveyError
from adjust.model.frozen import frozen
from adjust.model.result import Adjustment
from adjust.model.survey import Survey
from adjust.start import find_start
from adjust.statistics.outliers.supported import supported

_WEAK = 1000.0
"""Times worse together than alone: then a thousandth of an error of one shows as another."""
_FOCAL, _PERCENT = ("fx", "c", "ck"), 1.0
"""A length at a distance is wrong by as many per cent as the focal length."""


@frozen(eq=False)
class Beforehand:
    """All findings, problems first. expected: precision at the start values, None where there is none."""

    findings: tuple[Finding, ...]
    expected: Adjustment | None


def look_beforehand(survey: Survey) -> Beforehand:
    """Everything that is looked at, in the order in which it is to be mended."""
    case = Case(survey)
    expected, undetermined = _expected(survey)
    every = [*undetermined, *observed(survey, expected), *moved(case), *pictured(case), *valued(case, expected)]
    every += [] if expected is None else [*_weak(expected), *_weak_lenses(expected)]
    return Beforehand(tuple(sorted(every, key=lambda f: f.level != "problem")), expected)


def _expected(survey: Survey) -> tuple[Adjustment | None, list[Finding]]:
    """The precision to be expected, or why there is none."""
    start = None
    survey = supported(survey)[0]
    try:
        start = find_start(survey)
        return expect(survey, start), []
    except SurveyError as error:
        if start is not None and isinstance(error, IndeterminateError):
            found = Finding("problem", "undetermined", (), str(error), "measure or fix what is named")
        else:
            found = Finding("problem", "no start values", (), str(error), "mend that first")
        return None, [found]


def _weak(expected: Adjustment) -> Iterator[Finding]:
    if expected.redundancy <= 0:
        yield Finding("problem", "no redundancy", (), f"{expected.n_observations} observations for "
                      f"{expected.n_unknowns} unknowns: nothing checks them", "measure more")  # fmt: skip
    for direction in weak_directions(expected, 3, _WEAK):
        parts = [f"{a} {c}" for a, c, _ in direction.parts[:4]]
        yield Finding("weak", "weak geometry", tuple(parts), f"{', '.join(parts)} replace each other "
                      f"({direction.factor:.0f} times worse together than each alone)",
                      "hold one of them, give it a prior, or measure from other directions")  # fmt: skip


def _weak_lenses(expected: Adjustment) -> Iterator[Finding]:
    """Focal lengths whose sigma is more than a per cent."""
    for camera in expected.survey.cameras:
        estimate = expected.estimates.get(("lens", camera.camera_id))
        if estimate is None:
            continue
        for name in (n for n in _FOCAL if n in camera.lens.free):
            i = estimate.components.index(name)
            sigma, value = np.sqrt(max(estimate.cov[i, i], 0.0)), abs(np.asarray(estimate.value)[i])
            percent = 100.0 * float(sigma / value)
            if percent > _PERCENT:
                found = f"camera {camera.camera_id}: {name} will have a sigma of {percent:.2g} %"
                yield Finding("weak", "focal length hardly known", (camera.camera_id,), found,
                              "show it targets tilted by 20 to 50 deg, or give a prior")  # fmt: skip
