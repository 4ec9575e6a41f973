"""The compiled core as a whole: declarations, checks of arguments, vector instructions, threads."""

import hashlib
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from adjust.native import blocks, parallel, vision
from adjust.native.lenses import BROWN, N_LENS, lens_residuals, lens_rows
from adjust.native.library import Function, instruction_set, instruction_sets, opened
from adjust.precision.precision import Precision
from survey.simulate import beacons, head_on_table
from tests.adjust import helpers as h
from tests.adjust.native_calls import FUNCTIONS, Call, calls

ROOT = Path(__file__).parents[2]
RUNNABLE = instruction_sets()
_WORK = ("work", "row")  # scratch, of which nothing is expected afterwards
_SUMS_THAT_CANCEL = ("influence",)
"""Shares of a point in large covariances that cancel: what is left is compared, what was summed is larger."""
_LEFT = ("residual", "residuals", "squares")
"""px, px²: what is left of coordinates of a thousand px, whose last digit is 1e-13 px."""
_DIFFERENCES = (("search", "t"),)
"""m: what is left of places of beacons some metres away, near the origin next to nothing."""
_CONDITIONED = {("fit_lens", "cov"): 1e-9, ("refine_views", "poses"): 1e-11}
"""Inverses of matrices of unknowns that are hard to tell apart, which multiplies rounding; poses of single views by
normal equations: 1e-16 times the square of the condition of their rows, of the views called with up to 300.
"""


@pytest.mark.slow
def test_every_function_of_the_library_has_a_face_and_is_called() -> None:
    assert set(opened("base")) == set(FUNCTIONS)
    assert {call.function.name for call in calls()} == set(FUNCTIONS)


@pytest.mark.parametrize("instructions", RUNNABLE)
def test_declarations_are_those_of_the_library(instructions: str) -> None:
    """Number of arguments and of their dimensions is compared when a function is opened."""
    for name, function in FUNCTIONS.items():
        assert function.using(instructions).kinds() == function.kinds(), name
        assert len(opened(instructions)[name][1]) == 2 * len(function.kinds())


def test_a_declaration_that_differs_from_the_library_is_refused() -> None:
    for arguments in ("S[n]", "S[n,n] more", ""):
        with pytest.raises(TypeError, match="fill_upper: the library takes arrays of"):
            Function("fill_upper", arguments)(np.zeros((6, 6)))


@pytest.mark.slow
@pytest.mark.parametrize("instructions", RUNNABLE[1:])
@pytest.mark.parametrize("name", FUNCTIONS)
def test_vector_instructions_change_nothing(name: str, instructions: str) -> None:
    for call in calls():
        if call.function.name != name:
            continue
        (answer, plain), (other_answer, wide) = call.again("base"), call.again(instructions)
        assert answer == other_answer
        if name in ("serve", "condensed_rows"):
            squares = _squares_of_served if name == "serve" else _squares_of_condensed
            plain, wide, written = [squares(call, plain)], [squares(call, wide)], ["R'R"]
        else:
            arrays = [(argument, kind) for argument, kind in call.function.kinds() if kind not in "nd"]
            kept = [i for i, (argument, kind) in enumerate(arrays) if kind.isupper() and argument not in _WORK]
            plain, wide, written = [plain[i] for i in kept], [wide[i] for i in kept], [arrays[i][0] for i in kept]
        for argument, x, y in zip(written, plain, wide, strict=True):
            np.testing.assert_array_equal(np.isfinite(x), np.isfinite(y))
            finite = np.isfinite(x)
            if not finite.any() or x.dtype == np.bool_:
                np.testing.assert_array_equal(x, y)
                continue
            scale = max(np.abs(x[finite]).max(), 1.0 if (name, argument) in _DIFFERENCES or argument in _LEFT else 0.0)
            tolerance = _CONDITIONED.get((name, argument), 1e-11 if argument in _SUMS_THAT_CANCEL else 1e-12)
            if x.dtype == np.float32:
                tolerance = 1e-6
            assert np.abs(x[finite] - y[finite]).max() <= tolerance * scale, argument


def _squares_of_served(call: Call, arrays: list[np.ndarray]) -> np.ndarray:
    """R'R of the rows [R, r] of each block: R itself is open where a block alone determines too little."""
    names = [argument for argument, kind in call.function.kinds() if kind not in "nd"]
    a = dict(zip(names, arrays, strict=True))
    out = []
    for b in a["which"]:
        n, mine = int(a["rows"][b]), slice(int(a["first"][b]), int(a["first"][b] + a["height"][b]))
        rows = [a["r"][int(a["r_at"][b]) :][mine, None]]
        for s in range(int(a["segment_ptr"][b]), int(a["segment_ptr"][b + 1])):
            at, k = int(a["at"][b] + n * (a["place"][s] - a["within"][s])), int(a["dim"][s])
            rows.append(a["flat"][at : at + n * k].reshape(n, k)[mine])
        M = np.hstack(rows)
        out.append((M.T @ M).ravel())
    return np.concatenate(out)


