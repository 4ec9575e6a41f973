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
from adjust.model.result import ParameterName
from adjust.model.survey import FloatArray, Survey, VectorParameter
from adjust.testing.distributions import chi2
from adjust.testing.significance import significances
from survey.simulate import Truth, resample, stereo


@dataclass(frozen=True, eq=False)
class Remedy:
    """A survey that estimates some terms, with their true values and without them; which estimate they are part of."""

    name: str
    survey: Survey
    truth: Truth
    innocent: Truth
    of: ParameterName
    term: str


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


REMEDIES: dict[str, Callable[[], Remedy]] = {
    "board bent": lambda: board("board bent", "bend", {"warp_x": 3e-4, "warp_y": -2e-4, "warp_xy": 5e-5}),
    "board stretched": lambda: board("board stretched", "stretch", {"scale_y": 6e-4, "shear": -4e-4}),
    "board expands": lambda: board("board expands", "expansion", {"expansion": 80e-6}),
}


def outcome(remedy: Remedy, repeats: int, seed: int = 1) -> Outcome:
    """Adjusted again and again with fresh noise, with the terms and without."""
    squares, found, false, k = [], 0, 0, 0
    for i in range(repeats):
        for truth in (remedy.truth, remedy.innocent):
            result = adjust(resample(remedy.survey, truth, 1000 * seed + i))
            estimate = result.estimates[remedy.of]
            test = next(s for s in significances(result, estimate, True) if s.term == remedy.term)
            if truth is remedy.innocent:
                false += test.significant
                continue
            at = [estimate.components.index(c) for c in test.components]
            d = (np.asarray(estimate.value) - np.asarray(truth[remedy.of]))[at]
            squares.append(float(d @ np.linalg.solve(estimate.cov[np.ix_(at, at)], d)))
            found, k = found + test.significant, len(at)
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
