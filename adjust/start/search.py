"""From a survey to start values: lenses, the pose of every view, then what each observation tells of frames and points.

One search: of the steps that are possible with what is known by now the safest is taken, until nothing is left.
"""

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np
from gtsam import Pose3

from adjust.frames.lens_times import whole_images
from adjust.frames.tree import FrameTree
from adjust.frames.unknowns import Unknowns
from adjust.graph.assembly import StartValues
from adjust.model.errors import IndeterminateError, SurveyError
from adjust.model.frozen import frozen
from adjust.model.result import ParameterName
from adjust.model.survey import FloatArray, Survey
from adjust.observations.geometry.building import frame_refs, position_refs
from adjust.spatial.averaging import pose_distance, typical_distance
from adjust.spatial.rigid import as_pose3
from adjust.start.chains import ChainObservation, Chains
from adjust.start.gauge import fix_one_gauge
from adjust.start.images import images_of
from adjust.start.motion import solve_motion
from adjust.start.network import FrameNetwork, pair_observations, partial_pose
from adjust.start.points import PARALLAX, improve, intersect_points, orient_second, resect
from adjust.start.polish import polish
from adjust.start.positions import PointField, Positions, point_field, undetermined
from adjust.start.readings.start import explain
from adjust.start.readings.steps import Readings
from adjust.start.settling import block_rms, contradictions, moved_to_coordinates, scaled_to_lengths

_ROUNDS = 3
_POLISH_PX = 2.0  # below this the robust means are a good start already


@frozen(eq=False)
class Start(StartValues):
    """Start values for every parameter that the survey needs: of tables their angles and geometry, of boards the warp.

    excluded_blocks: positions in ``Survey.image_blocks`` of what is not trusted, each with its reason. block_rms_px:
    misfit of every block at the start, px (nan where it has no rays).
    """

    excluded_blocks: tuple[int, ...] = ()
    reasons: tuple[str, ...] = ()
    block_rms_px: tuple[float, ...] = ()
    notes: tuple[str, ...] = ()


def find_start(survey: Survey) -> Start:
    """Start values for every parameter that the observations of a survey need.

    Given values are used as they are; everything else comes from closed forms and robust means, in a fixed order, so
    the same survey gives the same start. Blocks of image points that no pose explains, or that contradict the others,
    are named in ``excluded_blocks`` and do not take part. What no observation tells (the datum) is chosen.
    Raises SurveyError naming each parameter that nothing determines, and what is missing.
    """
    # surveys of rotations alone, whose positions stay open, are left to the general search
    if survey.is_pose_network and any(isinstance(p.b_from_a, Pose3) and p.used for p in survey.pairs):
        from adjust.pose_network.agreement import agreeing_poses  # here: a survey without pairs starts without it

        poses = agreeing_poses(survey)
        how = "averaged rotations and linear positions of the pairs that agree"
        return Start({}, poses, {}, notes=(f"{len(poses)} stations from {how}",))
    search = _Search(whole_images(survey))
    search.solve()
    search.settle()
    return search.result()


def turns_of_views(survey: Survey, turned: Mapping[str, FloatArray]) -> dict[int, int]:
    """How the target of each block must be turned to agree with the other blocks, by position in ``image_blocks``.

    turned: by target id the motions (m, 4, 4) target_from_turned after which the target looks the same. 0 for a block
    that is named as the others are, else 1 + the position of the motion; no entry where nothing tells.
    Raises SurveyError as :func:`find_start`.
    """
    search = _Search(whole_images(survey), turned)
    search.solve()
    out = {}
    for view in search.views:
        i = view.block_idx
        motions = turned.get(str(survey.image_blocks[i].target_id))
        if motions is None or search.network.open_slots(search.links[i]):
            continue
        camera_from_target = search.network.product(search.links[i])
        away = pose_distance(search.alternatives(i, view.poses), camera_from_target, search.network.lever)
        out[i] = int(np.argmin(away)) // len(view.poses)
    return out


