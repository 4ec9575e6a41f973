"""Jobs of a relay station: its pairs from the images of a project, or from the trajectories of trackers.

>>> found = relay_pairs(Path("lab"))  # every two cameras, their loops closed, and all of them at once
>>> print(relay_text(found)); write_relay_pairs(Path("out"), found.eyes.pairs)
>>> found = relay_trackers([read_trajectory(path, eye_id) for ...])
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from gtsam import Pose3, Rot3

from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.observations import FrameRef, Pair
from adjust.model.result import Adjustment
from adjust.model.subsets import in_use
from adjust.model.survey import FloatArray, Survey
from adjust.relay.eyes.drift import DriftModel, choose_interval, growth, sequences
from adjust.relay.eyes.eyes import EyeAdjustment, EyeOptions, adjust_eyes
from adjust.relay.eyes.images import eye_sequences
from adjust.relay.eyes.pairs import EyePairs, LoopedPairs, close_loops, pairs_of
from adjust.relay.eyes.trajectories import CommonMotions, TimeOffset, Trajectory, time_offset
from adjust.spatial.rigid import rotation_log
from adjust.spatial.rigid_motions import Motions
from survey.folder.text import read_text
from survey.project import read
from survey.project.tables.files import write_table
from survey.project.tables.pairs import pair_columns

_INTERVALS_S = (1.0, 1.5, 2.0, 3.0, 4.0)
_MISSED = 0.5  # of the sigma of a motion that the cubics between poses may miss
_GROWTH_S = (0.1, 0.3, 1.0, 3.0, 9.0)
_COLUMNS = ("t_s", "x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")


@frozen(eq=False)
class RelayPairs:
    """eyes: every two eyes by themselves. closed: the same with loops closed, None without loop. joint: all at once.

    warnings: what the observations look like that they should not.
    """

    eyes: EyePairs
    closed: LoopedPairs | None
    joint: EyeAdjustment
    warnings: tuple[str, ...] = ()

    def joint_pairs(self) -> tuple[Pair, ...]:
        """The same pairs from all eyes at once."""
        return tuple(self.joint.pair(p.a.frame_id, p.b.frame_id, p.group) for p in self.eyes.pairs)


@frozen(eq=False)
class RelayTrackers:
    """What trackers on one station gave: clocks against the first, drift, pairs; growth (L, k - 1, 2) by interval.

    warnings: what the trajectories look like that they should not.
    """

    offsets: tuple[TimeOffset, ...]
    drift: DriftModel
    common: CommonMotions
    joint: EyeAdjustment
    growth_intervals_s: tuple[float, ...]
    growth: FloatArray
    warnings: tuple[str, ...] = ()


def relay_pairs(source: Path | str | Survey | Adjustment, station_id: str | None = None) -> RelayPairs:
    """Pairs of a station's cameras from a project folder, a survey or an adjustment of one.

    These pairs contain the images: adjust them with other pairs, not together with the same images.
    Raises SurveyError where nothing is found or determined.
    """
    survey = read(Path(source)).survey if isinstance(source, Path | str) else source
    found = eye_sequences(in_use(survey) if isinstance(survey, Survey) else survey, station_id)
    eyes = pairs_of(found)
    return RelayPairs(eyes, looped(eyes), adjust_eyes(found))


def looped(eyes: EyePairs) -> LoopedPairs | None:
    """The pairs with their loops closed; None where they close none."""
    return close_loops(eyes) if len(eyes.pairs) >= len({end for p in eyes.pairs for end in (p.a, p.b)}) else None


def relay_trackers(trajectories: Sequence[Trajectory]) -> RelayTrackers:
    """Three or more trackers on one station: clocks, drift, eyes. Raises SurveyError as the steps do."""
    offsets = tuple(time_offset(trajectories[0], x) for x in trajectories[1:])
    shifts = [0.0, *(o.offset_s for o in offsets)]
    drift, joint, common = choose_interval(trajectories, shifts, _INTERVALS_S)
    fitting = tuple(s for s in _GROWTH_S if 2.0 * s < np.ptp(common.times_s))
    grown = growth(trajectories, shifts, joint, fitting)
    warnings = _unit_warnings(joint) + _rate_warnings(trajectories, drift)
    return RelayTrackers(offsets, drift, common, joint, fitting, grown, warnings)


def tracker_pairs(found: RelayTrackers) -> EyePairs:
    """Every two trackers by themselves, lengths in those of the first; all intervals, as the drift was found."""
    return pairs_of(sequences(one_metre(found), found.drift), EyeOptions(reject=False))


def one_metre(found: RelayTrackers) -> CommonMotions:
    """The motions with all lengths in those of the first tracker."""
    common, scales = found.common, found.joint.scales
    motions = (m.rescaled(scales.get(e.frame_id, 1.0)) for e, m in zip(common.eyes, common.motions, strict=True))
    return replace(common, motions=tuple(motions))


def _unit_warnings(joint: EyeAdjustment) -> tuple[str, ...]:
    """Trackers whose lengths are a power of ten of the first one's."""
    powers = {eye: np.log10(scale) for eye, scale in joint.scales.items()}
    return tuple(
        f"lengths of {eye} times {10.0 ** round(p):g} are those of {joint.eyes[0].frame_id}: one of the two is not in "
        "metres; write x, y, z of all in metres"
        for eye, p in powers.items() if round(p) and abs(p - round(p)) < 0.02
    )  # fmt: skip


