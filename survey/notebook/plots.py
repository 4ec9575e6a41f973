"""Plots by name: the pictures of the report, one by one, as SVG."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from markupsafe import Markup

from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.result import Adjustment
from adjust.model.survey import FloatArray
from survey.folder.text import atomic_write, choice_hint, suggestion
from survey.report import charts, picture
from survey.report.drawing import ON_WHITE, standalone
from survey.report.scene import enlargement, scene_of
from survey.report.sections.statistics import standardized_by_group
from survey.solution.quantities import Scale
from survey.solution.residual_tables import image_rows
from survey.solution.statistics import correlation_matrix
from survey.solution.verdict import suspects


@frozen
class Plot:
    """A picture that a notebook shows; ``svg`` is the file."""

    name: str
    svg: str

    def save(self, path: str | Path) -> Path:
        """Write the picture as ``.svg``. Raises SurveyError for another ending."""
        path = Path(path)
        if path.suffix != ".svg":
            raise SurveyError(f"{path}: plots are SVG; give a name that ends with .svg")
        atomic_write(path, self.svg)
        return path

    def _repr_svg_(self) -> str:
        return self.svg

    def __repr__(self) -> str:
        """Its name and size."""
        return f"Plot({self.name!r}, {len(self.svg)} bytes of SVG)"


def _camera(adjustment: Adjustment, camera: str | None) -> charts.CameraResiduals:
    ids = [c.camera_id for c in adjustment.survey.cameras]
    if camera is None and len(ids) == 1:
        camera = ids[0]
    if camera not in ids:
        wrong = "no camera is named" if camera is None else f"there is no camera {camera!r}"
        hint = suggestion(camera, ids) if camera else f"cameras are {', '.join(ids)}"
        raise SurveyError(f"{wrong}; {hint}")
    found = adjustment.image_residuals
    suspect = found.used & (found.test > suspects(adjustment).image_limit)
    return charts.camera_residuals(adjustment, image_rows(adjustment), suspect, adjustment.survey.cameras_by_id[camera])


def _view(adjustment: Adjustment, scale: Scale, make: Callable[[FloatArray], picture.View]) -> Markup:
    scene = scene_of(adjustment, scale)
    everything = scene.positions()
    if not len(everything):
        raise SurveyError("there is nothing with a place in this survey to draw a map of")
    enlarged = enlargement(scene, scale.ellipsoid, float(np.linalg.norm(np.ptp(everything, axis=0))))
    return picture.draw(scene, make(everything), everything, enlarged, scale.ellipsoid)


def _correlations(adjustment: Adjustment) -> Markup:
    found = correlation_matrix(adjustment)
    if found is None:
        raise SurveyError("there are not two unknowns whose correlation could be shown")
    return charts.heat_map(found)


def _quantiles(adjustment: Adjustment, group: str | None = None) -> Markup:
    names = [g.group for g in adjustment.groups]
    group = names[0] if group is None and len(names) == 1 else group
    if group not in names:
        hint = suggestion(group, names) if group else f"groups are {', '.join(names)}"
        raise SurveyError(f"{'no group is named' if group is None else f'there is no group {group!r}'}; {hint}")
    w = standardized_by_group(adjustment).get(group, np.empty(0))
    if len(w) < 8:
        raise SurveyError(f"group {group!r} has {len(w)} residuals that can be tested; quantiles need 8 or more")
    return charts.quantiles(group, w)


_OF_CAMERA = {"residuals": charts.vector_field, "mean_residuals": charts.mean_field, "histogram": charts.histogram}
_VIEWS = {"map": picture.plan, "perspective": picture.perspective}
PLOTS = (*_OF_CAMERA, *_VIEWS, "correlations", "quantiles")
"""What can be plotted: the first three take ``camera=``, the last ``group=``, where there is more than one."""


def plot(name: str, adjustment: Adjustment, scale: Scale, **chosen: str) -> Plot:
    """A plot by its name. Raises SurveyError for one that there is not, or a camera or group that there is not."""
    if name not in PLOTS:
        raise SurveyError(f"there is no plot {name!r}; {choice_hint(name, PLOTS)}")
    allowed = "camera" if name in _OF_CAMERA else "group" if name == "quantiles" else ""
    for key in chosen:
        if key != allowed:
            takes = f"it takes {allowed}=" if allowed else "it takes nothing more"
            raise SurveyError(f"plot {name!r} knows no {key}=; {takes}")
    if name in _OF_CAMERA:
        drawn = _OF_CAMERA[name](_camera(adjustment, chosen.get("camera")))
    elif name in _VIEWS:
        drawn = _view(adjustment, scale, _VIEWS[name])
    else:
        drawn = _quantiles(adjustment, chosen.get("group")) if name == "quantiles" else _correlations(adjustment)
    return Plot(name, standalone(drawn, ON_WHITE))
