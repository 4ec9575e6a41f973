"""What eyes observed, as frozen values: poses or motions of eyes."""


import numpy as np
import scipy.linalg

from adjust.model.frozen import frozen
from adjust.model.observations import FrameRef
from adjust.model.survey import FloatArray
from adjust.spatial.rigid_motions import Motions


@frozen(eq=False)
class EyeSequence:
    """Poses of one eye in the world that it watches at n epochs, or its motions over n intervals.

    reference_from_eye: (n,) the poses, or motions ``before_from_after``, of which the errors are independent.
    cov: (n, 6, 6) in the tangents on the right (frame of the eye), or the joint one (6n, 6n), as from one adjustment.
    world_ids: (n,) name of the frame each pose refers to, a target or the eye's own start; None for motions.
    """

    eye: FrameRef
    epoch_ids: tuple[str, ...]
    reference_from_eye: Motions
    cov: FloatArray
    world_ids: tuple[str, ...] | None = None

    @property
    def joint_cov(self) -> FloatArray:
        """(6n, 6n), whatever was given."""
        return self.cov if self.cov.ndim == 2 else np.asarray(scipy.linalg.block_diag(*self.cov))
