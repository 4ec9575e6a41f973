"""Images turned by half a turn that nothing else contradicts: their lens does, which is not symmetric."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from adjust.diagnosis.alone import squares_alone
from adjust.diagnosis.case import Case
from adjust.diagnosis.hypothesis import Hypothesis
from adjust.diagnosis.images.maps import TURNED, mapped, turned
from adjust.testing.criteria import sidak
from adjust.testing.distributions import chi2

_ALPHA = 1e-6
_HALF = 180


def turned_alone(case: Case) -> Iterator[Hypothesis]:
    """By camera, the last images that fit their own best poses better once they are turned back, with its lens."""
    if case.values is None:
        return
    lenses = {n[1]: np.asarray(v) for n, v in case.values.items() if n[0] == "lens"}
    for camera in lenses:
        mine = [b for b in case.survey.image_blocks if b.camera_id == camera and b.target_id is not None]
        alone = replace(case.survey, image_blocks=tuple(mine))
        epochs = list(dict.fromkeys(b.epoch_id for b in mine))
        back = squares_alone(mapped(alone, camera, set(epochs), TURNED[_HALF]), lenses)
        gain = squares_alone(alone, lenses) - back
        since = np.array([gain[[b.epoch_id in set(epochs[k:]) for b in mine]].sum() for k in range(1, len(epochs))])
        if len(since) and since.max() > float(chi2.isf(sidak(_ALPHA, len(since)), 1)):
            later = tuple(epochs[int(np.argmax(since)) + 1 :])
            ratio = 1.0 + float(since.max() / max(back[-len(later) :].sum(), 1.0))
            yield turned(case.survey, camera, later, TURNED[_HALF], ratio, len(since))
