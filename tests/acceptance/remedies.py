"""Terms that an adjustment may be given beside the usual unknowns: are they found, are their sigmas true, are they
silent where there is nothing?

``python -m tests.acceptance.remedies 100`` prints a table: for every kind of term, over so many repeats with fresh
noise, the mean of d' inv(C) d over its degrees of freedom (1 where the sigmas are true), the share of repeats in which
the truth lies in the 95 % region, how often the test finds the term, and how often it finds it where it is zero. Names
after the number choose kinds.
"""

import sys
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from adjust.adjustment import adjust
from adjust.graph.assembly import values_of
from adjust.lenses.models import MODELS
from adjust.model.result import Adjustment, ParameterName
from adjust.model.survey import CROP, FloatArray, ImageCrop, LensDrift, LensSharing, Survey, VectorParameter
from adjust.model.tables import harmonic_names
from adjust.statistics.score import shared_lenses
from adjust.testing.distributions import chi2
from adjust.testing.significance import Significance, significance_of_changes, significances
from survey.simulate import Truth, head_on_table, resample, stereo
from tests.adjust.moving import board_before_cameras, camera_on_hand, clock, head_on_moving_table

Made = Callable[..., tuple[Survey, Truth]]


@dataclass(frozen=True, eq=False)
class Remedy:
    """A survey that estimates some terms, with their true values and without them; which estimate they are part of."""

    name: str
    survey: Survey
    truth: Truth
    innocent: Truth
    of: ParameterName
    term: str
    drawn: Callable[[Truth, np.random.Generator], Truth] = lambda truth, _: truth
    """The truth of one repeat, where the term is random itself."""


@dataclass(frozen=True)
class Outcome:
    """Of n repeats: degrees of freedom k, d' inv(C) d (n,), how often the test found the term, and where it is zero."""

    k: int
    squares: FloatArray
    found: int
    false: int

    @property
    def covered(self) -> int:
        """Repeats whose 95 % region holds the truth."""
        return int(np.sum(self.squares <= chi2.ppf(0.95, self.k)))


def board(name: str, term: str, values: dict[str, float], free: tuple[str, ...] | None = None) -> Remedy:
    """A board that a stereo rig of known length sees 12 times, at temperatures of its own."""
    survey, truth = stereo(21, n_pairs=12)
    target, names = survey.targets[0], free or tuple(values)
    epochs = dict.fromkeys(b.epoch_id for b in survey.image_blocks)
    warp = VectorParameter(names, np.zeros(len(names)), names)
    survey = replace(survey, targets=(replace(target, warp=warp),),
                     temperatures={e: 17.0 + 0.5 * i for i, e in enumerate(epochs)})  # fmt: skip
    key = ("warp", target.target_id)
    true = np.array([values.get(n, 0.0) for n in names])
    return Remedy(name, survey, truth | {key: true}, truth | {key: np.zeros(len(names))}, key, term)


def table(name: str, term: str, harmonics: dict[str, int], values: dict[str, float]) -> Remedy:
    """Two cameras on a table that turns all round; harmonics up to some order, of which few are not zero."""
    survey, truth = head_on_table(22, n_cameras=2, n_table_epochs=14, n_free_epochs=4)
    turntable = survey.tables[0]
    given = turntable.geometry
    waves = tuple(n for key, k in harmonics.items() for n in harmonic_names(key[:-2], int(key[-1]) - 1, k))
    key = ("table_geometry", turntable.table_id)
    geometry = replace(given, names=(*given.names, *waves), values=np.append(given.values, np.zeros(len(waves))),
                       free=(*given.free, *waves))  # fmt: skip
    survey = replace(survey, tables=(replace(turntable, geometry=geometry),))
    base = np.asarray(truth[key])
    true, none = (np.append(base, [v.get(n, 0.0) for n in waves]) for v in (values, {}))
    return Remedy(name, survey, truth | {key: true}, truth | {key: none}, key, term)


def lens(name: str, changes: dict[str, FloatArray], drift: LensDrift) -> Remedy:
    """A stereo rig whose second lens changes: at given epochs, or with the temperature."""
    survey, truth = stereo(23, n_pairs=18)
    epochs = list(dict.fromkeys(b.epoch_id for b in survey.image_blocks))
    camera = survey.cameras[1]
    changed = replace(camera, lens=replace(camera.lens, drift=drift))
    survey = replace(survey, cameras=(survey.cameras[0], changed),
                     temperatures={e: 18.0 + 0.4 * i for i, e in enumerate(epochs)})  # fmt: skip
    keys: dict[ParameterName, FloatArray] = {
        ("lens_drift", camera.camera_id, *([e] if e else [])): v for e, v in changes.items()}  # fmt: skip
    none = {key: np.zeros(len(v)) for key, v in keys.items()}
    return Remedy(name, survey, truth | keys, truth | none, next(iter(keys)), "lens_drift")


