"""Readings of a table against the images: what is wrong with all of them, with single epochs, with an axis' sign."""

from collections.abc import Iterator

import numpy as np

from adjust.diagnosis.case import Case
from adjust.diagnosis.hypothesis import Finding, Hypothesis
from adjust.diagnosis.table.epochs import misread_epochs
from adjust.diagnosis.table.fit import TableFit, fit_table
from adjust.diagnosis.table.readings import misread_throughout, shared_mistake
from adjust.diagnosis.table.rereading import outlying
from adjust.diagnosis.table.signs import given_constants, sign_mistake, sign_of
from adjust.diagnosis.table.views import TableViews, table_views
from adjust.model.survey import Survey

_UNEXPLAINED_RAD = np.radians(1.0)
_TORN, _AGREE_RAD = 100.0, np.radians(0.1)
"""Scale of a fit's residuals from which most views contradict each other, unless their turns agree with the readings.

It is over the noise of image points, which may be far smaller than that of readings.
"""


def misread_tables(case: Case) -> Iterator[Hypothesis]:
    """Of every table the likeliest."""
    for views in table_views(case):
        verdict, as_given = shared_mistake(views)
        if verdict is not None:
            yield misread_throughout(case.survey, views, verdict)
            continue
        fit = _fit(views, as_given)
        if fit is not None:
            yield from misread_epochs(case.survey, views, fit)
            yield from _signs(case.survey, views, fit)


def _signs(survey: Survey, views: TableViews, fit: TableFit) -> Iterator[Hypothesis]:
    inner = {name: fit.mount_from_inner[i] for i, name in enumerate(views.inner_ids)}
    outer = {name[1]: fit.table_from_place[i] for i, name in enumerate(views.outer_ids) if name[0] == "target"}
    verdict = sign_mistake(views.table, (inner, outer), given_constants(survey, views.table))
    if verdict is not None:
        yield sign_of(survey, views.table, verdict)


def disagreeing_tables(survey: Survey) -> Iterator[Finding]:
    """Tables whose readings no way to read them brings together with the images; without them nothing can be tried."""
    for views in table_views(Case(survey)):
        verdict, as_given = shared_mistake(views)
        if verdict is None and as_given > _UNEXPLAINED_RAD and _fit(views, as_given) is None:
            table_id = views.table.table_id
            found = (f"table {table_id}: the turns between images and between readings disagree by "
                     f"{np.degrees(as_given):.1f} deg (median), and no exchange of the axes, unit or shift by one "
                     "epoch explains it")  # fmt: skip
            yield Finding("problem", "table misread", (table_id,), found,
                          "compare the epochs of table_angles.csv with those of the images")  # fmt: skip


def _fit(views: TableViews, as_given: float) -> TableFit | None:
    """Where most views agree; None where they do not. as_given: by how much turns differ from those read, median."""
    fit = fit_table(views)
    if fit is None or (fit.scale > _TORN and as_given > _AGREE_RAD):
        return None
    return fit if 2 * len(outlying(fit)) < len(views.poses) else None
