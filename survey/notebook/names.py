"""Names of estimated things as people write them: "X", "lens/X", "lens/X/fx", ("world_from_station", "head").

And small pieces of HTML that look well in a notebook, on light and on dark ground.
"""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from markupsafe import Markup

from adjust.model.errors import SurveyError
from adjust.model.result import Estimate, ParameterName
from survey.folder.text import suggestion
from survey.report.markup import part
from survey.solution.quantities import estimated, in_joint

Component = tuple[ParameterName, str]
Estimates = Mapping[ParameterName, Estimate]


def components(estimates: Estimates, names: Sequence[str | tuple[str, ...]]) -> tuple[Component, ...]:
    """Estimated components that the names mean, each once, in their order.

    A name is the id of a thing (all that is estimated of it; where that is only there per epoch, all epochs), a path
    ``kind/id[/epoch][/component]`` as in ``covariance.npz``, or the same as a tuple. Raises SurveyError for a name that
    there is not, with the nearest, and for one of which nothing is estimated.
    """
    out: dict[Component, None] = {}
    for name in names:
        found = [(n, c) for n, wanted in _meant(estimates, name) for c in wanted]
        if not found:
            raise SurveyError(f"{_shown(name)}: nothing of it is estimated, it is held; name something that is free")
        out.update(dict.fromkeys(found))
    return tuple(out)


def _meant(estimates: Estimates, name: str | tuple[str, ...]) -> list[tuple[ParameterName, tuple[str, ...]]]:
    parts = tuple(name.split("/")) if isinstance(name, str) else tuple(name)
    if parts in estimates:
        return [(parts, estimated(estimates[parts]))]
    whole, last = parts[:-1], parts[-1:]
    if whole in estimates and last[0] in estimates[whole].components:
        return [(whole, last if last[0] in estimated(estimates[whole]) else ())]
    if len(parts) == 1:
        every = [n for n in estimates if len(n) > 1 and n[1] == parts[0]]
        every = [n for n in every if len(n) == 2 and estimated(estimates[n])] or every
    else:
        every = [n for n in estimates if n[: len(parts)] == parts]
    if not every:
        hint = suggestion(_shown(name), _known(estimates))
        raise SurveyError(f"{_shown(name)}: nothing of that name was adjusted; {hint}")
    return [(n, estimated(estimates[n])) for n in every]


def _shown(name: str | tuple[str, ...]) -> str:
    return name if isinstance(name, str) else "/".join(name)


def _known(estimates: Estimates) -> list[str]:
    return [*dict.fromkeys(n[1] for n in estimates if len(n) > 1), *("/".join(n) for n in estimates)]


def rows_in_joint(estimates: Estimates, wanted: Sequence[Component]) -> tuple[list[ParameterName], list[int]]:
    """The parameters whose joint covariance holds the wanted components, and their rows in it."""
    names = list(dict.fromkeys(name for name, _ in wanted))
    starts = dict(zip(names, np.cumsum([0] + [len(in_joint(estimates[n])) for n in names]).tolist()[:-1], strict=True))
    return names, [starts[n] + in_joint(estimates[n]).index(c) for n, c in wanted]


Cell = str | tuple[str, str]
_OF = "notebook.html"


def heading(title: str, said: str = "") -> Markup:
    """A title with a remark; both are escaped."""
    return part("heading", title, said, of=_OF)


def verdict(colour: str, said: str) -> Markup:
    """What an adjustment comes to, in a colour of CSS."""
    return part("verdict", colour, said, of=_OF)


def html_table(columns: Sequence[str], rows: Iterable[Sequence[Cell]]) -> Markup:
    """A table of texts, first column left, others right; a cell may be a text with its style. Texts are escaped."""
    cells = [[cell if isinstance(cell, tuple) else (cell, "") for cell in row] for row in rows]
    return part("table", columns, cells, of=_OF)
