"""Pose refinement: cameras are moved until the scene looks like their photographs.

Render and photograph are compared at one scale after the other, coarse to fine (Lucas and Kanade 1981, section 4.3).
Both are band-limited to the scale, so a residual has no detail finer than its pixels, and a pose that is off by several
pixels at full size is led to the right place.  MipSLAM (Li et al. 2026, arXiv 2603.06989) weighs the edges of its pose
graph by the same residuals; its odometry and graph are left out.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import median

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.camera_paths import median_depth
from aaplug.core.cameras import Camera, CameraSet
from aaplug.finetuning.settings import l2
from aaplug.io.lenses import straightened
from aaplug.io.photographs import photo_of
from aaplug.methods.presets import find_recipe
from aaplug.rendering.renderer import Renderer
from aaplug.system.errors import UsageError, counted
from aaplug.system.monitor import Monitor

SCALES = (1 / 8, 1 / 4, 1 / 2)  # of the training size
ITERATIONS = 16  # of L-BFGS at each scale, at most
LEVELS = 255.0  # of 8 bits: errors are in squared levels
LEAST_CHANGE = 1e-3  # px by which a step moves the camera, or squared levels by which the error falls: a scale ends
LEAST_GAIN = 0.05  # share by which the squared error must fall


@dataclass(frozen=True, eq=False)
class RefinedPose:
    """A camera, the angle by which it was turned, and the distance by which it was moved, in world units.

    before, after: root mean square error against the photograph at the training size, in 8-bit levels.
    """

    camera: Camera
    degrees: float
    distance: float
    before: float
    after: float


def refined(
    look: Renderer, cameras: CameraSet, views: Sequence[Camera], monitor: Monitor
) -> tuple[CameraSet, tuple[RefinedPose, ...]]:
    """The cameras, with the poses of some views refined, and a note that says by how much.

    look: the scene as training showed it.  monitor: receives progress and the note.

    Raises UsageError if a view has no photograph.
    """
    if bare := [view.name for view in views if view.photo is None]:
        raise UsageError(bare[0], "has no photograph, on which its pose is refined")
    renderer, poses = look.by(find_recipe("auto", quality="fast")), []
    with monitor.progress("refining poses", "views") as tell:
        for done, view in enumerate(views):
            tell(done, len(views))
            # Gradients through a lens are not compiled. Through a fisheye splats differ too much from a pinhole's.
            straight = straightened(view, view.lens) if view.straight() is not view else view
            pose = refine_pose(renderer, view if straight.photo is None else straight)
            poses.append(replace(pose, camera=replace(view, cam_from_world=pose.camera.cam_from_world)))
    moved = {id(view): pose.camera for view, pose in zip(views, poses, strict=True)}
    splits = {s: tuple(moved.get(id(v), v) for v in vars(cameras)[s]) for s in ("train", "test")}
    changed = [(p.degrees, p.distance, p.before, p.after) for p in poses if p.after < p.before]
    count = counted(len(poses), "pose")
    note = f"{count}: none moved, as photographs show nothing better"
    if changed:
        turn, shift, before, after = map(median, zip(*changed, strict=True))
        moves = f"{len(changed)} of {count} moved, in the median by {turn:.2g}° and {shift:.2g} units"
        note = f"{moves}: error at the training size from {before:.1f} to {after:.1f} of 255 levels"
    monitor.say(note)
    return replace(cameras, **splits, notes=(*cameras.notes, note)), tuple(poses)


def refine_pose(renderer: Renderer, view: Camera, scales: Sequence[float] = SCALES) -> RefinedPose:
    """Move a view, given at its training size, until its render looks like its photograph.

    The view stays where it is if its error at the training size falls by less than `LEAST_GAIN`.  There the scene looks
    as training drew it; in smaller renders, a move may only make up for what aliasing does.
    """
    photo_at, camera = photo_of(view, renderer.background), view
    depth = median_depth(renderer.scene.means, view)

    def error(camera: Camera) -> Float[Tensor, ""]:
        return LEVELS**2 * l2(renderer(camera.scaled(scale)).rgb, photo)

    def closure() -> float:
        px.grad = None
        loss = error(moved_by(camera, px / focal, depth))
        loss.backward()
        return float(loss.detach())

    for scale in scales:
        sized = view.scaled(scale)
        focal, photo = sized.focal, photo_at(sized)
        px = torch.zeros(6, dtype=torch.float64, requires_grad=True)
        how = {"max_iter": ITERATIONS, "tolerance_grad": 0.0, "tolerance_change": LEAST_CHANGE}
        torch.optim.LBFGS([px], **how, line_search_fn="strong_wolfe").step(closure)
        camera = moved_by(camera, px.detach() / focal, depth)
    scale, photo = 1.0, photo_at(view)
    with torch.no_grad():
        before, after = float(error(view)), float(error(camera))
    if after > (1 - LEAST_GAIN) * before:
        camera, after = view, before
    chord = float((camera.cam_from_world - view.cam_from_world)[:3, :3].norm())  # √8 sin(angle / 2)
    degrees = math.degrees(2 * math.asin(min(1.0, chord / math.sqrt(8))))
    return RefinedPose(camera, degrees, float((camera.centre - view.centre).norm()), before**0.5, after**0.5)


def moved_by(camera: Camera, change: Float[Tensor, " 6"], depth: float) -> Camera:
    """The camera, with the scene turned about the point at `depth` on its axis, and shifted; differentiable.

    About that point, turning hardly shifts the image, so the two are nearly independent.

    change: rotation vector, in radians, and shift, over depth, in the camera's frame.
    """
    turn = torch.linalg.matrix_exp(torch.linalg.cross(torch.eye(3).to(change), change[:3].expand(3, 3)))
    pivot = change.new_tensor([0.0, 0.0, depth])
    rotation, place = camera.cam_from_world[:3, :3], camera.cam_from_world[:3, 3]
    moved = torch.cat([turn @ rotation, (turn @ (place - pivot) + pivot + depth * change[3:])[:, None]], dim=1)
    return replace(camera, cam_from_world=torch.cat([moved, camera.cam_from_world[3:]]))