def crop(name: str, given: FloatArray, true: FloatArray) -> Remedy:
    """A stereo rig whose second camera is read at another size and region from its eighth image on."""
    survey, truth = stereo(24, n_pairs=16)
    camera = survey.cameras[1]
    crops = {"e09": ImageCrop(VectorParameter(CROP, given, CROP), (900, 760))}
    changed = replace(camera, lens=replace(camera.lens, crops=crops))
    key = ("lens_crop", camera.camera_id, "e09")
    survey = replace(survey, cameras=(survey.cameras[0], changed))
    return Remedy(name, survey, truth | {key: true}, truth | {key: given}, key, "lens_crop")


def shared(name: str, parameters: tuple[str, ...], difference: FloatArray) -> Remedy:
    """A stereo rig whose cameras are taken to have the same lens, and have not; the term is what differs."""
    survey, truth = stereo(25, n_pairs=14)
    first, second = survey.cameras
    lens = replace(second.lens, shared=LensSharing(first.camera_id, parameters))
    survey = replace(survey, cameras=(first, replace(second, lens=lens)))
    same, key = np.array(truth["lens", second.camera_id]), ("lens", second.camera_id)
    at = [MODELS["brown"].names.index(x) for x in parameters]
    same[at] = np.asarray(truth["lens", first.camera_id])[at]
    another = same.copy()
    another[at] += difference
    return Remedy(name, survey, truth | {key: another}, truth | {key: same}, key, "lens_shared")


def _of_tie(result: Adjustment, remedy: Remedy, truth: Truth) -> tuple[FloatArray, FloatArray, Significance]:
    (found,) = shared_lenses(result, estimated_sigma0=True)
    at = [MODELS["brown"].names.index(x) for x in found.names]
    true = (np.asarray(truth[remedy.of]) - np.asarray(truth["lens", found.lender]))[at]
    return found.difference - true, found.cov, found.test


def creeping(name: str, sigmas: dict[str, float], begins: tuple[str, ...]) -> Remedy:
    """A stereo rig whose second lens takes a step of these sigmas (px) at given epochs."""
    steps = np.array(list(sigmas.values()))
    zero = dict.fromkeys(begins, np.zeros(len(steps)))
    made = lens(name, zero, LensDrift(tuple(sigmas), begins, steps))
    camera = made.of[1]

    def walked(truth: Truth, rng: np.random.Generator) -> Truth:
        walk = np.cumsum(rng.normal(0.0, steps, (len(begins), len(steps))), axis=0)
        return truth | {("lens_drift", camera, e): w for e, w in zip(begins, walk, strict=True)}

    return replace(made, truth=dict(made.truth), drawn=walked)


def late(name: str, made: Made, of: ParameterName, values: dict[str, float], jitter: float = 0.0) -> Remedy:
    """Things that move smoothly, and a clock that is late; the last of its components, or the jitter, is the term."""
    true = np.array(list(values.values()))
    survey, truth = made(clocks={of[1]: clock(jitter, **values)}, true={of: true})

    def own(truth: Truth, rng: np.random.Generator) -> Truth:
        epochs = dict.fromkeys(b.epoch_id for b in survey.image_blocks)
        return truth | {(*of, e): rng.normal(0.0, jitter, 1) for e in epochs}

    term = "clock_jitter" if jitter else f"clock_{list(values)[-1]}"
    none = truth | {of: np.append(true[:-1], 0.0) if not jitter else true}
    return Remedy(name, survey, truth, none, of, term, own if jitter else lambda truth, _: truth)


def _estimated(result: Adjustment, remedy: Remedy, truth: Truth) -> tuple[FloatArray, FloatArray, Significance]:
    """What was found less what is true, its covariance, and the test of the term."""
    if remedy.term == "lens_shared":
        return _of_tie(result, remedy, truth)
    if remedy.term in ("lens_drift", "lens_crop", "clock_jitter"):
        names = [n for n in result.estimates if n[:2] == remedy.of[:2]]
        d = np.concatenate([np.asarray(result.estimates[n].value) - np.asarray(truth.get(n, 0.0)) for n in names])
        test = significance_of_changes(result, remedy.of[:2], remedy.term, estimated_sigma0=True)
        assert test is not None
        return d, np.asarray(result.precision.joint(names)), test
    estimate = result.estimates[remedy.of]
    test = next(s for s in significances(result, estimate, True) if s.term == remedy.term)
    at = [estimate.components.index(c) for c in test.components]
    return (np.asarray(estimate.value) - np.asarray(truth[remedy.of]))[at], estimate.cov[np.ix_(at, at)], test


