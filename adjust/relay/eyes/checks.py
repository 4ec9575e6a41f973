"""What has to be so before eyes can be found: turns about two axes that stand out of the noise."""


import numpy as np

from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray, IntArray
from adjust.relay.eyes.setup import EyeSetup
from adjust.spatial.rigid import rotation_log
from adjust.start.closed_forms.hand_eye import degenerate_direction

_WEAKEST_TURN = 10.0
"""Sigmas of a turn that the turns about the second axis must have, all epochs together."""


@frozen
class OutlierEpoch:
    """An epoch whose condition between two eyes was left out: ``test`` is chi-square with 6 degrees of freedom."""

    epoch_id: str
    a_id: str
    b_id: str
    test: float
    turn_rad: float
    shift_m: float

    def __str__(self) -> str:
        return (
            f"epoch {self.epoch_id}: {self.a_id} and {self.b_id} disagree by {np.degrees(self.turn_rad):.3f} deg and "
            f"{1e3 * self.shift_m:.2f} mm (test {self.test:.0f}, 6 degrees of freedom); left out"
        )


def refuse_undetermined(setup: EyeSetup) -> EyeSetup:
    """The setup as it is. Raises SurveyError naming the direction that no turn determines, pair of eyes by pair."""
    c = setup.problem.conditions
    for a, b in sorted({(int(x), int(y)) for x, y in zip(c.eye_k, c.eye_l, strict=True)}):
        rows = np.flatnonzero((c.eye_k == a) & (c.eye_l == b))
        turns, sigma = _turns(setup, rows)
        if turns is None:
            continue
        names = f"eyes {setup.eyes[a].frame_id} and {setup.eyes[b].frame_id}"
        try:
            axis = degenerate_direction(turns)
        except SurveyError as error:
            raise SurveyError(f"{names}: {error}") from None
        _, s, vt = np.linalg.svd(turns, full_matrices=False)
        weak = axis is None and s[1] < _WEAKEST_TURN * sigma
        if axis is not None or weak:
            text = ", ".join(f"{x:+.3f}" for x in vt[0])
            second = float(s[1]) if len(s) > 1 else 0.0
            raise SurveyError(
                f"{names}: all {len(turns)} turns are about the one direction ({text}) of {setup.eyes[a].frame_id} "
                f"(about a second one {np.degrees(second):.3f} deg, with a sigma of {np.degrees(sigma):.3f} deg): the "
                "rotation of the pair about it and the lever arm along it are undetermined; add motions about "
                "another axis"
            )
    return setup


def _turns(setup: EyeSetup, rows: IntArray) -> tuple[FloatArray | None, float]:
    """Rotation vectors (n, 3) that determine the pair, and the mean sigma of one; None where it needs no turns."""
    problem, c = setup.problem, setup.problem.conditions
    R = problem.observed.rotation
    sigma = _rotation_sigma(problem.cov, np.concatenate([c.k_idx[rows], c.l_idx[rows]]))
    if setup.motions:
        return rotation_log(R[c.k_idx[rows]]), sigma
    # through other eyes' worlds: what is weak shows in the covariances instead
    if len({*c.world_k.tolist(), *c.world_l.tolist()}) > 2 * len(setup.eyes):
        return None, sigma
    if bool((c.world_k[rows] == c.world_l[rows]).any()):
        return None, sigma
    turns = []
    combos = sorted({(int(a), int(b)) for a, b in zip(c.world_k[rows], c.world_l[rows], strict=True)})
    for wa, wb in combos:
        own = rows[(c.world_k[rows] == wa) & (c.world_l[rows] == wb)]
        first = R[c.k_idx[own[0]]]
        turns.append(rotation_log(np.swapaxes(first, -1, -2) @ R[c.k_idx[own]]))
    return np.concatenate(turns), sigma * np.sqrt(2.0)


def _rotation_sigma(cov: FloatArray, idx: IntArray) -> float:
    if cov.ndim == 3:
        return float(np.sqrt(np.trace(cov[idx, :3, :3], axis1=1, axis2=2).mean() / 3.0))
    diagonal = np.diag(cov).reshape(-1, 6)[idx, :3]
    return float(np.sqrt(diagonal.mean()))
