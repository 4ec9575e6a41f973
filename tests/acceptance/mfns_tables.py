"""Tables 2 and 3 of the published calibration of the three-camera head, beside the replica's: ``docs/mfns.md``.

``python -m tests.acceptance.mfns_tables [--replicas N] [--doc FILE]``
"""

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from gtsam import Pose3
from scipy.stats import chi2
from tqdm import tqdm

from adjust.adjustment import AdjustOptions, assemble
from adjust.graph.solver import solve
from adjust.model.observations import ImageBlock
from survey.detection import detect_image
from survey.project.targets import Checkerboard
from survey.simulate import BROWN, Scene
from survey.simulate.rendering import BrownCamera, Imaging, PlacedTarget, render
from tests.acceptance.mfns_replica import (
    ANGLES_DEG,
    CAMERAS,
    FREE_LENS,
    LENS_SIGMAS,
    LENSES,
    PRINTED_SIGMAS,
    QUANTITIES,
    SIGMA_PX,
    VECTORS_MM,
    camera_graph,
    joint_errors,
    joint_graph,
    noisy,
    replica,
    stepwise,
    stepwise_errors,
)
from tests.acceptance.test_mfns import JOINT, bound_of

BOARD = Checkerboard(11, 8, 0.02)
# the board's rows run against the world's y: seen as it is printed, its first row is the last of the world
WORLD_FROM_PRINTED = Pose3(np.array([[1.0, 0, 0, 0], [0, 1, 0, -0.14], [0, 0, 1, 0], [0, 0, 0, 1]]))


def joint_covariance(result):
    """Covariance (27, 27) of QUANTITIES in deg and mm, and of the lenses by camera."""
    dims = [result.precision.graph.unknowns.by_name[name].dim for name in JOINT]
    at = dict(zip(JOINT, np.cumsum([0, *dims[:-1]]), strict=True))
    return bound_of(result.precision.joint(JOINT), at)


def replicas(survey, truth, n):
    """Errors (n, 27) of both methods, the stepwise method's own sigmas, lens errors (n, 24), tests d' inv(C) d (n,)."""
    joint, steps, own, lenses, tests = [], [], [], [], []
    free = [i for i, name in enumerate(q for q in QUANTITIES for _ in "xyz") if name != "r_wb^w"]
    for seed in tqdm(range(n), desc="replicas", file=sys.stderr):
        again = noisy(survey, truth, 1000 + seed)
        graph = joint_graph(again, truth)
        result = assemble(graph, solve(graph), AdjustOptions())
        error = joint_errors({k: e.value for k, e in result.estimates.items() if isinstance(e.value, Pose3)})
        C = joint_covariance(result)[np.ix_(free, free)]
        tests.append(error[free] @ np.linalg.solve(C, error[free]))
        joint.append(error)
        lenses.append(np.concatenate([lens_of(result, k)[0] - LENSES[k] for k in CAMERAS]))
        found = stepwise(again, truth)
        steps.append(stepwise_errors(found))
        own.append(np.concatenate([found.rotations[q].sigma_deg if q[0] == "C" else found.vectors[q].sigma_mm
                                   for q in QUANTITIES]))  # fmt: skip
    return [np.array(x) for x in (joint, steps, own, lenses, tests)], len(free)


def lens_of(result, camera_id):
    """Values and sigmas (8,) of FREE_LENS."""
    e = result.estimates["lens", camera_id]
    at = [e.components.index(name) for name in FREE_LENS]
    return np.asarray(e.value)[at], np.sqrt(np.diag(e.cov))[at]


def table_2(survey, truth, ideal, lenses):
    """Sigmas of the lenses: printed, of a camera alone, of all together, scatter of all together."""
    lines = ["| camera | | printed value | printed σ | camera alone σ | joint σ | joint, scatter | printed / joint |",
             "|---|---|---|---|---|---|---|---|"]  # fmt: skip
    ratios = []
    for c, camera_id in enumerate(CAMERAS):
        graph = camera_graph(survey, truth, camera_id)
        alone = lens_of(assemble(graph, solve(graph), AdjustOptions()), camera_id)[1]
        together = lens_of(ideal, camera_id)[1]
        scatter = np.sqrt(np.mean(lenses[:, 8 * c : 8 * c + 8] ** 2, axis=0))
        ratios.append(np.array(LENS_SIGMAS[camera_id]) / alone)
        for i, name in enumerate(FREE_LENS):
            numbers = (LENSES[camera_id][i], LENS_SIGMAS[camera_id][i], alone[i], together[i], scatter[i])
            text = " | ".join(f"{x:.5f}" for x in numbers)
            lines.append(f"| {camera_id} | {name} | {text} | {LENS_SIGMAS[camera_id][i] / together[i]:.1f} |")
    found = np.concatenate(ratios)
    said = TEXT["two said"].format(median=np.median(found), low=found.min(), high=found.max())
    return [*lines, "", said]


