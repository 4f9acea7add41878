"""Pose refinement: what is left of the error of cameras that are off, and how far true poses move."""

import math
import statistics
import time
from dataclasses import replace

import torch
from scipy.spatial.transform import Rotation
from torch.nn.functional import normalize

from aaplug import Camera, Renderer, find_recipe
from aaplug.finetuning.poses import RefinedPose, refine_pose
from aaplug.io.photographs import photo_of
from tests.bench import heading, row
from tests.bench.scenes import decibels, trained

DEGREES = 0.5  # by which cameras are turned, about random axes
SHARE = 0.005  # of the cameras' extent, by which they are moved, in random directions
EXTENT_MARGIN = 1.1  # of the largest distance of a camera from the middle of all, as 3DGS takes the extent


def main(views: int = 25) -> None:
    """Print the figures of so many test views of the chair."""
    torch.set_num_threads(1)
    opened = trained("chair")
    centres = torch.stack([camera.centre for camera in opened.cameras.train])
    extent = EXTENT_MARGIN * float((centres - centres.mean(dim=0)).norm(dim=1).max())
    renderer = opened.renderer(find_recipe("auto", quality="fast"))
    generator = torch.Generator().manual_seed(1)
    heading(f"the chair, {views} views", "poses", "", "angle, °", "distance, % of extent", "dB below the true pose")
    for name, off in (("off", 1.0), ("true", 0.0)):
        started, figures = time.process_time(), list[tuple[float, float, float]]()
        for view in opened.views(views):
            axis, way = normalize(torch.randn(2, 3, generator=generator, dtype=torch.float64), dim=1)
            turn = torch.from_numpy(Rotation.from_rotvec(off * math.radians(DEGREES) * axis.numpy()).as_matrix())
            pose = view.cam_from_world.clone()
            pose[:3] = turn.to(pose) @ pose[:3]
            pose[:3, 3] += off * SHARE * extent * way.to(pose)
            start = replace(view, cam_from_world=pose)
            figures.append(_figures(renderer, view, refine_pose(renderer, start), extent))
        for what, of in (("median", statistics.median), ("worst", max)):
            row(name, what, *(f"{of(column):.3f}" for column in zip(*figures, strict=True)))
        print(f"{(time.process_time() - started) / len(figures):.1f} s of processor time a view", flush=True)


@torch.no_grad()
def _figures(renderer: Renderer, view: Camera, found: RefinedPose, extent: float) -> tuple[float, float, float]:
    """What is left of the error in degrees and in percent of the extent; dB of PSNR lost to the true pose's."""
    chord = float((found.camera.cam_from_world - view.cam_from_world)[:3, :3].norm())  # √8 sin(angle / 2)
    photo = photo_of(view, renderer.background)(view)
    loss = decibels(renderer(view).rgb, photo) - decibels(renderer(found.camera).rgb, photo)
    share = float((found.camera.centre - view.centre).norm()) / extent
    return math.degrees(2 * math.asin(chord / math.sqrt(8))), 100 * share, loss
