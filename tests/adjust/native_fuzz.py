"""Damages what the core is given, call after call: it must answer, or refuse with the function's name in the message.

    python -m tests.adjust.native_fuzz --seconds 60 --seed 2
    python tests/native_checked.py -m tests.adjust.native_fuzz --seconds 60      # under sanitizers

Shapes, kinds and order of arrays are damaged where the declaration says what they must be, and then a refusal is
demanded; numbers become NaN, infinite, huge, tiny, zero or negative anywhere, and then the call must end. Indices in
integer arrays stay: the packages make them, the checked build watches over them. What is done is written to stderr
before it is done, so that a crash leaves the call that crashed as the last line.
"""

import argparse
import sys
import time
from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np

from tests.adjust.native_calls import Call, calls

_NUMBERS = (np.nan, np.inf, -np.inf, 0.0, -0.0, 1e308, -1e308, 1e-308, 5e-324, -1.0, 1e15, 0.5)
_TOO_LONG_S = 60.0  # of this process alone; sanitizers are slow


def main() -> int:
    """Fuzz for a while; 0, or 1 with a finding."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=5.0, help="of computing")
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    rng, made, end = np.random.default_rng(given.seed), calls(), time.process_time() + given.seconds
    counts: Counter[str] = Counter()
    while time.process_time() < end:
        for number in rng.permutation(len(made)):
            if time.process_time() > end:
                break
            counts[_try(made[number], rng)] += 1
    print(", ".join(f"{n} {what}" for what, n in sorted(counts.items())))
    return 1 if counts["finding"] else 0


def _try(call: Call, rng: np.random.Generator) -> str:
    call = replace(call, arguments=tuple(a.copy() if isinstance(a, np.ndarray) else a for a in call.arguments))
    damage = _of_numbers if rng.random() < 0.5 else _of_shapes
    arguments, what = damage(call, rng)
    if what is None:
        return "left alone"
    print(f"\r{call.function.name}: {what}" + " " * 40, end="", file=sys.stderr, flush=True)
    begin = time.process_time()
    try:
        with np.errstate(all="ignore"):
            call.function(*arguments)
    except (TypeError, ValueError) as error:
        named = str(error).startswith(call.function.name)
        if damage is _of_shapes and named:
            return "refused"
        print(f"\nFINDING {call.function.name}: {what}: {error!r}")
        return "finding"
    if damage is _of_shapes:
        print(f"\nFINDING {call.function.name}: {what}: not refused")
        return "finding"
    if time.process_time() - begin > _TOO_LONG_S:
        print(f"\nFINDING {call.function.name}: {what}: took {time.process_time() - begin:.0f} s")
        return "finding"
    return "answered"


def _of_numbers(call: Call, rng: np.random.Generator) -> tuple[tuple[Any, ...], str | None]:
    """Some elements of the floating point arrays, or a number."""
    arguments = list(call.arguments)
    kinds = call.function.kinds()
    places = [i for i, (_, kind) in enumerate(kinds) if kind in "fsd" and np.size(arguments[i])]
    if not places:
        return call.arguments, None
    told = []
    for i in rng.choice(places, min(len(places), int(rng.integers(1, 4))), replace=False):
        value = float(rng.choice(_NUMBERS))
        told.append(f"{kinds[i][0]} {value}")
        if kinds[i][1] == "d":
            arguments[i] = value
            continue
        array = arguments[i].copy()
        n = int(rng.choice([1, 2, array.size]))
        with np.errstate(over="ignore"):
            array.reshape(-1)[rng.integers(0, array.size, n)] = value
        arguments[i] = array
    return tuple(arguments), ", ".join(told)


def _of_shapes(call: Call, rng: np.random.Generator) -> tuple[tuple[Any, ...], str | None]:
    """One array that can no longer be what was declared."""
    arguments, kinds = list(call.arguments), call.function.kinds()
    shapes = [shape for _, shape in call.function.shapes()]  # by place: of several of one name each has its own
    places = [i for i, (_, kind) in enumerate(kinds) if kind not in "nd"]
    i = int(rng.choice(places))
    name, array = kinds[i][0], arguments[i]
    bound = [k for k, size in enumerate(shapes[i]) if isinstance(size, int) or _named_elsewhere(size, i, shapes)]
    ways = ["kind", "dimension", "nothing", "number"]
    ways += ["length", "empty"] * bool(bound) + ["order"] * (min(array.shape) > 1 and array.ndim > 1)
    ways += ["stride"] * (array.size > 1) + ["locked"] * kinds[i][1].isupper()
    way = str(rng.choice(ways))
    if way == "kind":
        array = array.astype(np.complex128)
    elif way == "dimension":
        array = array[None] if rng.random() < 0.5 or array.ndim == 0 else array.reshape(array.shape + (1,))
    elif way == "nothing":
        array = None
    elif way == "number":
        array = 1.0
    elif way == "length":
        k = int(rng.choice(bound))
        array = np.concatenate([array, np.zeros_like(array, shape=_one(array, k))], k)
    elif way == "empty":
        k = int(rng.choice(bound))
        if array.shape[k] == 0:
            return call.arguments, None
        array = np.take(array, [], k)
    elif way == "order":
        array = np.asfortranarray(array)
    elif way == "stride":
        array = np.repeat(array, 2, axis=-1)[..., ::2]
        if array.flags.c_contiguous:
            return call.arguments, None
    else:
        array = array.copy()
        array.setflags(write=False)
    arguments[i] = array
    return tuple(arguments), f"{name} {way}"


def _one(array: np.ndarray, k: int) -> tuple[int, ...]:
    return tuple(1 if j == k else n for j, n in enumerate(array.shape))


def _named_elsewhere(size: Any, i: int, shapes: list[Any]) -> bool:
    """Whether another array has this length by name, so that a change is seen."""
    return size is not None and any(
        isinstance(other, tuple) and other[0] == size[0]
        for j, shape in enumerate(shapes) if j != i for other in shape
    )


if __name__ == "__main__":
    sys.exit(main())
