"""The search for the lens of one camera: a closed form or a scan, then the richest lens that its images determine."""

import itertools
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from adjust.lenses.models import (
    CENTRE,
    FOCAL,
    LensModel,
    camera_constants,
    default_start,
    focal_length_px,
    principal_point_px,
    unit_rays,
)
from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.survey import Camera, FloatArray
from adjust.native.lenses import Lens, fit_lens
from adjust.native.views import homographies
from adjust.start.closed_forms.absolute_pose import best_poses
from adjust.start.closed_forms.zhang import pinhole_from_homographies
from adjust.start.lens.images import MOST_IMAGES, enough_points, every_nth, plane_coordinates, spread_out, thinned
from adjust.start.views import Sighting, ends_of, few_of, sights_of

_SCAN_IMAGES = 8
_MOST_SCREENED = 60
_REFINEMENTS = 2  # of the poses with a lens that is refined itself afterwards
_GOOD_START = 0.01  # of the image width: with less error a closed form needs no scan beside it
_SEVERAL, _OTHER_STARTS = 3, 4  # images, and starts that are tried beside the first where that leads nowhere
_LEVELS = ("focal centre k1 k2", "focal centre k1", "focal k1", "focal")
_SIMPLE_PX = 2.0
_RADIAL = {"k1": 1, "k2": 2, "K1": 1, "K2": 2, "A1": 1, "A2": 2}


@frozen(eq=False)
class _Fit:
    """A lens (n,) with the poses (B, 4, 4), the median error px, and the covariance (p, p) of what was free."""

    values: FloatArray
    poses: FloatArray
    median_px: float
    cov: FloatArray


@frozen(eq=False)
class _Trial:
    """A lens (n,) to begin with, how it was found, and the poses (B, 4, 4) that images have with it.

    errors: (B,) rad, of each, infinite where there is none. error_px: their median.
    """

    values: FloatArray
    how: str
    poses: FloatArray
    errors: FloatArray
    error_px: float


@frozen(eq=False)
class LensStart:
    """values (n,) of the model, how they were found, and the blocks left out with the reason.

    refined: whether the images determine them.
    """

    values: FloatArray
    note: str
    excluded: dict[int, str]
    refined: bool = True


