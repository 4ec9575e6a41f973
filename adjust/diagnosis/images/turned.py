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
    alone = replace(case.survey, image_blocks=tuple(b for b in case.survey.image_blocks if b.target_id is not None))
    every, back = {b.epoch_id for b in alone.image_blocks}, alone
    for camera in lenses:
        back = mapped(back, camera, every, TURNED[_HALF])
    now, then = squares_alone(alone, lenses), squares_alone(back, lenses)
    for camera in lenses:
        rows = [i for i, b in enumerate(alone.image_blocks) if b.camera_id == camera]
        at = [alone.image_blocks[i].epoch_id for i in rows]
        epochs, gain = list(dict.fromkeys(at)), now[rows] - then[rows]
        since = np.array([gain[[e in set(epochs[k:]) for e in at]].sum() for k in range(1, len(epochs))])
        if len(since) and since.max() > float(chi2.isf(sidak(_ALPHA, len(since)), 1)):
            later = tuple(epochs[int(np.argmax(since)) + 1 :])
            ratio = 1.0 + float(since.max() / max(then[rows][-len(later) :].sum(), 1.0))
            yield turned(case.survey, camera, later, TURNED[_HALF], ratio, len(since))