def _rate_warnings(trajectories: Sequence[Trajectory], drift: DriftModel) -> tuple[str, ...]:
    """Trackers whose motion between poses is uncertain, in what motions of theirs are uncertain by in all."""
    out = []
    for i, x in enumerate(trajectories):
        missed = x.missed_between()
        whole = np.array([drift.rotation[i], drift.position[i]]) * np.sqrt(drift.interval_s)
        if (missed > _MISSED * whole).any():
            rate = (len(x.times_s) - 1) / np.ptp(x.times_s)
            enough = rate * float((missed / (_MISSED * whole)).max() * 3.0) ** 0.25
            out.append(
                f"{x.eye.frame_id}: {rate:.2g} poses a second are too few for its motion: those in between are off by "
                f"{1e3 * missed[0]:.2g} mrad and {1e3 * missed[1]:.2g} mm, which sigmas hold in part only and which "
                f"opens triangles; record {np.ceil(enough):.0f} a second, or move more slowly"
            )
    return tuple(out)


def read_trajectory(text: str, eye_id: str, name: str = "trajectory") -> Trajectory:
    """A trajectory from lines ``t, x, y, z, qx, qy, qz, qw`` (s, m, unit quaternion of ``world_from_eye``).

    The values stand between commas or, as in TUM's files, between blanks.
    A first line may name the columns. Poses repeated with the same time and value are kept once. Raises SurveyError
    naming the line for anything else that is not a trajectory.
    """
    rows: list[list[float]] = []
    for line, words in enumerate(text.splitlines(), 1):
        row = words.split(",") if "," in words else words.split()
        if not row or row[0].lstrip().startswith("#") or (not rows and _is_header(row)):
            continue
        if len(row) != len(_COLUMNS):
            raise SurveyError(
                f"{name}:{line}: {len(row)} columns, expected {', '.join(_COLUMNS)} between commas or blanks"
            )
        try:
            values = [float(x) for x in row]
        except ValueError as error:
            raise SurveyError(f"{name}:{line}: {error}; expected numbers in {', '.join(_COLUMNS)}") from error
        if rows and values == rows[-1]:
            continue
        if rows and values[0] <= rows[-1][0]:
            what = "comes twice with different poses" if values[0] == rows[-1][0] else "goes backwards"
            raise SurveyError(f"{name}:{line}: time {values[0]} {what}; sort the poses and keep one for each time")
        if not all(abs(x) < 1e15 for x in values):
            raise SurveyError(f"{name}:{line}: found {', '.join(f'{x:g}' for x in values)}; every value must be finite")
        if abs((length := float(np.linalg.norm(values[4:]))) - 1.0) > 1e-3:
            raise SurveyError(f"{name}:{line}: qx,qy,qz,qw is not a unit quaternion, its length is {length:.4g}")
        rows.append(values)
    if len(rows) < 3:
        raise SurveyError(f"{name}: {len(rows)} poses make no trajectory; record about ten a second")
    table = np.array(rows)
    rotation = np.array([Rot3.Quaternion(w, x, y, z).matrix() for x, y, z, w in table[:, 4:].tolist()])
    return Trajectory(FrameRef("camera", eye_id), table[:, 0].copy(), Motions(rotation, table[:, 1:4].copy()))


def _is_header(row: Sequence[str]) -> bool:
    """Whether words name the columns, with or without their units."""
    named = [word.strip().lower().partition("_")[0] for word in row]
    return named == [column.partition("_")[0] for column in _COLUMNS]


def read_trajectories(paths: Mapping[str, Path]) -> tuple[Trajectory, ...]:
    """Trajectory files by the ids of their eyes. Raises SurveyError naming file and line."""
    return tuple(read_trajectory(read_text(Path(path)), eye_id, str(path)) for eye_id, path in paths.items())