def _squares_of_condensed(call: Call, arrays: list[np.ndarray]) -> np.ndarray:
    """The same of the rows over the keys, by what a block could have besides, and e."""
    names = [argument for argument, kind in call.function.kinds() if kind not in "nd"]
    a = dict(zip(names, arrays, strict=True))
    rows = np.repeat(np.arange(a["e"].size), a["length"].ravel())
    A = np.zeros((a["e"].size, int(a["columns"].max()) + 1))
    A[rows, a["column"].ravel()[: len(rows)]] = a["entry"].ravel()[: len(rows)]
    own = (a[name] for name in ("lens", "camera", "target", "shape"))
    M = np.concatenate([A.reshape(*a["e"].shape, -1), *own, a["e"][:, :, None]], axis=2)
    return np.swapaxes(M, 1, 2) @ M


def _solution(monkeypatch: pytest.MonkeyPatch, threads: int) -> str:
    """Digest of image points of boards and of beacons: solution, covariances, redundancy."""
    monkeypatch.setenv("LABSURVEY_THREADS", str(threads))
    monkeypatch.setattr(blocks, "_WORTHWHILE", 1)
    digest = hashlib.sha256()
    scenes = (
        head_on_table(1, n_cameras=2, n_table_epochs=4, n_free_epochs=3),
        beacons(1, n_table_epochs=2, n_free_epochs=2, n_night_epochs=6),
        h.network(1),
    )
    for survey, truth in scenes:
        graph, done = h.solved(survey, h.shaken(h.start_at(truth), 2, 0.002, 0.002))
        precision = Precision(graph, done)
        for name, unknown in graph.unknowns.by_name.items():
            posed, key = unknown.kind == "pose", unknown.key
            value = done.values.atPose3(key).matrix() if posed else done.values.atVector(key)
            digest.update(value.tobytes() + h.covariance_of(precision, name).tobytes())
        residuals = precision.image_residuals
        digest.update(residuals.residuals.tobytes() + residuals.redundancy.tobytes())
        digest.update(f"{done.omega.hex()} {done.iterations}".encode())
    return digest.hexdigest()


@pytest.mark.slow
def test_threads_do_not_change_a_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    taken: list[int] = []
    shared_out = parallel.shared_out

    def counted(function: Any, parts: Any) -> Any:
        taken.append(parallel.workers())
        return shared_out(function, parts)

    monkeypatch.setattr(parallel, "shared_out", counted)
    alone = _solution(monkeypatch, 1)
    assert not taken
    assert _solution(monkeypatch, 2) == alone
    assert _solution(monkeypatch, 3) == alone
    assert {2, 3} <= set(taken)


_TRY = Function("lens_rows", "kind lens[*] constants[4] q[n,3] uv[n,2] residuals[n,2] rows[*,2,17]")


def _given(**other: Any) -> list[Any]:
    given = {"kind": BROWN, "lens": np.ones(13), "constants": np.ones(4), "q": np.ones((5, 3)), "uv": np.ones((5, 2)),
             "residuals": np.zeros((5, 2)), "rows": np.zeros((5, 2, 17))}  # fmt: skip
    return list((given | other).values())


def _locked(a: np.ndarray) -> np.ndarray:
    a.setflags(write=False)
    return a


@pytest.mark.parametrize(
    ("argument", "value", "error", "text"),
    [
        ("q", np.ones((5, 3), np.float32), TypeError, "must be an array of float64, not an array of float32"),
        ("q", np.ones((5, 3), ">f8"), TypeError, "must be an array of float64, not an array of >f8"),
        ("q", [[1.0, 2.0, 3.0]], TypeError, "must be an array of float64, not list"),
        ("q", None, TypeError, "must be an array of float64, not NoneType"),
        ("q", np.ones(15), ValueError, r"must be \(n, 3\), not \(15,\)"),
        ("q", np.ones((5, 4)), ValueError, r"must be \(n, 3\), not \(5, 4\)"),
        ("uv", np.ones((6, 2)), ValueError, r"must be \(n, 2\), not \(6, 2\) with {'n': 5}"),
        ("residuals", np.zeros((0, 2)), ValueError, r"must be \(n, 2\), not \(0, 2\)"),
        ("q", np.ones((5, 3), order="F"), ValueError, "must be contiguous"),
        ("q", np.ones((10, 3))[::2], ValueError, "must be contiguous"),
        ("q", np.broadcast_to(np.ones(3), (5, 3)), ValueError, "must be contiguous"),
        ("q", np.zeros(121, np.uint8)[1:].view(np.float64).reshape(5, 3), ValueError, "must be contiguous"),
        ("residuals", _locked(np.zeros((5, 2))), ValueError, "must be contiguous and writable"),
        ("kind", "brown", TypeError, "must be a whole number, not str"),
        ("kind", 0.5, TypeError, "must be a whole number, not float"),
        ("kind", 2**70, TypeError, "must be a whole number"),
    ],
)
def test_an_argument_that_does_not_fit_is_named(argument: str, value: Any, error: type, text: str) -> None:
    with pytest.raises(error, match=f"lens_rows: {argument} {text}"):
        _TRY(*_given(**{argument: value}))