class _Search:
    """The state of one search. turned: see :func:`turns_of_views`."""

    def __init__(self, survey: Survey, turned: Mapping[str, FloatArray] = MappingProxyType({})) -> None:
        self.survey, self.turned = survey, turned
        frames = FrameTree(survey, Unknowns())
        self.links = [frames.of_image(block) for block in survey.image_blocks]
        self.chains = Chains.of(self.links)
        pairs = pair_observations(survey, frames)
        self._register_positions(frames)
        self.network = FrameNetwork(frames, survey)
        self.network.observations, self.doubtful = pairs
        self.points: PointField = point_field(survey)
        self.positions = Positions(survey, self.network, self.points)
        self.readings = Readings(survey, self.positions)
        self.notes: list[str] = []
        self.motion_solved = self.scale_free = False

    def _register_positions(self, frames: FrameTree) -> None:
        refs = [*position_refs(self.survey), *self.survey.reading_refs]
        for frame in [*frame_refs(self.survey), *(ref.frame for ref in refs if ref.frame is not None)]:
            frames.world_from(frame)

    def _read_first(self) -> None:
        """Readings go before images where they have something to begin with. Raises SurveyError where all is lost."""
        blocks = self.survey.image_blocks
        if blocks and not any(np.isfinite(x).any() for x in self.readings.given.values()):
            return
        while self.readings.advance(firm=False):
            pass
        lacking = [p.point_id for p, x in zip(self.survey.points, self.points.x, strict=True) if np.isnan(x).any()]
        if lacking and not blocks:
            raise explain(self.survey, lacking)

    def _see(self) -> None:
        """Lenses, rays and views of all images; those that cannot be trusted are set aside."""
        found = images_of(self.survey, self.points, self.links)
        self.lenses, self.views, self.reasons = found.lenses, found.views, found.reasons
        self.points.sights, self.notes = found.sights, self.notes + found.notes
        trusted, doubtful = found.observations(self.links, self.chains, self.alternatives if self.turned else None)
        self.network.observations = self.network.observations.and_also(trusted)
        self.doubtful = self.doubtful.and_also(doubtful)
        if len(self.views):
            self.network.lever = typical_distance(self.views.poses[self.views.first[:-1]])

    def alternatives(self, i: int, poses: FloatArray) -> FloatArray:
        """Poses (k, 4, 4) of a block as named, then after every motion that its target cannot be told from."""
        motions = self.turned.get(str(self.survey.image_blocks[i].target_id), ())
        return np.concatenate([poses, *(poses @ motion for motion in motions)])

    def solve(self) -> None:
        """Determine lenses, all poses and points, the safest first; what floats is set freely one by one."""
        self._read_first()
        self._see()
        while self._advance():
            pass
        before = len(self.network.observations)
        self.network.observations = self.network.observations.and_also(self.doubtful)
        # a pose that only distrusted blocks show still needs some value
        while self._advance():
            pass
        place = np.arange(len(self.network.observations)) - before
        other = (place < 0) | (place >= len(self.doubtful))
        self.network.observations = self.network.observations.part(np.flatnonzero(other))
        while self._use_open_prior():
            while self._advance():
                pass
        waiting = {link.slot for chain in self.readings.waiting() for link in chain}
        slots = [s for s in np.flatnonzero(~self.network.has).tolist() if s not in waiting]
        lost = np.flatnonzero(~self.points.known & (self.points.seen() | ~self.readings.concerned))
        missing = undetermined(self.survey, self.network, self.points, slots, lost.tolist())
        if missing:
            points = tuple(f"point {self.survey.points[row].point_id}" for row in lost.tolist())
            raise IndeterminateError(missing, (*(" ".join(self.network.names[s]) for s in slots), *points))

    def _use_open_prior(self) -> bool:
        """Start a pose that no image or pair reaches at the mean of its prior, though that leaves components open."""
        network = self.network
        for slot in np.flatnonzero(~network.has).tolist():
            value = partial_pose(network.parameters.get(network.names[slot]))
            if value is not None:
                network.set(slot, value)
                name = " ".join(network.names[slot])
                self.notes.append(f"{name}: starts at the mean of its prior, no image or pair reaches it")
                return True
        return False

    def _advance(self) -> bool:
        """One step, the first of the list that is possible; whether there was one."""
        network, points = self.network, self.points
        if network.has.all() and points.known.all():
            return False
        return (
            network.propagate()
            or any(intersect_points(network, points, parallax) or resect(network, points) for parallax in PARALLAX)
            or self._set_freely()
            or self._from_motion()
            or points.release()
            or network.propagate(rotation_only=True)
            or self._orient()
            # lengths mean nothing where the scale is not known yet
            or (not self.scale_free and self.readings.advance())
        )

    def _noted(self, note: str | None) -> bool:
        self.notes += [note] if note is not None else []
        return note is not None

    def _set_freely(self) -> bool:
        slot = fix_one_gauge(self.network, [*self.network.observations, *self._unseen_chains()])
        what = "set freely, no observation tells it"
        return self._noted(None if slot is None else f"{' '.join(self.network.names[slot])}: {what}")

    def _from_motion(self) -> bool:
        found = self._noted(solve_motion(self.network, degenerate=self.points.released))
        self.motion_solved |= found
        return found

    def _orient(self) -> bool:
        found = not self.points.known.any() and self._noted(orient_second(self.network, self.points))
        self.scale_free |= found
        return found

    def _unseen_chains(self) -> list[ChainObservation]:
        """Chains of blocks of world points that have no pose yet; they bind the world as soon as any point is known."""
        have = set(self.network.observations.block_idx.tolist())
        bound = bool(self.points.known.any() or self.points.rough.any())
        return [
            ChainObservation(s.chain, np.zeros((0, 4, 4)), s.block_idx, ends=(True, bound))
            for s in self.points.sights
            if s.block_idx not in have
        ]

    def settle(self) -> None:
        """Renew what was found from all observations together, and set aside the blocks that contradict the rest."""
        network = self.network
        gauged = np.isin(np.arange(len(network.has)), network.gauged)
        movable = network.has & ~network.fixed & (~gauged | self.scale_free)
        # a field that grew from one pair has errors that only fade from round to round
        if self.points.sights:
            improve(network, self.points, movable, _ROUNDS * (4 if self.scale_free else 1))
        self.rms = block_rms(network, self.chains, self.views, self.points)
        polished = self.motion_solved or np.nanmax(self.rms, initial=0.0) > _POLISH_PX
        if polished:
            polish(network, network.has & ~network.fixed & ~gauged, self.views)
        changed = [
            scaled_to_lengths(self.survey, self.positions) if self.scale_free and not len(self.views) else None,
            moved_to_coordinates(self.survey, self.positions),
        ]
        self.notes += [note for note in changed if note]
        if polished or any(changed):
            self.rms = block_rms(network, self.chains, self.views, self.points)
        self.reasons |= contradictions(self.survey, self.points, self.rms, self.reasons)
        self._read_last()

    def _read_last(self) -> None:
        """What only readings reach. Raises SurveyError naming what they do not."""
        while not self.network.has.all() or not self.points.known.all():
            if not self.network.propagate() and not self.readings.advance():
                break
        lost = [self.survey.points[i].point_id for i in np.flatnonzero(~self.points.known)]
        if lost:
            raise explain(self.survey, lost)
        unmet = sorted({" ".join(self.network.names[link.slot]) for chain in self.readings.waiting() for link in chain
                        if not self.network.has[link.slot]})  # fmt: skip
        if unmet:
            raise SurveyError(
                f"no start value can be found for {', '.join(unmet)}: the set-ups that stand there are not levelled, "
                "and see too few points whose places are known (3 by direction and zenith angle); give a start pose"
            )

    def result(self) -> Start:
        """The start values under their names."""
        network, survey, rms = self.network, self.survey, self.rms
        poses: dict[ParameterName, Pose3] = {
            name: as_pose3(network.pose[slot]) for slot, name in enumerate(network.names) if name[0] != "table_motion"
        }
        vectors: dict[ParameterName, FloatArray] = {
            ("table_geometry", t.table_id): np.array(t.geometry.values, dtype=float) for t in survey.tables
        }
        vectors |= {("table_angles", r.table_id, r.epoch_id): np.array(r.angles, float) for r in survey.table_readings}
        vectors |= {("warp", t.target_id): np.array(t.warp.values, float) for t in survey.targets if t.warp is not None}
        order = tuple(sorted(self.reasons))
        good = np.delete(rms, order)
        good = good[np.isfinite(good)]
        if len(good):
            self.notes.append(
                f"{len(good)} blocks in the start, misfit median {np.median(good):.2f} px, worst {np.max(good):.2f} px;"
                f" {len(self.reasons)} left out"
            )
        points = {p.point_id: x for p, x in zip(survey.points, self.points.x, strict=True)}
        reasons = tuple(self.reasons[i] for i in order)
        return Start(self.lenses, poses, points, vectors, order, reasons, tuple(rms.tolist()), tuple(self.notes))
