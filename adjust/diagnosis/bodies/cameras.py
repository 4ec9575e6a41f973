"""A camera that is another one from some epoch on, and what of it changed: its place, its focus, its images."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from gtsam import Pose3

from adjust.diagnosis.bodies.series import Step
from adjust.diagnosis.bodies.split import split_camera
from adjust.diagnosis.hypothesis import (
    Edit,
    Hypothesis,
    LeaveOut,
    Place,
    block_keys,
    crop_keys,
    found_by,
    motion_text,
)
from adjust.diagnosis.images import TURNED, turned
from adjust.lenses.models import CENTRE, FOCAL
from adjust.model.frozen import frozen
from adjust.model.result import Adjustment
from adjust.model.survey import FloatArray, Survey
from adjust.spatial.rigid import rotation_log
from adjust.testing.distributions import chi2

_ALPHA = 1e-5
_NEAR = np.radians(10.0)  # lenses that were found in images of both ways are not good


@frozen(eq=False)
class Difference:
    """Lens and place of a camera after a step against before: free lens parameters, then a motion (rad, m), and cov.

    names: of the free lens parameters. before: their values before. motion: before_from_after.
    """

    names: tuple[str, ...]
    before: FloatArray
    d: FloatArray
    cov: FloatArray
    motion: Pose3

    def vanishes(self, rows: Sequence[int], follow: FloatArray | None = None) -> bool:
        """Whether these components are zero, or follow the first focal length by these factors: a chi-square test."""
        C = np.eye(len(self.d))
        if follow is not None:
            C[:, next(i for i, name in enumerate(self.names) if name in FOCAL)] -= follow
        at = list(rows)
        off, cov = (C @ self.d)[at], (C @ self.cov @ C.T)[np.ix_(at, at)]
        inverse = np.linalg.pinv(cov, rcond=1e-14, hermitian=True)
        return float(off @ inverse @ off) < float(chi2.isf(_ALPHA, len(at)))


def changed_camera(survey: Survey, step: Step, epochs: tuple[str, ...]) -> Hypothesis:
    """Lens and place of the camera free from some epoch on; named by what differs once that is adjusted."""
    camera, new = step.name[1], f"{step.name[1]} from {epochs[0]}"
    hypothesis = Hypothesis(
        "camera changed",
        f"camera {camera}: lens and place are others from epoch {epochs[0]} on: it was exchanged, or knocked",
        f"give it a name of its own from epoch {epochs[0]} on, or leave its {len(epochs)} images since then out",
        Place("camera", (camera,), epochs=epochs),
        split_camera(survey, camera, epochs, new),
        (LeaveOut(tuple(f"image:{camera}/{e}" for e in epochs)),),
        evidence=step.gain, parameters=15, looked_at=step.cuts,
    )  # fmt: skip

    def told(result: Adjustment) -> Sequence[Hypothesis]:
        found = _difference(result, camera, new)
        if found is None:
            return ()
        seen = replace(step, motion=found.motion.inverse().matrix())
        turned = turned_images(survey, seen, epochs) if step.motion is None else ()
        return (*turned, _named(survey, hypothesis, found))

    return replace(hypothesis, follow=told)


def _difference(result: Adjustment, camera: str, new: str) -> Difference | None:
    lenses = [result.estimates[("lens", name)] for name in (camera, new)]
    poses = [result.estimates[("station_from_camera", name)] for name in (camera, new)]
    before, after = (p.value for p in poses)
    if not isinstance(before, Pose3) or not isinstance(after, Pose3) or isinstance(lenses[0].value, Pose3):
        return None
    free = [i for i, status in enumerate(lenses[0].status) if status in ("free", "prior")]
    motion = before.between(after)
    n, A, full = len(free), motion.inverse().AdjointMap(), len(lenses[0].components)
    rows = [*free, *(full + i for i in free), *range(2 * full, 2 * full + 12)]
    cov = result.joint([e.name for e in (*lenses, *poses)])[np.ix_(rows, rows)]
    J = np.zeros((n + 6, 2 * n + 12))
    J[:n, : 2 * n] = np.hstack([-np.eye(n), np.eye(n)])
    J[n:, 2 * n :] = np.hstack([-A, np.eye(6)])
    cov = J @ cov @ J.T
    names = tuple(lenses[0].components[i] for i in free)
    values = [np.asarray(x.value)[free] for x in lenses]
    d = np.concatenate([values[1] - values[0], Pose3.Logmap(motion)])
    return Difference(names, values[0], d, cov * max(1.0, result.sigma0**2), motion)


def turned_images(survey: Survey, step: Step, epochs: tuple[str, ...]) -> Iterator[Hypothesis]:
    """The images turned back, where the camera seems to have turned about its line of sight by quarter turns."""
    turn = np.radians([0.0, 0.0, 180.0]) if step.motion is None else rotation_log(step.motion[:3, :3])
    for degrees, back in ((90.0, 270), (180.0, 180), (-90.0, 90)):
        off = min(float(np.linalg.norm(turn - s * np.radians([0.0, 0.0, degrees]))) for s in (1, 1 - 2 * (back == 180)))
        if off < _NEAR:
            evidence = (0.9 if step.motion is None else 1.1) * step.gain
            yield turned(survey, step.name[1], epochs, TURNED[back], evidence, step.cuts)


def _named(survey: Survey, hypothesis: Hypothesis, found: Difference) -> Hypothesis:
    """The same survey under the name of the simplest change that agrees with what was adjusted."""
    camera, first = hypothesis.place.ids[0], hypothesis.place.epochs[0]
    n, begin = len(found.names), f"camera {camera}: from epoch {first} on "
    place = list(range(n, n + 6))
    other = [i for i, name in enumerate(found.names) if name not in FOCAL + CENTRE]
    focal, centre = ([i for i, name in enumerate(found.names) if name in of] for of in (FOCAL, CENTRE))

    def named(name: str, parameters: int, keys: tuple[Edit, ...], cause: str) -> Hypothesis:
        return replace(hypothesis, name=name, parameters=parameters, cause=cause,
                       edits=keys or hypothesis.edits, change=found_by(keys, hypothesis.change))  # fmt: skip

    if centre and found.vanishes([*focal, *other, *place]):
        shift = ", ".join(f"{found.d[i]:+.2f}" for i in centre)
        keys = crop_keys(survey, camera, first, 1.0, found.d[centre]) if len(centre) == 2 else ()
        cause = f"{begin}its images are shifted by ({shift}) px: another crop of the sensor"
        return named("images shifted", 3, keys, cause)
    if focal:
        ratio = float(1.0 + found.d[focal[0]] / found.before[focal[0]])
        if found.vanishes([*focal[1:], *centre, *other, *place], _resized(found)):
            keys = crop_keys(survey, camera, first, ratio)
            return named("images resized", 2, keys, f"{begin}its images have {ratio:.5g} times the size")
        if found.vanishes([*other, *place]):
            keys = block_keys(survey, camera, [found.names[i] for i in (*focal, *centre)], (first,))
            said = f"{begin}its focal length is {ratio:.5f} times the former one: focus or zoom was touched"
            return named("focus touched", 5, keys, said)
    if found.vanishes([*focal, *centre, *other]):
        cause = f"camera {camera} was moved on its station before epoch {first} {motion_text(found.motion)}"
        return replace(hypothesis, name="camera moved", parameters=7, cause=cause)
    return hypothesis


def _resized(found: Difference) -> FloatArray:
    """(n + 6,) by the first focal length's difference, where images were scaled about their corner."""
    out = np.zeros_like(found.d)
    first = next(found.before[i] for i, name in enumerate(found.names) if name in FOCAL)
    for i, name in enumerate(found.names):
        if name in FOCAL:
            out[i] = found.before[i] / first
        elif name in ("u0", "v0"):
            out[i] = (found.before[i] + 0.5) / first
    return out
