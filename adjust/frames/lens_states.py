"""Which lens an image was taken with: that of its camera, as it had changed by then and as the image was cropped."""

from collections.abc import Iterable, Sequence

import gtsam
import numpy as np

from adjust.frames.lens_times import LensTimes, block_starts, changed
from adjust.frames.unknowns import Unknowns, VectorMap, vector_map
from adjust.lenses.crops import UNITS, CroppedLens, cropped_lens
from adjust.lenses.models import MODELS, LensModel, camera_constants
from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.result import ParameterName
from adjust.model.survey import CROP, BoolArray, Camera, FloatArray, LensDrift, LensSharing, Survey, VectorParameter
from adjust.native.lenses import MAX_LENS


@frozen(eq=False)
class CropState:
    """How images are cropped: ``CROP``, for a lens model with the constants (4,) of the whole image."""

    vector: VectorMap
    model: LensModel
    constants: FloatArray

    @property
    def pattern(self) -> BoolArray:
        """Which parameters (n,) of a lens follow from which free ones (k,) of the crop."""
        generic = cropped_lens(self.model, np.ones(self.model.n), self.constants, np.array([1.3, 0.7, 0.9]))
        return np.asarray((generic.by_crop != 0.0) @ (self.vector.matrix != 0.0))

    def lens(self, whole: FloatArray, values: gtsam.Values) -> CroppedLens:
        """The lens of the whole image (n,), as it is in these."""
        return cropped_lens(self.model, whole, self.constants, self.vector.full(values))


@frozen(eq=False)
class LensState:
    """The lens of a camera (its number), what is added to it, times a factor, and how it is cropped."""

    camera: int
    change: tuple[VectorMap, float] | None = None
    crop: CropState | None = None


@frozen(eq=False)
class LensPart:
    """Free parameters ``first`` and the n - 1 after it come from components of a key, times a factor."""

    key: int
    first: int
    within: int
    n: int
    factor: float


def lenders(survey: Survey) -> dict[str, tuple[str, tuple[str, ...]]]:
    """By camera the one whose unknowns some parameters of its lens are, and which.

    Where the camera that is named is not part of the survey, the first of those that name it takes its place. Raises
    SurveyError for a lens that cannot be shared.
    """
    cameras, out = survey.cameras_by_id, dict[str, tuple[str, tuple[str, ...]]]()
    stands_for: dict[str, str] = {}
    for camera in survey.cameras:
        sharing = camera.lens.shared
        if sharing is None:
            continue
        name = sharing.camera_id
        lender = name if name in cameras else stands_for.setdefault(name, camera.camera_id)
        if lender != camera.camera_id:
            _check_shared(camera, cameras[lender], sharing)
            out[camera.camera_id] = lender, sharing.parameters
    return out


def _check_shared(camera: Camera, lender: Camera, sharing: LensSharing) -> None:
    what = f"camera {camera.camera_id!r} shares its lens with {lender.camera_id!r}"
    if lender.camera_id == sharing.camera_id and lender.lens.shared is not None:
        raise SurveyError(f"{what}, which shares its own; name {lender.lens.shared.camera_id!r}")
    if camera.lens.model != lender.lens.model:
        raise SurveyError(f"{what}, but they are {camera.lens.model!r} and {lender.lens.model!r}; take one model")
    for name in sharing.parameters:
        if name not in camera.lens.free or name not in lender.lens.free:
            raise SurveyError(f"{what}, but {name} is not free in both; add it to free")
        if camera.lens.prior is not None and name in camera.lens.prior.names:
            raise SurveyError(f"{what}, and {name} has a prior here; give it to {lender.camera_id!r}")


