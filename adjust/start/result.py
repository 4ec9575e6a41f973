"""What the search for start values gives back."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from gtsam import Pose3

from adjust.model.result import ParameterName
from adjust.model.survey import FloatArray


@dataclass(frozen=True, eq=False)
class Start:
    """Start values for every parameter that the survey needs.

    lenses: full vectors (n,) by camera. poses: by parameter name. points: (3,) m by point id. vectors: table_angles,
    table_geometry and warp by parameter name. excluded_blocks: positions in ``Survey.image_blocks`` of what is not
    trusted, each with its reason. orphans: poses that only such blocks reach; they have a value here, but nothing in an
    adjustment without these blocks determines them: leave the blocks out altogether, or hold the poses. block_rms_px:
    misfit of every block at the start, px (nan where it has no rays).
    """

    lenses: Mapping[str, FloatArray]
    poses: Mapping[ParameterName, Pose3]
    points: Mapping[str, FloatArray]
    vectors: Mapping[ParameterName, FloatArray] = field(default_factory=dict)
    excluded_blocks: tuple[int, ...] = ()
    reasons: tuple[str, ...] = ()
    orphans: tuple[ParameterName, ...] = ()
    block_rms_px: tuple[float, ...] = ()
    notes: tuple[str, ...] = ()