def write_relay_pairs(folder: Path, pairs: Sequence[Pair]) -> Path:
    """Write ``pairs.csv`` into a folder, with full covariances. Raises SurveyError where there is one already."""
    if (folder / "pairs.csv").exists():
        raise SurveyError(f"{folder / 'pairs.csv'} exists; write into another folder or move it away")
    return write_table(folder, "pairs", pair_columns(pairs))


def relay_text(found: RelayPairs) -> str:
    """Summary for people: problems first, then every pair alone, with loops closed and from all eyes at once."""
    lines = [f"refused: {text}" for text in found.eyes.refused]
    lines += [f"left out: {outlier}" for outlier in found.joint.outliers]
    test = found.joint.global_test()
    verdict = "" if test is None else f", global test {'passed' if test.passed else 'failed'}"
    lines.append(
        f"{len(found.joint.eyes)} eyes, {len(found.eyes.pairs)} pairs; sigma0 {found.joint.sigma0:.3f} with redundancy "
        f"{found.joint.redundancy}{verdict}"
    )
    lines.append("pair                 alone: arcsec     mm   loops closed: arcsec     mm   all at once: arcsec     mm")
    joint = found.joint_pairs()
    for i, pair in enumerate(found.eyes.pairs):
        covs = [pair.cov, None if found.closed is None else found.closed.actual_cov[i], joint[i].cov]
        cells = [_sigmas(cov) for cov in covs]
        lines.append(f"{pair.pair_id:<20} {cells[0]:>20} {cells[1]:>22} {cells[2]:>22}")
    return "\n".join(lines) + "\n"


def trackers_text(found: RelayTrackers) -> str:
    """Summary for people: clocks, drift, scales, pairs."""
    ids = [eye.frame_id for eye in found.common.eyes]
    lines = [*found.warnings, *(f"left out: {outlier}" for outlier in found.joint.outliers)]
    for eye, o in zip(ids[1:], found.offsets, strict=True):
        lines.append(
            f"clock of {eye}: {o.offset_s:+.4f} s against {ids[0]} (sigma {1e3 * o.sigma_s:.1f} ms, drift "
            f"{1e6 * o.drift_per_s:+.0f} +- {1e6 * o.drift_sigma_per_s:.0f} ppm, correlation {o.correlation:.4f})"
        )
    for interval, rows in zip(found.growth_intervals_s, found.growth, strict=True):
        cells = "  ".join(f"{1e3 * r[0]:6.2f} mrad {1e3 * r[1]:7.2f} mm" for r in rows)
        lines.append(f"misclosure over {interval:4.1f} s against {ids[0]}: {cells}")
    drift = found.drift
    lines.append(
        f"{len(found.common.times_s)} motions over {drift.interval_s:g} s; neighbours correlated by "
        f"{drift.autocorrelation:+.2f} (sigma {drift.autocorrelation_sigma:.2f})"
    )
    for i, eye in enumerate(ids):
        scale = "the unit" if i == 0 else f"{found.joint.scales[eye]:.4f} +- {found.joint.scale_sigmas[eye]:.4f}"
        lines.append(
            f"drift of {eye}: {1e3 * drift.rotation[i]:.2f} mrad and {1e3 * drift.position[i]:.2f} mm per root second; "
            f"lengths times {scale}"
        )
    lines += [pair_text(found.joint.pair(a, b)) for i, a in enumerate(ids) for b in ids[i + 1 :]]
    return "\n".join(lines) + "\n"


def pair_text(pair: Pair) -> str:
    """One pair: rotation vector and lever arm with sigmas."""
    if not isinstance(pair.b_from_a, Pose3):
        raise ValueError("a pair of eyes is a pose")
    turn = np.degrees(rotation_log(pair.b_from_a.rotation().matrix()[None])[0])
    t, sigma = 1e3 * pair.b_from_a.translation(), np.sqrt(np.diag(pair.cov))
    return (
        f"{pair.pair_id}: turn ({', '.join(f'{x:+.3f}' for x in turn)}) deg, sigmas "
        f"({', '.join(f'{x:.3f}' for x in np.degrees(sigma[:3]))}); lever arm ({', '.join(f'{x:+.1f}' for x in t)}) mm"
        f", sigmas ({', '.join(f'{x:.1f}' for x in 1e3 * sigma[3:])})"
    )


def _sigmas(cov: FloatArray | None) -> str:
    if cov is None:
        return "-"
    mean = np.trace(cov[:3, :3]) / 3.0, np.trace(cov[3:, 3:]) / 3.0
    return f"{np.degrees(np.sqrt(mean[0])) * 3600.0:8.1f} {1e3 * np.sqrt(mean[1]):8.3f}"
