"""Components of unknowns by pattern, as people name them: ``lens.X.fx``, ``head.camera_X``, ``point.B*``."""

from collections.abc import Sequence
from fnmatch import fnmatchcase

from adjust.design import Component, components_of, shared_names
from adjust.model.errors import SurveyError
from adjust.model.result import Adjustment
from adjust.model.survey import Survey
from adjust.precision.precision import precision_of
from survey.folder.text import suggestion
from survey.planning.plan_file import Requirement

EVERYTHING = "everything"


def wanted_components(expected: Adjustment, patterns: Sequence[str]) -> tuple[Component, ...]:
    """The components that match any of the patterns; all that are not of one epoch alone where none is given.

    Raises SurveyError for a pattern that matches nothing.
    """
    shared = components_of(expected, shared_names(expected))
    if not patterns or EVERYTHING in patterns:
        return shared
    every = components_of(expected, tuple(precision_of(expected).unknowns.by_name))
    chosen: dict[str, Component] = {}
    for pattern in patterns:
        found = [c for c in every if matches(c, pattern, expected.survey)]
        if not found:
            known = sorted({".".join(c.name) for c in every})
            raise SurveyError(
                f"{pattern!r} names nothing unknown; {suggestion(pattern, known)}; write lens.X, point.B1, with .fx or "
                f".x behind for one component, * for any, or {EVERYTHING}"
            )
        chosen |= {c.text: c for c in found}
    return tuple(chosen.values())


def matches(component: Component, pattern: str, survey: Survey) -> bool:
    """Whether a pattern names a component, its unknown, or the unknown's owner."""
    owner = ".".join(component.name)
    texts = [component.text, owner, ".".join(component.name[1:])]
    if component.name[0] == "station_from_camera":
        camera = component.name[1]
        station = survey.cameras_by_id[camera].station_id
        texts += [f"{station}.camera_{camera}", f"{station}.{camera}"]
        texts.append(f"{station}.camera_{camera}.{component.component}")
    return any(fnmatchcase(text, pattern) for text in texts)


def required_sigmas(expected: Adjustment, required: Sequence[Requirement]) -> dict[Component, float]:
    """The sigma (SI) that is required of each component; the smaller where two rules name it. Raises SurveyError."""
    out: dict[Component, float] = {}
    for rule in required:
        found = [c for c in wanted_components(expected, [rule.pattern]) if c.unit in rule.sigma]
        if not found:
            units = ", ".join(sorted({c.unit for c in wanted_components(expected, [rule.pattern])}))
            raise SurveyError(f"[[required]] of = {rule.pattern!r}: nothing in {'/'.join(rule.sigma)}, only {units}")
        for c in found:
            out[c] = min(rule.sigma[c.unit], out.get(c, rule.sigma[c.unit]))
    return out
