"""The survey seen from above and from a corner, drawn as SVG; confidence ellipsoids enlarged by a stated factor."""

from collections.abc import Callable

import numpy as np
from markupsafe import Markup

from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray
from survey.report import drawing as d
from survey.report.language import localised, t
from survey.report.scene import Scene, Shot, enlargement

WIDTH, HEIGHT, MARGIN = 540.0, 450.0, 36.0
_MOST_LABELS = 60
_AXES = 0.07
"""Length of the axes of the world, as a share of all there is to be seen."""


@frozen(eq=False)
class View:
    """Picture coordinates of world points, ``to_picture`` (n, 3) -> (n, 2), and the picture units per metre."""

    to_picture: Callable[[FloatArray], FloatArray]
    unit: float
    name: str
    stands: bool = False  # shows heights, as the perspective does

    def jacobian(self, x: FloatArray) -> FloatArray:
        """Derivatives (..., 2, 3) of the picture at points (..., 3)."""
        h = 1e-4
        steps = x[..., None, None, :] + h * np.stack([np.eye(3), -np.eye(3)])
        xy = self.to_picture(steps.reshape(-1, 3)).reshape(*steps.shape[:-1], 2)
        return np.swapaxes(xy[..., 0, :, :] - xy[..., 1, :, :], -1, -2) / (2 * h)


def _fit(xy: FloatArray) -> tuple[float, FloatArray]:
    """Scale and shift that bring flat coordinates (y up) into the picture."""
    low, high = xy.min(axis=0), xy.max(axis=0)
    extent = np.maximum(high - low, 1e-6)
    scale = float(min((WIDTH - 2 * MARGIN) / extent[0], (HEIGHT - 2 * MARGIN - 16) / extent[1]))
    return scale, 0.5 * (low + high)


def _placed(
    flat: Callable[[FloatArray], FloatArray], everything: FloatArray, name: str, stands: bool = False
) -> View:
    scale, middle = _fit(flat(everything))

    def to_picture(x: FloatArray) -> FloatArray:
        xy = (flat(np.atleast_2d(x)) - middle) * scale
        return np.column_stack([0.5 * WIDTH + xy[:, 0], 0.5 * HEIGHT + 2 - xy[:, 1]])

    return View(to_picture, scale, name, stands)


def plan(everything: FloatArray) -> View:
    """Along -z on the world's x (right) and y (up)."""
    return _placed(lambda x: x[:, :2], everything, t("Plan (world x to the right, y up)"))


def perspective(everything: FloatArray) -> View:
    """From a corner above, with mild perspective."""
    azimuth, elevation = np.radians(-62.0), np.radians(27.0)
    middle = 0.5 * (everything.min(axis=0) + everything.max(axis=0))
    away = np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    up = np.cross(away, right)
    low, high = everything.min(axis=0), everything.max(axis=0)
    floor = np.array([(x, y, low[2]) for x in (low[0], high[0]) for y in (low[1], high[1])])
    distance = 2.2 * max(float(np.linalg.norm(np.ptp(everything, axis=0))), 1e-6)

    def flat(x: FloatArray) -> FloatArray:
        depth = distance - (x - middle) @ away
        flat_x = np.column_stack([(x - middle) @ right, (x - middle) @ up])
        return np.asarray(flat_x * (distance / np.maximum(depth, 0.1 * distance))[:, None])

    return _placed(flat, np.concatenate([everything, floor]), t("Perspective (world z up)"), stands=True)


def _ground(view: View, everything: FloatArray) -> list[str]:
    """A grid on the lowest level, which makes heights and distances readable."""
    low, high = everything.min(axis=0), everything.max(axis=0)
    step = d.round_below(float(np.ptp(everything[:, :2], axis=0).max()) / 4.0)
    parts = []
    (x0, y0), (x1, y1) = low[:2], high[:2]
    for x in np.arange(np.ceil(x0 / step), np.floor(x1 / step) + 1) * step:
        parts.append(d.polyline(view.to_picture(np.array([(x, y0, low[2]), (x, y1, low[2])])), d.GRID))
    for y in np.arange(np.ceil(y0 / step), np.floor(y1 / step) + 1) * step:
        parts.append(d.polyline(view.to_picture(np.array([(x0, y, low[2]), (x1, y, low[2])])), d.GRID))
    return parts


