"""What a search for gross errors is asked for and gives back."""

from dataclasses import field
from typing import Literal

import numpy as np

from adjust.adjustment import AdjustOptions
from adjust.model.frozen import frozen
from adjust.model.result import Adjustment, Decision, ObservationResidual
from adjust.statistics.result import Alternative

GLOBAL = 100.0**2
"""Factor of variances from which not single observations are wrong, but a unit, a sense or a name of them all."""


@frozen
class SearchOptions:
    """family_alpha: error probability of all tests together.

    kinds: which may be left out (kinds as in ``ObservationResidual``, "image" for image points); None for all but
    priors.
    """

    family_alpha: float = 0.001
    kinds: tuple[str, ...] | None = None
    adjust: AdjustOptions = field(default_factory=AdjustOptions)


Action = Literal["rejected", "readmitted"]
DEFAULT_SEARCH = SearchOptions()


@frozen(eq=False)
class OutlierSearch:
    """The clean least squares, and how it was found.

    rejected: what is out in the end, worst first. log: every decision in order, also those taken back. suspects: what
    fails its test but cannot be left out, because something would be undetermined without it, or because it is a prior
    or of a kind that is kept. converged: whether the last round changed nothing. alternatives: where other observations
    could be the wrong ones. cautious: groups whose residuals are all together far smaller than their sigmas say; of
    them nothing is left out. widened: factors of the variances of groups that are too small throughout.
    """

    adjustment: Adjustment
    rejected: tuple[Decision, ...]
    log: tuple[Decision, ...]
    suspects: tuple[Decision, ...]
    converged: bool
    alternatives: tuple[Alternative, ...] = ()
    cautious: tuple[str, ...] = ()
    widened: tuple[tuple[str, float], ...] = ()

    @property
    def notes(self) -> tuple[str, ...]:
        """For people, worst first."""
        pairs = {o.ids: o for o in self.adjustment.other_residuals if o.kind == "pair" and not o.used}
        notes = tuple(_said_of_pair(pairs[d.ids], d) if d.ids in pairs else d.text() for d in self.rejected)
        notes += tuple(a.text() for a in self.alternatives)
        notes += tuple(
            f"group {g}: its typical observation contradicts the rest; sigmas {np.sqrt(f):.1f} times as large explain "
            f"that better than wrong observations do, and none was left out for it; {_to_check(f)}"
            for g, f in self.widened
        )
        stays = "stays, for the residuals of group {} are together far smaller than its sigmas say"
        why = (stays.format(d.group) if d.group in self.cautious else "cannot be left out" for d in self.suspects)
        said = (d.text().split(": ", 1)[1] for d in self.suspects)
        return notes + tuple(f"fails its test, but {w}: {text}" for w, text in zip(why, said, strict=True))


def _to_check(factor: float) -> str:
    if factor > GLOBAL:
        return "check its units, the sense of its angles and the names in it"
    return "check its sigmas, and those of what it is compared with, or estimate variance components"


def _said_of_pair(o: ObservationResidual, d: Decision) -> str:
    """In degrees and metres."""
    turn = np.degrees(np.linalg.norm(o.residual[:3]))
    shift = f" and {np.linalg.norm(o.residual[3:]):.4g} m" if len(o.residual) == 6 else ""
    return f"left out: pair {o.ids[0]}: off by {turn:.4g} deg{shift}, test {d.statistic:.1f}, p {d.p:.2g}"
