"""What was found out about a survey, or one that is like it: whoever asks again is told the same."""

from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TypeVar, cast

from adjust.graph.assembly import StartValues
from adjust.model.errors import SurveyError
from adjust.model.survey import Survey
from adjust.start import find_start

_T = TypeVar("_T")
_remembered: ContextVar[dict[object, object] | None] = ContextVar("remembered", default=None)


@contextmanager
def remembering() -> Iterator[None]:
    """Inside, and inside of what is inside, nothing is found out twice."""
    if _remembered.get() is not None:
        yield
        return
    token = _remembered.set({})
    try:
        yield
    finally:
        _remembered.reset(token)


def remembered(find: Callable[..., _T], *of: Hashable) -> _T:
    """``find(*of)``, or what it gave for the same before; surveys are told apart by identity."""
    known = _remembered.get()
    if known is None:
        return find(*of)
    if (find, of) not in known:
        known[find, of] = find(*of)
    return cast(_T, known[find, of])


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
