"""Which lens an image was taken with: that of its camera, as it had changed by then."""

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from adjust.frames.unknowns import Unknowns, VectorMap
from adjust.lenses.models import MODELS
from adjust.model.errors import SurveyError
from adjust.model.result import ParameterName
from adjust.model.survey import Camera, FloatArray, LensDrift, Survey


@dataclass(frozen=True, eq=False)
class LensState:
    """The lens of a camera (its number) and what is added to it: changes, each times a factor."""

    camera: int
    changes: tuple[tuple[VectorMap, float], ...] = ()


@dataclass(frozen=True, eq=False)
class LensPart:
    """Free parameters ``first`` and the n - 1 after it come from components of a key, times a factor."""

    key: int
    first: int
    within: int
    n: int
    factor: float


def block_starts(survey: Survey, camera: Camera) -> dict[str, str | None]:
    """By epoch of a camera's images, in their order: the epoch at which its block began, None in the first one.

    Raises SurveyError for a beginning at which the camera has no image.
    """
    drift = camera.lens.drift
    epochs = dict.fromkeys(b.epoch_id for b in survey.image_blocks if b.camera_id == camera.camera_id)
    if drift is not None and (missing := [e for e in drift.begins if e not in epochs]):
        raise SurveyError(f"camera {camera.camera_id!r}: its lens is to change at epoch {missing[0]!r}, at which it "
                          "has no image; correct drift.begins")  # fmt: skip
    out: dict[str, str | None] = {}
    start: str | None = None
    for epoch in epochs:
        start = epoch if drift is not None and epoch in drift.begins else start
        out[epoch] = start
    return out


class LensStates:
    """All lens states of a survey: first one for every camera, then those that changes make of it."""

    def __init__(self, survey: Survey, unknowns: Unknowns) -> None:
        self.maps = [unknowns.vectors[("lens", c.camera_id)] for c in survey.cameras]
        self.states = [LensState(i) for i in range(len(survey.cameras))]
        self.priors: list[tuple[ParameterName, ParameterName | None, FloatArray]] = []
        """Steps of random walks: of the second change (of none) to the first, with their sigmas."""
        self._at: dict[tuple[str, str], int] = {}
        for i, camera in enumerate(survey.cameras):
            if camera.lens.drift is not None:
                self._add(survey, i, camera, camera.lens.drift, unknowns)
        self._cameras = {c.camera_id: i for i, c in enumerate(survey.cameras)}

    def of(self, camera_id: str, epoch_id: str) -> int:
        """The number of the state in which a camera was at an epoch."""
        return self._at.get((camera_id, epoch_id), self._cameras[camera_id])

    def full(self, i: int, values: gtsam.Values) -> FloatArray:
        """All parameters (n,) of state i at these values."""
        own = self.maps[self.states[i].camera]
        out = own.full(values)
        for change, factor in self.states[i].changes:
            columns = [own.free.index(x) for x in change.names]
            out = out + factor * (own.matrix[:, columns] @ change.full(values))
        return out

    def parts(self, i: int) -> list[LensPart]:
        """Where the free parameters of state i come from."""
        own = self.maps[self.states[i].camera]
        out = [] if own.key is None else [LensPart(own.key, 0, 0, len(own.free), 1.0)]
        for change, factor in self.states[i].changes:
            if change.key is not None:
                out += [LensPart(change.key, own.free.index(x), j, 1, factor) for j, x in enumerate(change.names)]
        return out

    def _add(self, survey: Survey, i: int, camera: Camera, drift: LensDrift, unknowns: Unknowns) -> None:
        if wrong := [x for x in drift.parameters if x not in camera.lens.free]:
            raise SurveyError(f"camera {camera.camera_id!r}: {wrong[0]} is to change, but is not free; add it to free")
        starts = block_starts(survey, camera)
        if drift.reference_temperature is not None:
            rates = _registered(camera, drift, ("lens_drift", camera.camera_id), unknowns)
            for epoch in starts:
                if epoch not in survey.temperatures:
                    raise SurveyError(f"camera {camera.camera_id!r} changes with temperature, but epoch {epoch!r} has "
                                      "none; give it under temperatures_degC")  # fmt: skip
                self._state(i, camera, [epoch], rates, survey.temperatures[epoch] - drift.reference_temperature)
            return
        before: ParameterName | None = None
        for start in dict.fromkeys(s for s in starts.values() if s is not None):
            name: ParameterName = ("lens_drift", camera.camera_id, start)
            change = _registered(camera, drift, name, unknowns)
            self._state(i, camera, [e for e, s in starts.items() if s == start], change, 1.0)
            if drift.step_sigmas is not None:
                self.priors.append((name, before, drift.step_sigmas))
            before = name

    def _state(self, i: int, camera: Camera, epochs: Sequence[str], change: VectorMap, factor: float) -> None:
        self._at |= dict.fromkeys(((camera.camera_id, e) for e in epochs), len(self.states))
        self.states.append(LensState(i, ((change, factor),)))


def _registered(camera: Camera, drift: LensDrift, name: ParameterName, unknowns: Unknowns) -> VectorMap:
    if name not in unknowns.vectors:
        model, n = MODELS[camera.lens.model], len(drift.parameters)
        per = "" if drift.reference_temperature is None else "/K"
        units = tuple(model.units[model.names.index(x)] + per for x in drift.parameters)
        key = unknowns.add(name, "vector", drift.parameters, units).key
        status = ("free" if drift.step_sigmas is None else "prior",) * n
        unknowns.vectors[name] = VectorMap(
            drift.parameters, units, np.zeros(n), np.eye(n), key, drift.parameters, status
        )
    return unknowns.vectors[name]