def test_what_has_changed_since_the_last_call_is_seen() -> None:
    """An array that is given again, and shapes that fitted once."""
    given = _given()
    q, residuals, rows = given[3], given[5], given[6]
    assert _TRY(*given) == 0
    q[:] = [[0.1, 0.2, 2.0]]
    assert _TRY(*given) == 0
    expected = residuals.copy()
    with pytest.raises(ValueError, match="cannot resize"):  # which would move what it holds
        q.resize((1000, 3), refcheck=False)
    q.shape = (15, 1)
    with pytest.raises(ValueError, match=r"lens_rows: q must be \(n, 3\), not \(15, 1\)"):
        _TRY(*given)
    q.shape = (5, 3)
    residuals[:] = 0.0
    assert _TRY(*given) == 0
    np.testing.assert_array_equal(residuals, expected)
    rows.setflags(write=False)
    with pytest.raises(ValueError, match="lens_rows: rows must be contiguous and writable"):
        _TRY(*given)


def test_what_is_only_read_may_be_locked_and_numbers_may_be_numpys() -> None:
    assert _TRY(*_given(q=_locked(np.ones((5, 3))), kind=np.int64(BROWN))) == 0


def test_numbers_and_their_count_are_checked() -> None:
    rays = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3))
    with pytest.raises(TypeError, match=r"three_point_poses: nearest must be a number, not str"):
        FUNCTIONS["three_point_poses"](*rays, "0", 1.0, np.zeros((8, 3, 3)), np.zeros((8, 3)))
    with pytest.raises(TypeError, match="three_point_poses takes 7 arguments, 6 were given"):
        FUNCTIONS["three_point_poses"](*rays, 0.0, 1.0, np.zeros((8, 3, 3)))


@pytest.mark.parametrize(("kind", "n"), [(BROWN, 12), (len(N_LENS), 13), (-1, 13)])
def test_a_lens_of_no_model_or_with_too_few_parameters_is_refused(kind: int, n: int) -> None:
    given = kind, np.ones(n), np.ones(4), np.ones((5, 3)), np.ones((5, 2))
    for function in (lens_rows, lens_residuals):
        with pytest.raises(ValueError, match="lens"):
            function(*given)


@pytest.mark.parametrize("start", [(np.nan, 20.0), (np.inf, 20.0), (1e300, 20.0), (-50.0, 20.0), (20.0, 61.0)])
def test_a_fit_that_begins_nowhere_finds_nothing(start: tuple[float, float]) -> None:
    image, places, one = np.full((60, 80), 30.0, np.float32), np.array([start]), np.ones(1)
    edges, none = np.array([[[20.0, 0.0], [1.0, 20.0]]]), np.zeros(1)
    good = vision.refine_corners(image, places, edges, 8.0 * one, True, 0.0, none, none)[4]
    assert good.tolist() == [False]
    none = np.zeros((60, 80), np.int64), 255.0, places, np.ones(1, np.int64)
    assert vision.fit_spots(image, *none, 5.0 * one, 100.0 * one, one)[1].tolist() == [-1]


def _told(**environment: str) -> tuple[int, str]:
    done = subprocess.run([sys.executable, "-m", "survey", "--version"], cwd=ROOT, capture_output=True, text=True,
                          env=os.environ | {"PYTHONPATH": str(ROOT)} | environment, check=False)  # fmt: skip
    return done.returncode, done.stdout + done.stderr


@pytest.mark.slow
def test_version_tells_which_instructions_run() -> None:
    assert instruction_set() in RUNNABLE
    assert _told()[1].strip().endswith(f"(native core: {instruction_set()})")
    assert _told(LABSURVEY_VECTORS="base")[1].strip().endswith("(native core: base)")
    code, text = _told(LABSURVEY_VECTORS="sse9")
    assert code == 1
    assert f"LABSURVEY_VECTORS is 'sse9'; here run: {', '.join(RUNNABLE)}" in text
    assert "Traceback" not in text
