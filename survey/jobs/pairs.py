"""The job of ``labsurvey pairs``: pairs of a station's eyes from a folder, their loops, and a project to close them.

>>> outcome = station_pairs(Path("lab"), out=Path("closed"))  # then: labsurvey adjust closed
>>> print(outcome.text())
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from gtsam import Pose3

from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.observations import FrameRef, Pair, frame_text
from adjust.model.survey import FloatArray, PoseParameter, Station, Survey
from adjust.relay.eyes.drift import sequences
from adjust.relay.eyes.eyes import adjust_eyes
from adjust.relay.eyes.pairs import EyePairs, triangle_misclosure
from adjust.relay.network import gtsam_motion
from adjust.testing.criteria import sidak
from adjust.testing.distributions import chi2
from survey.folder.whole import whole_folder
from survey.jobs.relay import (
    RelayPairs,
    looped,
    one_metre,
    read_trajectories,
    relay_pairs,
    relay_text,
    relay_trackers,
    tracker_pairs,
)
from survey.project import AdjustmentOptions, write_project
from survey.project.project import DEFINITION_FILE
from survey.solution.quantities import ARCSEC_PER_RAD, first_row, pair_sigmas, pose_dict

TRAJECTORIES = "trajectories"
_ENDINGS = (".csv", ".txt", ".tum")
_ALPHA = 0.001
_OPTIONS = AdjustmentOptions(sigmas="a_priori")
"""Pairs that share errors close their loops too well, so sigma0 says nothing of them."""


@frozen(eq=False)
class PairsOutcome:
    """What was found and where it stands. written: the project folder with the pairs, None where none was asked for.

    joint: whether it holds the station from all eyes at once, one pair from the first eye to each other.
    """

    source: str
    found: RelayPairs
    triangles: tuple[dict[str, Any], ...]
    written: Path | None = None
    joint: bool = False

    def summary(self) -> dict[str, Any]:
        """Eyes, pairs (alone, with loops closed, from all eyes at once) and misclosures as plain values."""
        found, test = self.found, self.found.joint.global_test()
        return {
            "source": self.source,
            "eyes": [frame_text(eye) for eye in found.joint.eyes],
            "sigma0": found.joint.sigma0 if found.joint.redundancy else None,
            "redundancy": found.joint.redundancy,
            "global_test": None if test is None else test.status,
            "refused": list(found.eyes.refused),
            "left_out": [str(outlier) for outlier in found.joint.outliers],
            "pairs": self._pairs(),
            "loops": list(self.triangles),
            "written": None if self.written is None else str(self.written),
            "warnings": list(self.warnings()),
        }

    def warnings(self) -> tuple[str, ...]:
        """What is odd about the observations, and what about the sigmas of an adjustment of the written pairs."""
        closed = self.found.closed
        if self.written is None or self.joint or closed is None:
            return self.found.warnings
        actual, claimed = (np.diagonal(c, axis1=1, axis2=2) for c in (closed.actual_cov, closed.claimed_cov))
        factor = float(np.sqrt(np.mean(actual / claimed)))
        return (
            *self.found.warnings,
            f"pairs of one eye share its errors, but {self.written} takes them as independent: sigmas of its "
            f"adjustment are {factor:.2f} times too small; those under 'loops closed' are right, --joint "
            "writes no loops",
        )

    def _pairs(self) -> dict[str, Any]:
        closed, joint = self.found.closed, self.found.joint_pairs()
        out = {}
        for i, pair in enumerate(self.found.eyes.pairs):
            entry: dict[str, Any] = {"a": frame_text(pair.a), "b": frame_text(pair.b)}
            entry["alone"] = _entry(pair.b_from_a, pair.cov)
            if closed is not None:
                adjusted = gtsam_motion(closed.adjusted.pairs.b_from_a, i)
                entry["loops_closed"] = _entry(adjusted, closed.actual_cov[i])
            out[pair.pair_id] = entry | {"all_at_once": _entry(joint[i].b_from_a, joint[i].cov)}
        return out

    def text(self) -> str:
        """Summary for people."""
        lines = [*(f"warning: {text}" for text in self.warnings()), relay_text(self.found).rstrip()]
        if self.triangles:
            open_ones = sum(not t["closes"] for t in self.triangles)
            lines.append(f"loops: {len(self.triangles)} triangles, of which {open_ones} do not close; the worst first")
        for t in sorted(self.triangles, key=lambda t: float(t["p_value"]))[:5]:
            size = f"{t['misclosure_arcsec']:.1f} arcsec {t['misclosure_mm']:.3f} mm"
            flag = "" if t["closes"] else "  OPEN"
            lines.append(f"  {' '.join(t['eyes']):<30}{size:>28}  p {t['p_value']:.2g}{flag}")
        return "\n".join(lines)


def station_pairs(
    folder: str | Path, *, station: str | None = None, out: str | Path | None = None, joint: bool = False
) -> PairsOutcome:
    """Pairs of a station's eyes (cameras, marker blocks, trackers) from the images or trajectories of a folder.

    A folder with ``trajectories/`` has one file for each tracker; else it is a project with image points. out: the
    project folder to be written, in which every eye is a station and ``observations/pairs.csv`` holds each pair as its
    two eyes alone give it, so that adjusting it closes the loops; joint: instead the station from all eyes at once.
    Raises SurveyError where nothing is found, and where ``out`` holds something; nothing has been written then.
    """
    folder = Path(folder)
    found = _from_trajectories(folder, station) if (folder / TRAJECTORIES).is_dir() else relay_pairs(folder, station)
    if out is not None:
        write_pair_project(Path(out), star(found) if joint else found.eyes.pairs, f"Pairs of {folder.name}")
    return PairsOutcome(folder.name, found, triangles(found.eyes), None if out is None else Path(out), joint)


def _from_trajectories(folder: Path, station: str | None) -> RelayPairs:
    if station is not None:
        raise SurveyError(f"{folder / TRAJECTORIES}: its files are of one station; leave the station's name away")
    paths = sorted(p for p in (folder / TRAJECTORIES).iterdir() if p.suffix.lower() in _ENDINGS)
    by_id = {p.stem: p for p in paths}
    if len(by_id) < len(paths) or len(by_id) < 3:
        raise SurveyError(
            f"{folder / TRAJECTORIES}: {len(paths)} files ({', '.join(p.name for p in paths) or 'none'}); put one "
            "EYE.csv for each of three or more eyes there, with lines t,x,y,z,qx,qy,qz,qw"
        )
    trackers = relay_trackers(read_trajectories(by_id))
    eyes = tracker_pairs(trackers)
    joint = adjust_eyes(sequences(one_metre(trackers), trackers.drift))
    return RelayPairs(eyes, looped(eyes), joint, trackers.warnings)


def star(found: RelayPairs) -> tuple[Pair, ...]:
    """The station from all eyes at once, as independent relations: from its first eye to each other one."""
    first, *others = found.joint.eyes
    return tuple(found.joint.pair(first.frame_id, other.frame_id) for other in others)


def triangles(eyes: EyePairs) -> tuple[dict[str, object], ...]:
    """Misclosures of all triangles whose three pairs were found, from the pairs alone: lengths, and whether by chance.

    The test is w' inv(C) w, chi-square with 6 degrees of freedom, C with what pairs of one eye share.
    """
    ids = list(dict.fromkeys(end.frame_id for p in eyes.pairs for end in (p.a, p.b)))
    known = {p.pair_id for p in eyes.pairs}
    out = []
    three = [t for t in combinations(ids, 3) if {f"{t[0]}-{t[1]}", f"{t[1]}-{t[2]}", f"{t[0]}-{t[2]}"} <= known]
    for names in three:
        w, _, cov = triangle_misclosure(eyes, *names)
        test = float(w @ np.linalg.solve(cov, w))
        p, turn, shift = float(chi2.sf(test, 6)), np.linalg.norm(w[:3]), np.linalg.norm(w[3:])
        out.append({
            "eyes": list(names), "misclosure_arcsec": float(ARCSEC_PER_RAD * turn), "misclosure_mm": float(1e3 * shift),
            "test": test, "p_value": p, "closes": p >= sidak(_ALPHA, len(three)),
        })  # fmt: skip
    return tuple(out)


def write_pair_project(folder: Path, pairs: Sequence[Pair], title: str) -> Path:
    """A project in which every eye is a station and the first of them the world; the path of its ``pairs.csv``.

    Raises SurveyError for a folder that holds something.
    """
    eyes = list(dict.fromkeys(end for p in pairs for end in (p.a, p.b)))
    ids = [eye.frame_id for eye in eyes]
    names = {e: e.frame_id if ids.count(e.frame_id) == 1 else f"{e.kind}_{e.frame_id}" for e in eyes}
    held = PoseParameter(Pose3(), "held")
    stations = tuple(
        Station(names[eye], world_from_station=held) if i == 0 else Station(names[eye]) for i, eye in enumerate(eyes)
    )
    moved = tuple(
        replace(p, a=FrameRef("station", names[p.a]), b=FrameRef("station", names[p.b])) for p in pairs
    )
    with whole_folder(folder) as place:
        write_project(place, Survey(stations=stations, pairs=moved), title=title, options=_OPTIONS)
    return folder / DEFINITION_FILE


def _entry(b_from_a: Any, cov: FloatArray) -> dict[str, object]:
    pose = b_from_a if isinstance(b_from_a, Pose3) else Pose3(b_from_a, np.zeros(3))
    sigmas = first_row(pair_sigmas(pose.rotation().matrix()[None], cov[None]))
    return pose_dict(pose) | sigmas | {"cov": cov.tolist()}