def table_3(ideal, joint, steps, own):
    """The head: printed, both methods, the bound."""
    bound = np.sqrt(np.diag(joint_covariance(ideal)))
    rms = [np.sqrt(np.mean(x**2, axis=0)) for x in (own, steps, joint)]
    heads = ("", "", "printed", "printed σ", "steps: claimed", "steps: rms", "steps: mean", "joint: rms", "bound",
             "joint / bound", "steps / bound")  # fmt: skip
    lines = [f"| {' | '.join(heads)} |", "|" + "---|" * len(heads)]
    for i, (name, axis) in enumerate((q, a) for q in QUANTITIES for a in range(3)):
        unit = "deg" if name[0] == "C" else "mm"
        value = (ANGLES_DEG if name[0] == "C" else VECTORS_MM)[name][axis]
        numbers = (value, PRINTED_SIGMAS[name][axis], rms[0][i], rms[1][i], steps[:, i].mean(), rms[2][i], bound[i])
        text = " | ".join(f"{x:.4f}" for x in numbers)
        ratios = f"{rms[2][i] / bound[i]:.2f} | {rms[1][i] / bound[i]:.1f}"
        lines.append(f"| {name} {'xyz'[axis]} | {unit} | {text} | {ratios} |")
    return lines, rms[2] / bound


def bias_of(steps):
    """Which result of the steps is biased most, in its own standard errors, and as a share of its scatter."""
    mean, scatter = steps.mean(axis=0), steps.std(axis=0, ddof=1)
    i = int(np.argmax(np.abs(mean) / scatter))
    name = f"`{QUANTITIES[i // 3]}` {'xyz'[i % 3]}"
    return {"biased": name, "bias": abs(mean[i]) / scatter[i] * np.sqrt(len(steps)), "share": abs(mean[i]) / scatter[i]}


def rendered_block(survey, truth, camera_id, epoch_id, seed):
    """The image points found in a rendered image, and what they should be."""
    scene = Scene(survey, truth)
    lens = dict(zip(BROWN, scene.vector("lens", camera_id), strict=True))
    distortion = tuple(float(lens[k]) for k in ("k1", "k2", "p1", "p2", "k3"))
    camera = BrownCamera((1280, 1024), lens["fx"], lens["fy"], lens["u0"], lens["v0"], distortion)
    camera_from_world = Pose3(np.linalg.inv(scene.world_from_camera(camera_id, epoch_id)))
    imaging = Imaging(blur_px=0.9, noise_gray=4.0, background_gray=105.0, gradient=(0.18, -0.12))
    image = render(camera, [PlacedTarget(BOARD, camera_from_world * WORLD_FROM_PRINTED)], imaging=imaging, seed=seed)
    found = detect_image(image, BOARD)
    row, column = np.divmod(found.point_idx, 11)
    idx = 11 * (7 - row) + column
    exact = scene.project(camera_id, epoch_id, scene.target_points("board", epoch_id))[idx]
    return ImageBlock(camera_id, epoch_id, "board", idx, found.uv, found.cov), found.uv - exact


def rendered_camera(survey, truth, camera_id):
    """Calibrate one camera from rendered images of all its epochs: detection errors, sigma0, sigmas, d' inv(C) d."""
    blocks, errors = [], []
    mine = [b.epoch_id for b in survey.image_blocks if b.camera_id == camera_id]
    for seed, epoch_id in enumerate(tqdm(mine, desc=f"camera {camera_id}", file=sys.stderr)):
        block, error = rendered_block(survey, truth, camera_id, epoch_id, seed)
        blocks.append(block)
        errors.append(error)
    graph = camera_graph(replace(survey, image_blocks=tuple(blocks)), truth, camera_id)
    result = assemble(graph, solve(graph), AdjustOptions())
    value, sigma = lens_of(result, camera_id)
    e = result.estimates["lens", camera_id]
    at = [e.components.index(name) for name in FREE_LENS]
    d = value - LENSES[camera_id]
    return np.concatenate(errors), result.sigma0, sigma, d @ np.linalg.solve(e.cov[np.ix_(at, at)], d)


