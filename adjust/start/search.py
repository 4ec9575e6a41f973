"""From a survey to start values: lenses, the pose of every view, then the network of frames and points."""

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np
from gtsam import Pose3

from adjust.frames.unknowns import Chain, FrameTree, Unknowns
from adjust.model.errors import SurveyError
from adjust.model.observations import ImageBlock, PositionRef
from adjust.model.result import ParameterName
from adjust.model.survey import FloatArray, Survey
from adjust.native.views import view_offsets
from adjust.observations.geometry.building import frame_refs, position_refs
from adjust.observations.terrestrial.building import reading_refs
from adjust.spatial.averaging import pose_distance
from adjust.spatial.rigid import align, rigid
from adjust.start.gauge import fix_one_gauge, frames_of, world_is_free
from adjust.start.lenses import Sighting, start_lens
from adjust.start.motion import solve_motion
from adjust.start.network import ChainObservation, PoseNetwork, as_pose3, partial_pose
from adjust.start.pairs import network_start
from adjust.start.points import PARALLAX, PointField, improve, intersect_points, point_field, resect
from adjust.start.polish import polish
from adjust.start.relative import orient_second, scale_lengths
from adjust.start.result import Start
from adjust.start.undetermined import undetermined
from adjust.start.views import (
    Sight,
    View,
    all_rays,
    block_text,
    focal_px,
    make_views,
    target_points,
    untrustworthy,
    used_rows,
)

_ROUNDS = 3
_POLISH_PX = 2.0  # below this the robust means are a good start already
_OFF = 10.0  # a block this many times worse than the typical one contradicts the others


def find_start(survey: Survey) -> Start:
    """Start values for every parameter that the observations of a survey need.

    Given values are used as they are; everything else comes from closed forms and robust means, in a fixed order, so
    the same survey gives the same start. Blocks of image points that no pose explains, or that contradict the others,
    are named in ``excluded_blocks`` and do not take part. What no observation tells (the datum) is chosen.
    Raises SurveyError naming each parameter that nothing determines, and what is missing.
    """
    network = network_start(survey)
    if network is not None:
        return network
    search = _Search(survey)
    search.find_lenses()
    search.find_views()
    search.solve()
    search.settle()
    return search.result()


def turns_of_views(survey: Survey, turned: Mapping[str, FloatArray]) -> dict[int, int]:
    """How the target of each block must be turned to agree with the other blocks, by position in ``image_blocks``.

    turned: by target id the motions (m, 4, 4) target_from_turned after which the target looks the same. 0 for a block
    that is named as the others are, else 1 + the position of the motion; no entry where nothing tells.
    Raises SurveyError as :func:`find_start`.
    """
    search = _Search(survey, turned)
    search.find_lenses()
    search.find_views()
    search.solve()
    out = {}
    for i, view in search.views.items():
        motions = turned.get(str(survey.image_blocks[i].target_id))
        if motions is None or search.network.unknown_links(search.chains[i]):
            continue
        camera_from_target = search.network.product(search.chains[i])
        away = pose_distance(search.alternatives(i, view.poses), camera_from_target, search.network.lever)
        out[i] = int(np.argmin(away)) // len(view.poses)
    return out


