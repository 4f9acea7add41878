"""Sizes of rendered views, and the files they go to: checked here, before any work."""

import re
from collections.abc import Sequence
from pathlib import Path

from aaplug.core.cameras import Camera
from aaplug.core.errors import OutputError, UsageError
from aaplug.io.atomic import check_output, refuse_existing

MAX_SIDE = 16384  # px


def resized(views: Sequence[Camera], scale: float | None = None, resolution: str | None = None) -> list[Camera]:
    """The views at the size that `ImageOptions` describes.

    Raises:
        UsageError: both are given, one is not a size, or an image would be larger than `MAX_SIDE`.
    """
    if scale is not None and resolution is not None:
        raise UsageError("scale", "and `resolution` both set the size; give one")
    if scale is not None and not scale > 0:
        raise UsageError("scale", f"must be above 0, got {scale:g}")
    if resolution is not None:
        sized = [view.resized(*_size(resolution, view)) for view in views]
    else:
        sized = [view.scaled(1.0 if scale is None else scale) for view in views]
    for view in sized:
        if max(view.hw) > MAX_SIDE:
            raise UsageError(view.name, f"would be {view.width}x{view.height} px; the limit is {MAX_SIDE} a side")
    return sized


def image_paths(output: Path, views: Sequence[Camera], overwrite: bool) -> list[Path]:
    """One .png per view in the folder `output`, or `output` itself if it is a .png.

    Raises:
        OutputError: an image exists and `overwrite` is false, or one .png is named for several views.
    """
    if output.suffix:
        if output.suffix.lower() != ".png" or len(views) != 1:
            raise OutputError(output, f"name a folder, or one .png for one view ({len(views)} views asked for)")
        check_output(output, overwrite)
        return [output]
    paths = [output / f"{name}.png" for name in file_names([view.name for view in views], "view", 5)]
    refuse_existing(paths, overwrite)
    return paths


def file_names(names: Sequence[str], nameless: str, digits: int) -> list[str]:
    """Names fit for files; all are numbered where two would be the same."""
    slugs = [re.sub(r"[^\w.\-]+", "_", name).lstrip(".") or nameless for name in names]
    if len({slug.casefold() for slug in slugs}) < len(slugs):
        return [f"{index:0{digits}d}_{slug}" for index, slug in enumerate(slugs)]
    return slugs


def _size(text: str, view: Camera) -> tuple[int, int]:
    match = re.fullmatch(r"(-?\d+)x(-?\d+)", text)
    width, height = (int(match[1]), int(match[2])) if match else (0, 0)
    if max(width, height) < 1 or min(width, height) == 0:
        raise UsageError("resolution", f"expected WIDTHxHEIGHT such as 400x400 or -1x720, got '{text}'")
    if width < 0:
        return max(1, round(view.width * height / view.height)), height
    return width, max(1, round(view.height * width / view.width)) if height < 0 else height
