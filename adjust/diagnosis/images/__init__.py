"""Images that are not as the camera saw them: mirrored, turned. Changes from some epoch on begin in ``bodies``."""

from collections.abc import Iterable

from adjust.diagnosis.case import Case
from adjust.diagnosis.hypothesis import Hypothesis
from adjust.diagnosis.images.mirrored import mirrored_images
from adjust.diagnosis.images.turned import turned_alone
from adjust.diagnosis.targets.layout import other_layouts

__all__ = ["hypotheses"]


def hypotheses(case: Case) -> Iterable[Hypothesis]:
    """What the images of flat targets show of themselves."""
    yield from mirrored_images(case)
    yield from other_layouts(case)
    yield from turned_alone(case)