class _Search:
    """The state of one search. turned: see :func:`turns_of_views`."""

    def __init__(self, survey: Survey, turned: Mapping[str, FloatArray] = MappingProxyType({})) -> None:
        self.survey = survey
        self.turned = turned
        self.targets = {t.target_id: t for t in survey.targets}
        self.target_x: dict[str, FloatArray] = {}
        self.seen_x: dict[tuple[str, bytes], FloatArray] = {}
        self.cameras = {c.camera_id: c for c in survey.cameras}
        unknowns = Unknowns()
        self.network = PoseNetwork(unknowns, FrameTree(survey, unknowns))
        self.chains: list[Chain] = [self.network.frames.of_image(block) for block in survey.image_blocks]
        self.points: PointField = point_field(survey)
        self.lenses: dict[str, FloatArray] = {}
        self.reasons: dict[int, str] = {}
        self.notes: list[str] = []
        self.views: dict[int, View] = {}
        self.rms: FloatArray = np.full(len(survey.image_blocks), np.nan)
        self.doubtful: list[ChainObservation] = []
        self.motion_solved = False
        self.scale_free = False
        self._register_pairs_and_positions()
        self.network.register(survey)

    def _register_pairs_and_positions(self) -> None:
        for pair in self.survey.pairs:
            chain = self.network.frames.relative(pair.a, pair.b)
            full = isinstance(pair.b_from_a, Pose3)
            matrix = pair.b_from_a.matrix()
            pose = np.asarray(matrix, dtype=float) if full else rigid(matrix, np.zeros(3))
            observation = ChainObservation(chain, pose[None], f"pair {pair.pair_id!r}", rotation_only=not full)
            (self.network.observations if pair.used else self.doubtful).append(observation)
        refs = [ref for d in self.survey.distances for ref in (d.a, d.b)]
        refs += [ref for c in self.survey.coordinates for ref in c.positions]
        refs += position_refs(self.survey) + reading_refs(self.survey)
        for frame in [*frame_refs(self.survey), *(ref.frame for ref in refs if ref.frame is not None)]:
            self.network.frames.world_from(frame)

    def _seen_of_target(self, block: ImageBlock, rows: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Points (n, 3) m of a block's target and their ``rows``, where used; one array for all that show the same."""
        used = block.used
        index = block.point_idx if used is None else block.point_idx[used_rows(block)]
        target_id = str(block.target_id)
        key = (target_id, index.tobytes())
        if key not in self.seen_x:
            if target_id not in self.target_x:
                self.target_x[target_id] = target_points(self.targets[target_id])
            self.seen_x[key] = self.target_x[target_id][index]
        return self.seen_x[key], rows if used is None else rows[used_rows(block)]

    def find_lenses(self) -> None:
        """Lens values of every camera, given or from its images of known points."""
        sightings: dict[str, list[Sighting]] = {c.camera_id: [] for c in self.survey.cameras}
        known = self.points.known
        for i, block in enumerate(self.survey.image_blocks):
            if block.camera_id not in self.cameras or (block.target_id and block.target_id not in self.targets):
                continue  # the chain has already named it
            if block.target_id is not None:
                x, uv = self._seen_of_target(block, block.uv)
                sightings[block.camera_id].append(Sighting(i, x, uv))
            else:
                rows = used_rows(block) & known[block.point_idx]
                sightings[block.camera_id].append(Sighting(i, self.points.x[block.point_idx[rows]], block.uv[rows]))
        for camera in self.survey.cameras:
            mine = [s for s in sightings[camera.camera_id] if len(s.x)]
            if not mine and camera.lens.values is None and self.points.release():
                self.find_lenses()  # no target shows it: the points as they are given have to do
                return
            found = start_lens(camera, mine)
            self.lenses[camera.camera_id] = found.values
            self.notes.append(f"camera {camera.camera_id!r}: {found.note}")
            for i, reason in found.excluded.items():
                self.reasons[i] = f"{block_text(self.survey.image_blocks[i])}: {reason}"

    def find_views(self) -> None:
        """Rays of all blocks and poses of all targets seen; blocks that cannot be trusted are set aside."""
        rays, failed = all_rays(self.survey, self.lenses)
        focal = {c.camera_id: focal_px(c, self.lenses[c.camera_id]) for c in self.survey.cameras}
        sights: list[Sight] = []
        for i, block in enumerate(self.survey.image_blocks):
            if i in failed:
                self.reasons.setdefault(i, f"{block_text(block)}: {failed[i]}")
            elif block.target_id is None:
                self.points.add(self.survey, i, rays[i], focal[block.camera_id], self.chains[i])
            elif len(block.uv):
                x, mine = self._seen_of_target(block, rays[i])
                if len(x) >= 3:  # fewer give no pose, but may well serve in the adjustment
                    sights.append(Sight(i, x, mine, focal[block.camera_id]))
        refined, without = make_views(sights)
        for i, reason in without.items():
            self.reasons.setdefault(i, f"{block_text(self.survey.image_blocks[i])}: {reason}")
        reasons, notes = untrustworthy([v for v in refined if v.block_idx not in self.reasons], self.survey)
        self.reasons = {**reasons, **self.reasons}
        self.notes += notes
        self.views = {v.block_idx: v for v in refined}
        for i, view in self.views.items():
            text = block_text(self.survey.image_blocks[i])
            observation = ChainObservation(self.chains[i], self.alternatives(i, view.poses), text, i)
            (self.doubtful if i in self.reasons else self.network.observations).append(observation)
        distances = [float(np.linalg.norm(v.poses[0][:3, 3])) for v in refined]
        self.network.lever = float(np.median(distances)) if distances else 1.0

    def alternatives(self, i: int, poses: FloatArray) -> FloatArray:
        """Poses (k, 4, 4) of a block as named, then after every motion that its target cannot be told from."""
        motions = self.turned.get(str(self.survey.image_blocks[i].target_id), ())
        return np.concatenate([poses, *(poses @ motion for motion in motions)])

    def solve(self) -> None:
        """Determine all poses and points, the safest first; what floats is set freely one by one."""
        while self._advance():
            pass
        self.network.observations += self.doubtful
        # a pose that only distrusted blocks show still needs some value
        while self._advance():
            pass
        self.network.observations = [o for o in self.network.observations if o not in self.doubtful]
        while self._use_open_prior():
            while self._advance():
                pass
        missing = undetermined(self.survey, self.network, self.points)
        if missing:
            raise SurveyError(missing)

    def _use_open_prior(self) -> bool:
        """Start a pose that no image or pair reaches at the mean of its prior, though that leaves components open."""
        network = self.network
        for slot, name in sorted(network.names.items()):
            value = None if slot in network.known else partial_pose(network.unknowns.parameters.get(name))
            if value is not None:
                network.known[slot] = value
                self.notes.append(f"{' '.join(name)}: starts at the mean of its prior, no image or pair reaches it")
                return True
        return False

    def _advance(self) -> bool:
        """One step, the first of the list that is possible; whether there was one."""
        network, points = self.network, self.points
        if network.known.keys() >= network.names.keys() and points.known.all():
            return False
        if network.propagate():
            return True
        for parallax in PARALLAX:
            if intersect_points(network, points, parallax) or resect(network, points):
                return True
        floating = network.observations + self._unseen_chains()
        slot = fix_one_gauge(network, floating)
        if slot is not None:
            self.notes.append(f"{' '.join(network.names[slot])}: set freely, no observation tells it")
            return True
        note = solve_motion(network, degenerate=points.released)
        if note is not None:
            self.notes.append(note)
            self.motion_solved = True
            return True
        if points.release():
            return True
        if network.propagate(rotation_only=True):
            return True
        note = orient_second(network, points) if not points.known.any() else None
        if note is not None:
            self.notes.append(note)
            self.scale_free = True
        return note is not None

    def _unseen_chains(self) -> list[ChainObservation]:
        """Chains of blocks of world points that have no pose yet; they bind the world as soon as any point is known."""
        have = {o.block_idx for o in self.network.observations}
        bound = bool(self.points.known.any() or self.points.rough.any())
        return [
            ChainObservation(s.chain, np.zeros((0, 4, 4)), s.text, s.block_idx, ends=(True, bound))
            for s in self.points.sights
            if s.block_idx not in have
        ]

    def settle(self) -> None:
        """Renew what was found from all observations together, and set aside the blocks that contradict the rest."""
        network = self.network
        movable = set(network.known) - network.fixed - (set() if self.scale_free else set(network.gauged))
        # a field that grew from one pair has errors that only fade from round to round
        rounds = _ROUNDS * (4 if self.scale_free else 1)
        for _ in range(rounds if self.points.sights else 0):
            improve(network, self.points, movable)
        moved = set(network.known) - network.fixed - set(network.gauged)
        self.rms = self._block_rms()
        polished = self.motion_solved or np.nanmax(self.rms, initial=0.0) > _POLISH_PX
        if polished:
            polish(network, moved, self.views)
        scaled, shifted = self._settle_scale(), self._move_to_coordinates()
        if polished or scaled or shifted:
            self.rms = self._block_rms()
        self._set_aside_contradictions()

    def _settle_scale(self) -> bool:
        """The scale of a network of relative orientations, from observed distances or coordinates; whether there is."""
        if not self.scale_free or self.views:
            return False
        ratios = []
        for distance in self.survey.distances:
            a, b = self._place(distance.a), self._place(distance.b)
            if distance.used and a is not None and b is not None and np.linalg.norm(a - b) > 0:
                ratios.append(distance.value / float(np.linalg.norm(a - b)))
        observed, present = self._observed_positions()
        if not ratios and len(observed) > 1:
            ratios = [float(np.std(observed, axis=0).max() / max(np.std(present, axis=0).max(), 1e-12))]
        if ratios:
            slots = [s for s in self.network.known if s not in self.network.fixed]
            scale_lengths(self.network, self.points, float(np.median(ratios)), slots)
            self.notes.append(f"scale from {len(ratios)} observed length(s)")
        return bool(ratios)

    def _observed_positions(self) -> tuple[FloatArray, FloatArray]:
        """Observed coordinates (m, 3) and where their positions are at present (m, 3)."""
        rows = []
        for item in self.survey.coordinates:
            finite = np.all(np.isfinite(np.diag(item.cov)).reshape(-1, 3), axis=1).tolist()
            for ref, value, whole in zip(item.positions, item.values, finite, strict=True):
                place = self._place(ref) if item.used and whole else None
                if place is not None:
                    rows.append((value, place))
        return np.array([r[0] for r in rows]).reshape(-1, 3), np.array([r[1] for r in rows]).reshape(-1, 3)

    def _move_to_coordinates(self) -> bool:
        """Move the whole world onto observed coordinates where nothing given holds it; whether it moved."""
        if not world_is_free(self.network, self.survey) or self.points.given.any():
            return False
        observed, present = self._observed_positions()
        if not len(observed):
            return False
        new_from_old = align(observed, present)
        for slot, name in self.network.names.items():
            if frames_of(self.network, name)[0] == ("world",):
                self.network.known[slot] = new_from_old @ self.network.known[slot]
        self.points.x = self.points.x @ new_from_old[:3, :3].T + new_from_old[:3, 3]
        self.notes.append(f"world moved onto {len(observed)} observed positions")
        return True

    def _place(self, ref: PositionRef) -> FloatArray | None:
        """Present world coordinates (3,) of a position."""
        if ref.frame is None:
            index = next((i for i, p in enumerate(self.survey.points) if p.point_id == ref.point_id), None)
            return None if index is None or not self.points.known[index] else self.points.x[index]
        world_from_frame = self.network.product(tuple(self.network.frames.world_from(ref.frame)))
        local = np.zeros(3)
        if ref.point_id is not None:
            target = self.targets[ref.frame.frame_id]
            local = target_points(target)[target.point_ids.index(ref.point_id)]
        return np.asarray(world_from_frame[:3, :3] @ local + world_from_frame[:3, 3])

    def _set_aside_contradictions(self) -> None:
        rms = self.rms
        trusted = [i for i in range(len(rms)) if i not in self.reasons and np.isfinite(rms[i])]
        if not trusted:
            return
        # blocks of points that are where a start value puts them are measured by their own kind
        rough = {s.block_idx for s in self.points.sights if self.points.rough[s.rows].any()}
        kinds = [[i for i in trusted if (i in rough) == kind and np.isfinite(rms[i])] for kind in (False, True)]
        typical = [float(np.median(rms[kind])) if kind else 0.0 for kind in kinds]
        for i in range(len(rms)):
            limit = max(15.0, _OFF * typical[i in rough])
            if i not in self.reasons and rms[i] > limit:
                what = "has points behind the camera" if np.isinf(rms[i]) else f"is {rms[i]:.1f} px off"
                text = block_text(self.survey.image_blocks[i])
                self.reasons[i] = (
                    f"{text}: {what} where the other blocks put it (typical: {typical[i in rough]:.1f} px)"
                )

    def _block_rms(self) -> FloatArray:
        """Robust misfit of every block at the present values: 1.2 times the median offset, px."""
        rms = np.full(len(self.survey.image_blocks), np.nan)
        sights = {s.block_idx: s for s in self.points.sights}
        blocks = [i for i in range(len(self.chains)) if i in self.views or i in sights]
        if not blocks:
            return rms
        seen = [self.views.get(i) or sights[i] for i in blocks]
        x = [s.x if isinstance(s, View) else self.points.x[s.rows] for s in seen]
        ptr = np.cumsum([0] + [len(part) for part in x])
        poses = self.network.products([self.chains[i] for i in blocks])
        medians = view_offsets(poses, np.concatenate(x), np.concatenate([s.rays for s in seen]), ptr)[1]
        # the median of a circular normal's radius is 1.18 sigma, its rms 1.41 sigma
        rms[blocks] = 1.2 * np.array([s.focal_px for s in seen]) * medians
        return rms

    def result(self) -> Start:
        """The start values under their names."""
        network, survey = self.network, self.survey
        poses: dict[ParameterName, Pose3] = {
            name: as_pose3(network.known[slot]) for slot, name in network.names.items() if name[0] != "table_motion"
        }
        vectors: dict[ParameterName, FloatArray] = {}
        for table in survey.tables:
            vectors[("table_geometry", table.table_id)] = np.array(table.geometry.values, dtype=float)
        for reading in survey.table_readings:
            vectors[("table_angles", reading.table_id, reading.epoch_id)] = np.array(reading.angles, dtype=float)
        for target in survey.targets:
            if target.warp is not None:
                vectors[("warp", target.target_id)] = np.array(target.warp.values, dtype=float)
        rms = self.rms
        good = [rms[i] for i in range(len(rms)) if i not in self.reasons and np.isfinite(rms[i])]
        if good:
            self.notes.append(
                f"{len(good)} blocks in the start, misfit median {np.median(good):.2f} px, worst {np.max(good):.2f} px;"
                f" {len(self.reasons)} left out"
            )
        order = tuple(sorted(self.reasons))
        points = {p.point_id: self.points.x[i] for i, p in enumerate(survey.points) if self.points.known[i]}
        reasons = tuple(self.reasons[i] for i in order)
        return Start(
            self.lenses, poses, points, vectors, order, reasons, self._orphans(), tuple(rms.tolist()), tuple(self.notes)
        )

    def _orphans(self) -> tuple[ParameterName, ...]:
        """Poses that only distrusted blocks reach."""
        chains = [chain for i, chain in enumerate(self.chains) if i not in self.reasons]
        chains += [o.chain for o in self.network.observations if o.block_idx < 0]
        reached = {link.slot for chain in chains for link in chain}
        doubted = {link.slot for i in self.reasons for link in self.chains[i]}
        names = self.network.names
        return tuple(names[slot] for slot in sorted(doubted - reached - self.network.fixed))