_RIGHT = ("camera_clock", "right")
REMEDIES: dict[str, Callable[[], Remedy]] = {
    "board bent": lambda: board("board bent", "bend", {"warp_x": 3e-4, "warp_y": -2e-4, "warp_xy": 5e-5}),
    "board stretched": lambda: board("board stretched", "stretch", {"scale_y": 6e-4, "shear": -4e-4}),
    "board expands": lambda: board("board expands", "expansion", {"expansion": 80e-6}),
    "encoder eccentric": lambda: table(
        "encoder eccentric", "angle_2_order_1", {"angle_2": 2}, {"angle_2_cos_1": 2e-4, "angle_2_sin_1": -1e-4}
    ),
    "axis runs out": lambda: table(
        "axis runs out", "radial_2_order_-1", {"radial_2": 2}, {"radial_2_re_m1": 2e-4, "radial_2_im_m1": 1e-4}
    ),
    "lens by blocks": lambda: lens(
        "lens by blocks", {"e07": np.array([3.0, 1.0, 0.0]), "e13": np.array([4.0, 1.0, -1.0])},
        LensDrift(("fx", "u0", "v0"), ("e07", "e13")),
    ),
    "lens with temperature": lambda: lens(
        "lens with temperature", {"": np.array([0.5, 0.1])}, LensDrift(("fx", "u0"), (), None, 20.0)
    ),
    "images cropped": lambda: crop(
        "images cropped", np.array([0.75, 120.0, 80.0]), np.array([0.7512, 121.5, 79.0])
    ),
    "lens shared": lambda: shared("lens shared", ("fx", "fy", "k1"), np.array([2.0, 2.0, 0.004])),
    "axis wobbles": lambda: table(
        "axis wobbles", "tilt_2_order_+2", {"tilt_2": 2, "axial_2": 1}, {"tilt_2_re_p2": 3e-4, "axial_2_cos_1": 1e-4}
    ),
    "lens creeps": lambda: creeping("lens creeps", {"fx": 1.5, "u0": 0.6}, ("e05", "e09", "e13", "e17")),
    "camera late": lambda: late("camera late", board_before_cameras, _RIGHT, {"offset": 4e-4}),
    "camera's clock drifts": lambda: late(
        "camera's clock drifts", board_before_cameras, _RIGHT, {"offset": 0.01, "drift": 5e-4}),
    "rows one by one": lambda: late("rows one by one", board_before_cameras, _RIGHT, {"line_time": 2.5e-6}),
    "late, rows one by one": lambda: late(
        "late, rows one by one", board_before_cameras, _RIGHT, {"offset": 0.02, "line_time": 4e-6}),
    "epochs at times of their own": lambda: late(
        "epochs at times of their own", board_before_cameras, _RIGHT, {"offset": 0.01}, 2e-3),
    "table read late": lambda: late(
        "table read late", head_on_moving_table, ("table_clock", "turntable"), {"offset": 8e-4}),
    "robot read late": lambda: late("robot read late", camera_on_hand, ("pose_clock", "hand"), {"offset": 2.5e-3}),
}  # fmt: skip


def outcome(remedy: Remedy, repeats: int, seed: int = 1) -> Outcome:
    """Adjusted again and again with fresh noise, with the terms and without: from nothing, then from the first."""
    squares, found, false, k = [], 0, 0, 0
    start = None
    for i in range(repeats):
        truth = remedy.drawn(remedy.truth, np.random.default_rng(seed + i))
        result = adjust(resample(remedy.survey, truth, 1000 * seed + i), start)
        start = start or values_of(result, result.survey)
        d, cov, test = _estimated(result, remedy, truth)
        squares.append(float(d @ np.linalg.solve(cov, d)))
        found, k = found + test.significant, len(d)
    start = None
    for i in range(repeats):
        result = adjust(resample(remedy.survey, remedy.innocent, 1000 * seed + i), start)
        start = start or values_of(result, result.survey)
        false += _estimated(result, remedy, remedy.innocent)[2].significant
    return Outcome(k, np.array(squares), found, false)


def main() -> None:
    repeats, chosen = int(sys.argv[1]), sys.argv[2:] or list(REMEDIES)
    print("| term | freedom | mean square | in 95 % region | found | found where zero |")
    print("|---|---|---|---|---|---|")
    for name in chosen:
        o = outcome(REMEDIES[name](), repeats)
        print(f"| {name} | {o.k} | {o.squares.mean() / o.k:.2f} | {o.covered} | {o.found} | {o.false} |", flush=True)


if __name__ == "__main__":
    main()
