"""From the readings of a survey to their batch."""

from collections.abc import Mapping

from adjust.frames.state import State
from adjust.frames.tree import FrameTree
from adjust.frames.unknowns import Unknowns
from adjust.model.observations import FrameRef, PositionRef
from adjust.model.survey import Survey
from adjust.observations.factors import ChainPose, Position
from adjust.observations.terrestrial.batch import TerrestrialBatch
from adjust.observations.terrestrial.layout import LayoutBuilder, reading_arrays
from adjust.observations.terrestrial.parameters import TerrestrialParameters


def _body_refs(survey: Survey) -> list[PositionRef]:
    """Stations whose axes readings count in."""
    tilted = {s.setup_id for s in survey.setups if not s.levelled}
    return list(dict.fromkeys(r.at for r in survey.readings if r.setup_id in tilted and r.at.frame is not None))


def height_holds(survey: Survey) -> dict[str, int]:
    """Per point: 0 where its height is free, 1 where all of it is held, 2 where only the height is."""
    if abs(survey.vertical.up_in_world[2]) < 0.9:
        return {}
    out = {}
    for point in survey.points:
        x = point.x_in_world
        out[point.point_id] = 1 if x.treatment == "held" else 2 if "z" in x.held else 0
    return out


def build_batch(
    survey: Survey, unknowns: Unknowns, parameters: TerrestrialParameters, frames: FrameTree, state: State,
    at: Mapping[PositionRef, Position],
) -> TerrestrialBatch | None:  # fmt: skip
    """The batch of all readings, None where there are none. Raises SurveyError for readings that cannot be."""
    if not survey.readings:
        return None
    refs, bodies = survey.reading_refs, _body_refs(survey)
    held = height_holds(survey)
    flat = {ref: held.get(ref.point_id or "", 0) if ref.frame is None else 0 for ref in refs}
    arrays = reading_arrays(survey, parameters, {ref: i for i, ref in enumerate(refs)},
                            {ref: i for i, ref in enumerate(bodies)}, flat)  # fmt: skip
    poses = [ChainPose(unknowns, state, frames.relative(ref.frame or FrameRef("world"), FrameRef("world")))
             for ref in bodies]  # fmt: skip
    layout = LayoutBuilder(survey, unknowns, parameters, arrays, [at[ref] for ref in refs], poses).build()
    return TerrestrialBatch(survey, state, parameters, layout)

