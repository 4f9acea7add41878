"""A scene in time: flicker at small sizes by recipe, with sampling bounds over all frames and of each frame alone.

The frames are made of a still scene, which turns and grows, and written to a folder that is then removed.
"""

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import torch
from scipy.spatial.transform import Rotation

from aaplug import CameraSet, Gaussians, evaluate, read_scene, write_scene
from aaplug.core.camera_paths import median_depth, moved
from aaplug.core.placing import placed
from aaplug.evaluation.results import mean
from tests.bench import heading, row
from tests.bench.scenes import CHECKPOINTS, Trained, trained

DEGREES = 1.0  # of turning from frame to frame, about the world's z through the scene's middle
GROWTH = 1.01  # from frame to frame
RECIPES = ("classic", "mip-splatting", "matched", "auto")
SCALES = (1 / 4, 1 / 8)
VIEWS = 2
NEARER = 4.0  # times, than the other training views, of a close-up


def main(scene: str = "chair", frames: int = 6) -> None:
    """Print the flicker of a scene that turns and grows, over so many frames."""
    opened = trained(scene)
    background = CHECKPOINTS[scene].background
    views = ",".join(view.name for view in opened.views(VIEWS))
    columns = [f"{recipe} 1/{1 / scale:g}" for recipe in RECIPES for scale in SCALES]
    heading(f"{scene}, {frames} frames: flicker (1 is motion alone)", "training views", "bounds", *columns)
    with TemporaryDirectory() as folder:
        written = write_sequence(Path(folder), opened.scene, frames)
        for name, cameras in (("all", opened.cameras), ("all, and a close-up", with_close_up(opened))):
            for apart in (False, True):
                options = {"recipe": RECIPES, "scale": SCALES, "metric": "flicker", "views": views}
                sequence = read_scene(written, frames_apart=apart)
                report = evaluate(sequence, cameras, **options, background=background, min_seen=0)
                values = [mean(report.select(recipe, scale), "flicker") for recipe in RECIPES for scale in SCALES]
                row(name, "of each frame" if apart else "over all", *(f"{value:.3f}" for value in values))


def turning(scene: Gaussians, frames: int) -> Iterator[Gaussians]:
    """The scene, turning by `DEGREES` and growing by `GROWTH` from frame to frame, about its middle."""
    middle = scene.means.double().median(dim=0).values
    for frame in range(frames):
        turn = torch.from_numpy(Rotation.from_euler("z", frame * DEGREES, degrees=True).as_matrix())
        scale = math.pow(GROWTH, frame)
        yield placed(scene, turn, scale, (middle - scale * (turn @ middle)).tolist())


def write_sequence(folder: Path, scene: Gaussians, frames: int) -> Path:
    """Write the frames of `turning` to a folder, numbered from 1."""
    for number, frame in enumerate(turning(scene, frames), start=1):
        write_scene(folder / f"frame_{number:04d}.ply", frame)
    return folder


def with_close_up(opened: Trained) -> CameraSet:
    """The cameras with one more training view, `NEARER` times nearer: Gaussians come into it and leave."""
    view = opened.cameras.train[0]
    near = moved(view, NEARER, median_depth(opened.scene.means, view))
    return replace(opened.cameras, train=(*opened.cameras.train, near))