def document(n, cameras=CAMERAS):
    """The whole page, as lines."""
    survey, truth = replica()
    graph = joint_graph(survey, truth)
    ideal = assemble(graph, solve(graph), AdjustOptions())
    (joint, steps, own, lenses, tests), freedom = replicas(survey, truth, n)
    third, ratio = table_3(ideal, joint, steps, own)
    low, high = chi2.ppf([0.005, 0.995], n * freedom) / (n * freedom)
    why = TEXT["why"].format(**bias_of(steps))
    lines = [TEXT["head"].format(n=n), "", TEXT["two"], "", *table_2(survey, truth, ideal, lenses), "", TEXT["three"],
             "", *third, "", TEXT["said"].format(
                 covers=tests.sum() / (n * freedom), low=low, high=high, freedom=freedom,
                 efficiency=1.0 / np.sqrt(np.mean(ratio**2)), worst=ratio.max()), "", why, "",
             TEXT["rendered"], ""]  # fmt: skip
    lines += ["| camera | images | points | detection rms [px] | σ0 | lens: d′C⁻¹d (8) | σ fx [px] | printed [px] |",
              "|---|---|---|---|---|---|---|---|"]  # fmt: skip
    for camera_id in cameras:
        errors, sigma0, sigma, test = rendered_camera(survey, truth, camera_id)
        images = sum(b.camera_id == camera_id for b in survey.image_blocks)
        lines.append(f"| {camera_id} | {images} | {len(errors)} | {np.sqrt(np.mean(errors**2)):.4f} | {sigma0:.3f} | "
                     f"{test:.1f} | {sigma[0]:.3f} | {LENS_SIGMAS[camera_id][0]:.3f} |")  # fmt: skip
    return lines


TEXT = {
    "head": f"""# The three-camera head on the turntable, repeated

The calibration published for a head of three cameras with views that do not overlap, on a two-axis turntable before one
checkerboard, repeated by simulation with the published geometry, noise ({SIGMA_PX} px, 8″, caliper 0.2456 mm) and
counts: 11 images a camera on the table and 10 by hand, 11 × 8 corners of 20 mm. {{n}} replicas. This page is written by

```
python -m tests.acceptance.mfns_tables --replicas {{n}} --doc docs/mfns.md
```

*Steps* is the published method: each camera by itself (Zhang), then small-angle least squares for the rotations and
least squares for the vectors, one after the other. *Joint* is one adjustment of everything. *Bound* is the joint
covariance at the truth (Cramér-Rao); a test derives it a second time from OpenCV's projection and dense algebra.""",
    "two": """## Table 2: the lenses

The published sigmas are of each camera alone, from real images.""",
    "two said": """The printed sigmas are {low:.1f} to {high:.1f} times what 21 images with corners good to
{sigma} px give a camera alone, in the median {median:.1f} times. That is what printing three sigmas would do, as
Bouguet's widely used calibration toolbox does; the paper does not say which program it used.""".replace(
        "{sigma}", str(SIGMA_PX)
    ),
    "three": """## Table 3: table and cameras

Rotations are small turns about the axes of the frame on the right, in degrees; vectors in mm. Order 2-1-3, names as
published.""",
    "said": """The joint adjustment reaches the bound: efficiency {efficiency:.3f} over all rows (largest rms over bound
{worst:.3f}). Its covariance covers: the mean of d′C⁻¹d over all replicas is {covers:.4f} per degree of freedom
({freedom} of them), 99 % band {low:.4f} to {high:.4f}.""",
    "why": """Where printed sigmas and the replica's differ by more than a factor of 1.5, these are the reasons found:

- `C_t^w` z, `C_z^b` z and what inherits them: in the published equations the heading follows only from the small turns
  about the auxiliary axis; with the few degrees of it that camera Z allows (its view leaves the board), the noise of
  those images is divided by a small angle. The joint adjustment takes it from all images of all cameras.
- `C_y^b`: its second angle is 90.16°, 0.16° from gimbal lock of the order 2-1-3, so the printed Euler sigmas cannot be
  turns about axes; the column here is of turns.
- `C_x^b`, `C_y^b`: the steps take `C_t^w` as free of error; the sigmas they claim leave out what came before
  (compare *claimed* with *rms*).
- Printed sigmas of the transverse angles are 3 to 10 times the bound: mostly what the steps lose (*steps / bound*).
  What
  remains must come from what the replica does not have; the paper does not say enough to tell a board that is not flat
  from a lens that two radial terms do not describe.
- *Mean* is the bias of the small-angle steps at the published alignment (up to 0.13° and 1.2°). The largest is that of
  {biased}: {bias:.1f} times its own standard error over these replicas, {share:.2f} of the scatter of one calibration.
- With the printed +576.91 mm for the height of the body it would not lie on the table's main axis; with −576.91 mm it
  does, so the sign is a slip.""",
    "rendered": """## From rendered images

All 21 images of a camera rendered at 1280 × 1024 (blur 0.9 px, noise 4 grey values), the corners detected by the
program, the camera calibrated alone from them with the detector's own covariances.""",
}


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--replicas", type=int, default=300)
    parser.add_argument("--doc", type=Path)
    arguments = parser.parse_args()
    text = "\n".join(document(arguments.replicas)) + "\n"
    if arguments.doc:
        arguments.doc.write_text(text, encoding="utf-8")
    else:
        print(text)


if __name__ == "__main__":
    main()
