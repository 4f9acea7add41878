"""Sizes of rendered views, and the files they go to: checked here, before any work."""

import re
from collections.abc import Sequence
from pathlib import Path

from aaplug.core.cameras import Camera
from aaplug.io.atomic import check_output, refuse_existing
from aaplug.options.shared import check_side, size_of
from aaplug.system.errors import OutputError, UsageError

IMAGES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".exr", ".bmp", ".gif")  # any other name is a folder
LONGEST_NAME = 200  # bytes; file systems take 255, and a number and a suffix are added


def resized(
    views: Sequence[Camera], scale: float | None = None, resolution: str | None = None, reframe: bool = False
) -> list[Camera]:
    """The views at the size that `ImageOptions` describes.

    reframe: pixels stay square where a resolution changes the aspect.

    Raises:
        UsageError: both are given, one is not a size, or an image would be larger than `MAX_SIDE`.
    """
    if scale is not None and resolution is not None:
        raise UsageError("scale", "and `resolution` both set the size; give one")
    if resolution is not None:
        sized = [(view.framed if reframe else view.resized)(*_size(resolution, view)) for view in views]
    else:
        sized = [view.scaled(1.0 if scale is None else scale) for view in views]
    for view in sized:
        check_side(view.name, view.width, view.height)
    return sized


def names_image(output: Path) -> bool:
    """Whether a name is that of one image, not of a folder."""
    return output.suffix.lower() in IMAGES


def image_paths(output: Path, views: Sequence[Camera], overwrite: bool) -> list[Path]:
    """One .png per view in the folder `output`, or `output` itself if it is a .png.

    Raises:
        OutputError: an image exists and `overwrite` is false, or one .png is named for several views.
    """
    if names_image(output):
        if output.suffix.lower() != ".png" or len(views) != 1:
            raise OutputError(output, f"name a folder, or one .png for one view ({len(views)} views asked for)")
        check_output(output, overwrite)
        return [output]
    paths = [output / f"{name}.png" for name in file_names([view.name for view in views], "view", 5)]
    refuse_existing(paths, overwrite)
    return paths


def file_names(names: Sequence[str], nameless: str, digits: int) -> list[str]:
    """Names fit for files; all are numbered where two would be the same."""
    slugs = [_cut(re.sub(r"[^\w.\-]+", "_", name).lstrip(".") or nameless) for name in names]
    if len({slug.casefold() for slug in slugs}) < len(slugs):
        return [f"{index:0{digits}d}_{slug}" for index, slug in enumerate(slugs)]
    return slugs


def _size(text: str, view: Camera) -> tuple[int, int]:
    """The size that the text means for a view: -1 on one side keeps the view's aspect."""
    first, _, last = text.partition("x")
    if first == "-1":
        _, height = size_of(f"1x{last}")
        return max(1, round(view.width * height / view.height)), height
    if last == "-1":
        width, _ = size_of(f"{first}x1")
        return width, max(1, round(view.height * width / view.width))
    return size_of(text)


def _cut(slug: str) -> str:
    """The name, cut to what every file system takes."""
    return slug.encode()[:LONGEST_NAME].decode(errors="ignore")
