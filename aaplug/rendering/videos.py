"""A camera path as a video: the images of one pane, or those of several in one frame."""

from collections.abc import Callable, Sequence
from os import PathLike
from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from aaplug.core.cameras import Camera
from aaplug.io.images import read_image
from aaplug.io.video import check_video, write_video
from aaplug.rendering.frames import write_frames
from aaplug.rendering.renderer import Renderer
from aaplug.system.executors import Apply
from aaplug.system.locks import scratch
from aaplug.system.monitor import Tell

Image = Float[Tensor, "h w 3"]


def make_video(
    path: str | PathLike[str],
    panes: Sequence[tuple[Renderer, Sequence[Camera]]],
    fps: float,
    compose: Callable[[int, Sequence[Image]], Image] = lambda _, images: images[0],
    apply: Apply = map,
    *,
    folder: Path | None = None,
    overwrite: bool = False,
    tell: Tell = lambda done, total: None,
) -> None:
    """Render the panes and write the video.

    panes: of each the renderer and a camera for every frame.
    compose: makes one frame of its number and the panes' images.  apply: as for `write_frames`.
    folder: in which the images are kept until the video is written; None for the system's temporary files.
    tell: called with (images done, images in all).

    Raises:
        OutputError: the video or a frame cannot be written.
        UsageError: the codec is not installed, or a process died.
    """
    path = Path(path)
    check_video(path, fps, overwrite)
    total = sum(len(cameras) for _, cameras in panes)
    with scratch(folder and str(folder)) as images:
        files: list[list[Path]] = []
        for place, (renderer, cameras) in enumerate(panes):
            before = sum(map(len, files))
            files.append([images / f"{place}-{index:06d}.png" for index in range(len(cameras))])

            def tell_all(done: int, _: int, before: int = before) -> None:
                tell(before + done, total)

            write_frames(renderer, cameras, files[-1], apply, tell=tell_all)
        frames = (
            compose(index, [read_image(file, None) for file in each])
            for index, each in enumerate(zip(*files, strict=True))
        )
        write_video(path, frames, fps, overwrite)