class LensStates:
    """All lens states of a survey: first one for every camera, then those that changes make of it."""

    def __init__(self, survey: Survey, unknowns: Unknowns) -> None:
        self.maps = [unknowns.vectors[("lens", c.camera_id)] for c in survey.cameras]
        self._lenses = survey.cameras
        self.states = [LensState(i) for i in range(len(survey.cameras))]
        self.priors: list[tuple[ParameterName, ParameterName | None, FloatArray]] = []
        """Steps of random walks: of the second change (of none) to the first, with their sigmas."""
        self._at: dict[tuple[str, str], int] = {}
        times = LensTimes(survey)
        for i, camera in enumerate(survey.cameras):
            if camera.lens.drift is not None or camera.lens.crops:
                self._add(times, i, camera, unknowns)
        self._cameras = {c.camera_id: i for i, c in enumerate(survey.cameras)}

    def of(self, camera_id: str, epoch_id: str) -> int:
        """The number of the state in which a camera was at an epoch."""
        return self._at.get((camera_id, epoch_id), self._cameras[camera_id])

    def last(self, camera_id: str) -> int:
        """The number of the state in which a camera was left."""
        return next((i for (c, _), i in reversed(self._at.items()) if c == camera_id), self._cameras[camera_id])

    def full(self, i: int, values: gtsam.Values) -> FloatArray:
        """All parameters (n,) of state i at these values."""
        whole, crop = self.whole(i, values), self.states[i].crop
        return whole if crop is None else crop.lens(whole, values).values

    def whole(self, i: int, values: gtsam.Values) -> FloatArray:
        """All parameters (n,) of state i, of the whole image."""
        state = self.states[i]
        out = self.maps[state.camera].full(values)
        if state.change is None:
            return out
        change, factor = state.change
        by = (factor * change.full(values)).tolist()
        return changed(self._lenses[state.camera], out, dict(zip(change.names, by, strict=True)))

    def parts(self, i: int) -> list[LensPart]:
        """Where the free parameters of state i come from."""
        own, state = self.maps[self.states[i].camera], self.states[i]
        out = [] if own.key is None else [LensPart(own.key, 0, 0, len(own.free), 1.0)]
        if own.borrowed:
            out = [LensPart(key, first, within, 1, 1.0) for first, (key, within) in enumerate(own.sources)]
        if state.change is not None and (key := state.change[0].key) is not None:
            change, factor = state.change
            out += [LensPart(key, own.free.index(x), j, 1, factor) for j, x in enumerate(change.names)]
        if state.crop is not None and state.crop.vector.key is not None:
            out.append(LensPart(state.crop.vector.key, len(own.free), 0, len(state.crop.vector.free), 1.0))
        return out

    def pattern(self, i: int) -> BoolArray:
        """Which parameters (n,) of state i follow from which of its free ones (k,): see :meth:`by_free`."""
        own, crop = self.maps[self.states[i].camera], self.states[i].crop
        return own.matrix != 0.0 if crop is None else np.hstack([own.matrix != 0.0, crop.pattern])

    def by_free(self, i: int, values: gtsam.Values) -> FloatArray:
        """Derivative (n, k) of all parameters of state i by its free ones, those of its crop last."""
        own, crop = self.maps[self.states[i].camera], self.states[i].crop
        if crop is None:
            return own.matrix
        lens = crop.lens(self.whole(i, values), values)
        return np.hstack([lens.by_lens[:, None] * own.matrix, lens.by_crop @ crop.vector.matrix])

    def spread(self, i: int, values: gtsam.Values, unknowns: Unknowns) -> dict[int, FloatArray]:
        """How all parameters (n,) of state i follow from unknowns: (n, dim) by key."""
        J, out = self.by_free(i, values), dict[int, FloatArray]()
        for p in self.parts(i):
            by_key = out.setdefault(p.key, np.zeros((len(J), unknowns.by_key[p.key].dim)))
            by_key[:, p.within : p.within + p.n] += p.factor * J[:, p.first : p.first + p.n]
        return out

    def _add(self, times: LensTimes, i: int, camera: Camera, unknowns: Unknowns) -> None:
        """The states in which the images of a camera were taken; unknowns of changes first, then of crops."""
        epochs, own, vectors = list(block_starts(times.survey, camera)), camera.camera_id, unknowns.vectors
        changes, crops = [times.change(camera, e) for e in epochs], [times.crop(camera, e) for e in epochs]
        if camera.lens.drift is not None:
            _check_drift(times.survey, camera, camera.lens.drift, epochs)
            self._register_changes(camera, camera.lens.drift, dict.fromkeys(c[0] for c in changes if c), unknowns)
        for start in dict.fromkeys(c[0] for c in crops if c is not None):
            given, name = camera.lens.crops[start].parameters, ("lens_crop", own, start)
            if name not in vectors:
                _check_crop(camera, given, len(vectors["lens", own].free))
                vectors[name] = vector_map(given, UNITS, unknowns, name)
        numbers: dict[tuple[tuple[ParameterName, float] | None, str | None], int] = {(None, None): i}
        for epoch, by, crop in zip(epochs, changes, crops, strict=True):
            place = by, None if crop is None else crop[0]
            if place not in numbers:
                numbers[place] = len(self.states)
                change, cropped = None if by is None else (vectors[by[0]], by[1]), None
                if crop is not None:
                    vector = vectors["lens_crop", own, crop[0]]
                    cropped = CropState(vector, MODELS[camera.lens.model], camera_constants(camera))
                self.states.append(LensState(i, change, cropped))
            self._at[own, epoch] = numbers[place]

    def _register_changes(
        self, camera: Camera, drift: LensDrift, names: Iterable[ParameterName], unknowns: Unknowns
    ) -> None:
        model, n, before = MODELS[camera.lens.model], len(drift.parameters), None
        per = "" if drift.reference_temperature is None else "/K"
        units = tuple(model.units[model.names.index(x)] + per for x in drift.parameters)
        status = ("free" if drift.step_sigmas is None else "prior",) * n
        for name in names:
            if name not in unknowns.vectors:
                key = unknowns.add(name, "vector", drift.parameters, units).key
                unknowns.vectors[name] = VectorMap(
                    drift.parameters, units, np.zeros(n), np.eye(n), key, drift.parameters, status
                )
            if drift.step_sigmas is not None and drift.reference_temperature is None:
                self.priors.append((name, before, drift.step_sigmas))
            before = name


def _check_drift(survey: Survey, camera: Camera, drift: LensDrift, epochs: Sequence[str]) -> None:
    if wrong := [x for x in drift.parameters if x not in camera.lens.free]:
        raise SurveyError(f"camera {camera.camera_id!r}: {wrong[0]} is to change, but is not free; add it to free")
    cold = [e for e in epochs if e not in survey.temperatures] if drift.reference_temperature is not None else []
    if cold:
        raise SurveyError(f"camera {camera.camera_id!r} changes with temperature, but epoch {cold[0]!r} has none; give "
                          "it under temperatures_degC")  # fmt: skip


def _check_crop(camera: Camera, crop: VectorParameter, n_lens: int) -> None:
    what, free = f"camera {camera.camera_id!r}", crop.free
    if wrong := [x for x in free if x not in CROP]:
        raise SurveyError(f"{what}: a crop has no parameter {wrong[0]!r}; it has {', '.join(CROP)}")
    if n_lens + len(free) > MAX_LENS:
        raise SurveyError(f"{what}: {n_lens + len(free)} parameters of lens and crop are free, more than {MAX_LENS}; "
                          "hold some")  # fmt: skip
    if ("scale" in free or crop.values[0] != 1.0) and camera.lens.balance_radius_mm:
        raise SurveyError(f"{what}: a lens with a balance radius holds for one scale of images; set balance_radius_mm "
                          "= 0, or make another camera of those of another size")  # fmt: skip