def _frustum(view: View, shot: Shot, depth: float) -> str:
    """A camera as its field of view; away from the first epoch as its optical axis alone."""
    if not shot.main:
        ends = view.to_picture(shot.pose.transformFrom(np.array([(0.0, 0.0, 0.0), (0.0, 0.0, 1.3 * depth)]).T).T)
        return d.polyline(ends, d.CAMERA_COLOURS[shot.camera_idx % len(d.CAMERA_COLOURS)], 0.8, ' stroke-opacity="0.4"')
    tx, ty = np.tan(shot.half_angles)
    rim = depth * np.array([(-tx, -ty, 1.0), (tx, -ty, 1.0), (tx, ty, 1.0), (-tx, ty, 1.0)])
    corners = view.to_picture(shot.pose.transformFrom(rim.T).T)
    eye = view.to_picture(np.asarray(shot.pose.translation()))[0]
    colour = d.CAMERA_COLOURS[shot.camera_idx % len(d.CAMERA_COLOURS)]
    edges = "".join(f"M{eye[0]:.1f} {eye[1]:.1f}L{x:.1f} {y:.1f}" for x, y in corners)
    return d.polygon(corners, colour, colour, 1.0, ' fill-opacity="0.2"') + (
        f'<path d="{edges}" stroke="{colour}" stroke-width="0.9" fill="none"/>'
    )


class _Labels:
    """Places labels beside their points, tries four sides, leaves out what would cover another label."""

    def __init__(self, points: FloatArray, letters: FloatArray) -> None:
        taken = ((points, 2.0), (letters, 5.0))
        self.boxes = np.concatenate([np.concatenate([x - half, x + half], axis=1) for x, half in taken])

    def place(self, xy: FloatArray, words: str, colour: str, size: float = 10.5, gap: float = 5.0) -> str:
        w, h = 0.6 * size * len(words), size
        for dx, dy in (
            (gap, -3.0),
            (gap, h + 1),
            (-gap - w, -3.0),
            (-gap - w, h + 1),
            (-w / 2, -gap - 5),
            (-w / 2, h + gap + 4),
        ):
            x, y = xy[0] + dx, xy[1] + dy
            box = (x, y - h, x + w, y + 1)
            inside = box[0] > 0 and box[1] > 0 and box[2] < WIDTH and box[3] < HEIGHT
            x0, y0, x1, y1 = self.boxes.T
            if inside and ((box[0] > x1) | (box[2] < x0) | (box[1] > y1) | (box[3] < y0)).all():
                self.boxes = np.concatenate([self.boxes, [box]])
                halo = f' paint-order="stroke" stroke="{d.PAPER}" stroke-width="2.5"'
                return d.text(x, y, words, size=size, colour=colour, more=halo)
        return ""


def _tables(view: View, scene: Scene, reach: float) -> list[str]:
    parts = []
    for _, pose, axes in scene.tables:
        for axis in axes:
            direction = np.zeros(3)
            direction["xyz".index(axis)] = reach
            ends = view.to_picture(pose.transformFrom(np.column_stack([-direction, direction])).T)
            parts.append(d.polyline(ends, d.INK, 1.1, ' stroke-dasharray="7 3 1.5 3"'))
    return parts


def _world_axes(view: View, extent: float) -> tuple[list[str], FloatArray]:
    """The axes that lie in the picture and do not point at its eye, and where their letters (n, 2) stand."""
    start = view.to_picture(np.zeros((1, 3)))[0]
    inside = 0 <= start[0] <= WIDTH and 0 <= start[1] <= HEIGHT
    parts, letters = list[str](), list[FloatArray]()
    for i, (name, colour) in enumerate((("x", d.X_AXIS), ("y", d.Y_AXIS), ("z", d.Z_AXIS))):
        end = view.to_picture(_AXES * extent * np.eye(3)[i])[0]
        if inside and np.hypot(*(end - start)) > 3.0:
            parts.append(d.arrows(start[None], end[None], colour, 1.6, 5.0))
            tip = start + (end - start) * (1 + 8.0 / np.hypot(*(end - start)))
            parts.append(d.text(tip[0], tip[1] + 3.5, name, "middle", 10.5, colour))
            letters.append(tip)
    return parts, np.array(letters).reshape(-1, 2)


