"""GTSAM's callback of factors that Python evaluates: known here alone."""

from collections.abc import Callable, Sequence

import gtsam

from adjust.model.survey import FloatArray

Evaluate = Callable[[gtsam.Values, list[FloatArray] | None], FloatArray]
"""From values to the residual; puts a Jacobian of each key into the list where there is one."""


def evaluated(noise: gtsam.noiseModel.Base, keys: Sequence[int], evaluate: Evaluate) -> gtsam.CustomFactor:
    """The factor on these keys that ``evaluate`` serves."""

    def call(_factor, values, jacobians):  # type: ignore[no-untyped-def]  # GTSAM's protocol, bound untyped
        return evaluate(values, jacobians)

    return gtsam.CustomFactor(noise, list(keys), call)