class LensSearch:
    """The search for one camera; keeps what does not change on the way."""

    def __init__(self, camera: Camera, model: LensModel, lent: Mapping[str, float]) -> None:
        self.camera, self.model, self.size = camera, model, camera.image_size
        self.constants = camera_constants(camera)
        self.prior = dict(lent)
        if camera.lens.prior is not None:
            self.prior |= dict(zip(camera.lens.prior.names, camera.lens.prior.mean, strict=True))
        self.tied = {tie.name: tie for tie in camera.lens.ties}
        free = set(camera.lens.free) | {t.name for t in camera.lens.ties if t.to in camera.lens.free}
        for name in model.names:
            if name in (*FOCAL, "u0", "v0", "px", "py") and name not in free and name not in self.prior:
                raise SurveyError(
                    f"camera {camera.camera_id!r}: {name} is held but has no value; give lens values or free it"
                )

    def run(self, sightings: Sequence[Sighting], near: FloatArray | None) -> LensStart:
        """See :func:`adjust.start.lens.start.start_lens`."""
        usable = [s for s in sightings if len(s.x) >= 4]
        if any(name in self.prior for name in FOCAL):
            focal = self.prior.get("fx", self.prior.get("c", self.prior.get("ck", 0.0)))
            return LensStart(self._values(focal / (self.constants[0] if self.model.in_mm else 1.0)), "lens prior", {})
        if not usable:
            raise SurveyError(
                f"camera {self.camera.camera_id!r}: no lens values are given and no image shows 4 or more known points;"
                " show it a target, or give lens values"
            )
        # the other images of a long series are screened by their poses
        most = enough_points(len(usable))
        planar = {i: plane_coordinates(x[few_of(len(x), most)]) is not None
                  for i, x in {id(s.x): s.x for s in usable}.items()}  # fmt: skip
        flat = thinned(every_nth([s for s in usable if planar[id(s.x)]], _MOST_SCREENED), most)
        maps, excluded = self._screen(flat) if flat else ({}, {})
        chosen = spread_out([s for s in flat if s.block_idx in maps])
        chosen = chosen or thinned([s for s in usable if s.block_idx not in excluded][:MOST_IMAGES], most)
        if not chosen:
            raise SurveyError(
                f"camera {self.camera.camera_id!r}: none of its {len(flat)} images fits a plane; the first: "
                + next(iter(excluded.values()))
            )
        determined = [m for s in chosen if (m := maps.get(s.block_idx)) is not None]
        starts = self._focal_lengths(determined, chosen, near)
        first = next(starts)
        found = self._refined(first, chosen)
        # a closed form that misses little may lead nowhere: few images that are hardly tilted fit any focal length
        others = itertools.islice(starts, _OTHER_STARTS if len(chosen) >= _SEVERAL else 0)
        found = found or next((f for other in others if (f := self._refined(other, chosen))), None)
        unrefined = first.values, f"lens from {len(chosen)} images ({first.how}; too few to refine it)"
        return LensStart(*(found or unrefined), excluded, found is not None)

    def _screen(self, flat: Sequence[Sighting]) -> tuple[dict[int, FloatArray | None], dict[int, str]]:
        """Images that fit a plane, with their homographies where determined; a wrong point order misses by far."""
        ptr, uv = ends_of([len(s.x) for s in flat]), np.concatenate([s.uv for s in flat])
        xy = {id(s.x): plane_coordinates(s.x) for s in flat}
        h, misses, found = homographies(np.concatenate([xy[id(s.x)] for s in flat]), uv, ptr, 1)
        span = np.maximum.reduceat(uv, ptr[:-1]) - np.minimum.reduceat(uv, ptr[:-1])
        misfit = misses[:, 1] / np.maximum(np.hypot(*span.T), 1e-9)
        limit = max(0.02, 6.0 * float(np.median(misfit)))
        good = {s.block_idx: h[i] if found[i] else None for i, s in enumerate(flat) if misfit[i] <= limit}
        excluded = {
            s.block_idx: f"the points miss a plane by {100 * m:.0f} % of their extent (wrong order or mis-detected)"
            for s, m in zip(flat, misfit, strict=True)
            if m > limit
        }
        return good, excluded

    def _focal_lengths(
        self, maps: Sequence[FloatArray], chosen: Sequence[Sighting], near: FloatArray | None
    ) -> Iterator[_Trial]:
        """Trials to begin with: a closed form that misses little, near values, else what misses least."""
        trials: list[_Trial] = []
        for variants in (("full",), ("centred", "square")) if maps and self.model.name != "fisheye" else ():
            try:
                found = pinhole_from_homographies(np.array(maps), self.size, variants)
            except SurveyError:
                continue
            centre = found.values[2:] if found.variant == "full" else None
            values = self._values(found.values[0], found.values[1], centre)
            trials.append(self._tried(values, f"Zhang, {found.variant}", chosen))
            if trials[-1].error_px < _SIMPLE_PX:  # nor does it need another one
                break
        best = min(trials, key=lambda trial: trial.error_px, default=None)
        begun = best is not None and best.error_px < _GOOD_START * max(self.size)
        if best is not None and begun:
            yield best
            trials.remove(best)
        if near is not None:
            focal = focal_length_px(self.model, near, self.constants)
            values = self._values(focal, centre=principal_point_px(self.model, near, self.constants))
            yield self._tried(values, "known before", chosen)
            return
        low, high = (0.15, 2.0) if self.model.name == "fisheye" else (0.35, 8.0)
        some = every_nth(chosen, _SCAN_IMAGES)
        for factor in np.geomspace(low, high, 16):
            trials.append(self._tried(self._values(factor * max(self.size)), "scan of focal lengths", some))
        in_order = sorted((t for t in trials if np.isfinite(t.error_px)), key=lambda trial: trial.error_px)
        if not in_order and not begun:
            raise SurveyError(
                f"camera {self.camera.camera_id!r}: no focal length from {low:g} to {high:g} image widths explains its"
                " images of known points; check point order, coordinates and image size, or give lens values"
            )
        yield from in_order

    def _values(self, fx: float, fy: float | None = None, centre: FloatArray | None = None) -> FloatArray:
        """Values without distortion; prior means where there are any, ties respected."""
        values = default_start(self.model, self.size, fx, self.camera.lens.pixel_size_mm)
        index = {name: i for i, name in enumerate(self.model.names)}
        if fy is not None and "fy" in index:
            values[index["fy"]] = fy
        if centre is not None and "u0" in index:
            values[index["u0"]], values[index["v0"]] = centre
        for name, mean in self.prior.items():
            values[index[name]] = mean
        for name, tie in self.tied.items():
            values[index[name]] = tie.factor * values[index[tie.to]]
        return values

    def _tried(self, values: FloatArray, how: str, images: Sequence[Sighting]) -> _Trial:
        """A lens with the best pose of every image."""
        camera_id = self.camera.camera_id
        sights, lost = sights_of({camera_id: self.camera}, {camera_id: values}, {camera_id: images})
        some = [s.block_idx not in lost for s in images]
        poses, errors = np.tile(np.eye(4), (len(images), 1, 1)), np.full(len(images), np.inf)
        poses[some], errors[some] = best_poses(sights.x, sights.rays, sights.ptr, _REFINEMENTS)
        focal = focal_length_px(self.model, values, self.constants)
        return _Trial(values, how, poses, errors, float(np.median(errors)) * focal)

    def _refined(self, trial: _Trial, chosen: Sequence[Sighting]) -> tuple[FloatArray, str] | None:
        """The richest lens that the images determine, refined together with the poses, and a note; None without one."""
        start, how = trial.values, trial.how
        if len(trial.errors) < len(chosen):
            trial = self._tried(start, how, chosen)
        # images without a pose are left to the screening of all blocks, which reports them
        some = np.isfinite(trial.errors)
        images, poses = [s for s, there in zip(chosen, some, strict=True) if there], trial.poses[some]
        if not images:
            raise SurveyError(
                f"camera {self.camera.camera_id!r}: no image of known points gives a pose with the {how} lens"
            )
        for level in _LEVELS:
            directions = self._directions(level)
            if directions.shape[1] == 0 or ("centre" in level and len(images) < 3):
                continue
            fit = self._fit(start, directions, poses, images)
            if self._sane(fit, directions):
                if level == _LEVELS[0] and fit.median_px > _SIMPLE_PX:  # a wide lens needs all its terms
                    everything = self._directions("all")
                    full = self._fit(fit.values, everything, fit.poses, images, 60)
                    if self._sane(full, everything) and full.median_px < 0.5 * fit.median_px:
                        fit, level = full, "all that is free"
                note = f"lens from {len(images)} images ({how}; refined: {level}), median error {fit.median_px:.2f} px"
                return fit.values, note
        return None

    def _fit(
        self, start: FloatArray, directions: FloatArray, poses: FloatArray, images: Sequence[Sighting],
        iterations: int = 25,
    ) -> _Fit:  # fmt: skip
        """Least squares over ``start + directions @ p`` and the poses, with Huber weights."""
        x, uv = (np.concatenate([getattr(s, name) for s in images]) for name in ("x", "uv"))
        ptr = np.cumsum([0] + [len(s.x) for s in images])
        values, poses = start.copy(), poses.copy()
        lens = Lens(self.model.kind, values, self.constants)
        squares, cov = fit_lens(lens, np.ascontiguousarray(directions), ptr, x, uv, iterations, poses)
        median = float(np.median(squares))  # of a 2-D normal's square it is s^2 ln 4
        return _Fit(values, poses, float(np.sqrt(median)), cov * (median / np.log(4.0)))

    def _directions(self, level: str) -> FloatArray:
        """Columns (n, p) of the lens components that this level frees, with ties; fx, fy apart only with the centre."""
        wanted = set(FOCAL)
        wanted |= set(CENTRE if "centre" in level else ())
        wanted |= {name for name, order in _RADIAL.items() if f"k{order}" in level}
        names, columns = self.model.names, []
        wanted = set(names) if level == "all" else wanted
        for i, name in enumerate(names):
            if name not in wanted or name not in self.camera.lens.free or name in self.tied or name in self.prior:
                continue
            column = np.zeros(len(names))
            column[i] = 1.0
            for tie in self.tied.values():
                if tie.to == name:
                    column[names.index(tie.name)] = tie.factor
            columns.append(column)
        if level in _LEVELS[2:] and self.model.names[:2] == ("fx", "fy") and {"fx", "fy"} <= set(self.camera.lens.free):
            # few or frontal images cannot tell fx from fy: one direction for both
            both = [c for c in columns if c[0] or c[1]]
            columns = [c for c in columns if not (c[0] or c[1])] + ([np.sum(both, axis=0)] if both else [])
        return np.array(columns).reshape(-1, len(names)).T

    def _sane(self, fit: _Fit, directions: FloatArray) -> bool:
        """Whether the fit is determined (focal length to 10 %, centre to a tenth of the image) and possible."""
        focal = focal_length_px(self.model, fit.values, self.constants)
        width = max(self.size)
        sigma = np.sqrt(np.einsum("ij,jk,ik->i", directions, fit.cov, directions))
        pixel = 1.0 / self.constants[0] if self.model.in_mm else 1.0
        limits = {**dict.fromkeys(FOCAL, 0.1 * focal), **dict.fromkeys(CENTRE, 0.1 * width)}
        known = all(s * pixel <= limits[n] for n, s in zip(self.model.names, sigma, strict=True) if n in limits)
        centre = principal_point_px(self.model, fit.values, self.constants)
        inside = np.all(np.abs(centre - self.constants[1:3]) < 0.3 * width)
        try:
            corners = np.array([[0.0, 0.0], [self.size[0] - 1.0, 0.0], [0.0, self.size[1] - 1.0]])
            unit_rays(self.model, fit.values, self.constants, 0.85 * corners + 0.15 * self.constants[1:3])
        except SurveyError:
            return False
        return bool(known and inside and 0.05 * width < focal < 50 * width)