def draw(scene: Scene, view: View, everything: FloatArray, enlarged: float, ellipsoid: float) -> Markup:
    """One view of the scene as SVG."""
    extent = float(np.linalg.norm(np.ptp(everything, axis=0)))
    axes, letters = _world_axes(view, extent)
    parts = [d.heading(view.name), *_ground(view, everything), *axes]
    if view.stands:
        feet = scene.spot_places().repeat(2, axis=0)
        feet[1::2, 2] = everything[:, 2].min()
        ends = view.to_picture(feet).reshape(-1, 2, 2)
        parts.append(d.polylines(ends, d.FAINT, 0.8, ' stroke-dasharray="2 2"'))
    parts += [d.polygon(view.to_picture(x), d.BODY, d.INK, 1.0, ' fill-opacity="0.18"') for _, x in scene.outlines]
    parts += [d.dot(x, y, 1.2, d.INK) for _, cloud in scene.clouds for x, y in view.to_picture(cloud)]
    parts += [d.dot(x, y, 1.4, d.GREEN, ' fill-opacity="0.6"') for m in scene.moves for x, y in view.to_picture(m)]
    parts += _tables(view, scene, 0.06 * extent)
    parts += [_frustum(view, s, 0.075 * extent) for s in sorted(scene.shots, key=lambda s: s.main)]
    J = view.jacobian(scene.spot_places()) * ellipsoid * enlarged
    cov = J @ np.array([spot.cov for spot in scene.spots]).reshape(-1, 3, 3) @ J.swapaxes(1, 2)
    xy, ellipses = view.to_picture(scene.spot_places()).tolist(), d.half_axes(cov).tolist()
    for i, spot in sorted(enumerate(scene.spots), key=lambda s: s[1].kind):
        colour, size = (d.RED, 2.2) if spot.kind == "point" else (d.GREEN, 3.0)
        (x, y), axes = xy[i], ellipses[i]
        parts += [d.ellipse((x, y), axes, colour, colour), d.dot(x, y, size, colour)]
    parts += _labels(view, scene, 0.09 * extent, letters)
    step = d.round_below(0.25 * WIDTH / view.unit)
    parts.append(d.scale_bar(2, HEIGHT - 8, step * view.unit, localised(f"{step:g} m")))
    return d.svg(WIDTH, HEIGHT, parts, view.name)


def _labels(view: View, scene: Scene, ahead: float, letters: FloatArray) -> list[str]:
    """Names; those of cameras stand ``ahead`` of them, m. letters: of the axes, which stay readable."""
    labels, parts = _Labels(view.to_picture(scene.spot_places()), letters), []
    for label, x in scene.outlines + scene.clouds:
        parts.append(labels.place(view.to_picture(x).mean(axis=0), label, d.INK) if label else "")
    for shot in scene.shots:
        if shot.main:
            colour = d.CAMERA_COLOURS[shot.camera_idx % len(d.CAMERA_COLOURS)]
            tip = view.to_picture(shot.pose.transformFrom(np.array([0.0, 0.0, ahead])))[0]
            parts.append(labels.place(tip, shot.label, colour, 12.5, 1.0))
    for table_id, pose, _ in scene.tables:
        parts.append(labels.place(view.to_picture(np.asarray(pose.translation()))[0], table_id, d.INK, gap=10.0))
    for spot in scene.spots[:_MOST_LABELS]:
        if spot.label:
            parts.append(
                labels.place(view.to_picture(spot.x)[0], spot.label, d.RED if spot.kind == "point" else d.GREEN)
            )
    return parts


def pictures(scene: Scene, ellipsoid: float) -> tuple[tuple[Markup, ...], float]:
    """Both views, and the factor by which ellipsoids are enlarged; nothing for an empty scene."""
    everything = scene.positions()
    if not len(everything):
        return (), 1.0
    extent = float(np.linalg.norm(np.ptp(everything, axis=0)))
    enlarged = enlargement(scene, ellipsoid, extent)
    around = (everything.min(axis=0) <= 0.0).all() and (everything.max(axis=0) >= 0.0).all()
    shown = np.concatenate([everything, _AXES * extent * np.eye(3)]) if around else everything
    views = (plan(shown), perspective(shown))
    return tuple(draw(scene, v, everything, enlarged, ellipsoid) for v in views), enlarged
