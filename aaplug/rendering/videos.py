"""A camera path as a video: one recipe, or two side by side with their names."""

import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.cameras import Camera
from aaplug.core.gaussians import Gaussians
from aaplug.core.interfaces import Rasterizer
from aaplug.core.training import TrainingViews
from aaplug.evaluation.report.contact_sheet import labelled
from aaplug.io.images import read_image
from aaplug.io.video import check_video, write_video
from aaplug.methods.recipes import Recipe
from aaplug.rendering.frames import Frames, write_frames
from aaplug.rendering.renderer import smooth

GAP = 4  # px between two panes


@dataclass(frozen=True)
class Video:
    """What is shown.  recipes: one, or several from left to right.  labels: a text for each pane."""

    scene: Gaussians
    training: TrainingViews
    recipes: Sequence[Recipe]
    labels: Sequence[str]
    background: tuple[float, float, float]
    cameras: Sequence[Camera]
    fps: float


def make_video(
    video: Video,
    path: Path,
    rasterizer: Rasterizer,
    threads: int,
    overwrite: bool = False,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> None:
    """Render the frames, in processes side by side where that pays, and write the video.

    progress: told (images done, images in all).

    Raises:
        OutputError: the video or a frame cannot be written.
        UsageError: the codec is not installed, or a process died.
    """
    check_video(path, video.fps, overwrite)
    count = len(video.cameras)
    total = count * len(video.recipes)
    with tempfile.TemporaryDirectory(prefix="aaplug-") as name:
        panes: list[list[Path]] = []
        for place, recipe in enumerate(video.recipes):
            paths = [Path(name) / f"{place}-{index:06d}.png" for index in range(count)]
            frames = Frames(
                smooth(video.scene, video.training, recipe),
                video.training,
                recipe,
                video.background,
                video.cameras,
                paths,
            )
            write_frames(
                frames,
                rasterizer,
                threads,
                lambda done, _, before=place * count: progress(before + done, total),
            )
            panes.append(paths)
        write_video(path, _composed(panes, video.labels), video.fps, overwrite)


def _composed(
    panes: Sequence[Sequence[Path]], labels: Sequence[str]
) -> Iterator[Float[Tensor, "h w 3"]]:
    for paths in zip(*panes, strict=True):
        images = [read_image(path, None) for path in paths]
        if len(images) == 1:
            yield images[0]
            continue
        shown = [labelled(image, label) for image, label in zip(images, labels, strict=True)]
        gap = torch.zeros(shown[0].shape[0], GAP, 3)
        yield torch.cat([part for image in shown for part in (gap, image)][1:], dim=1)
