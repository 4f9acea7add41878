"""Options for reading cameras, and what follows from them: training sizes, the split, the set that a reader returns.

Sizes are (width, height), in px.  Functions raise UsageError for a side above the limit CAMERA_SIDE, and FormatError
for a photo that cannot be read or whose aspect differs from its camera's.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from aaplug.core.cameras import Camera, CameraSet, photographs
from aaplug.io.images import image_size
from aaplug.io.limits import whole_limit
from aaplug.system.contracts import check_fields
from aaplug.system.errors import FormatError, UsageError, counted

LLFF_HOLD = 8  # every 8th view by name is a test view: LLFF, 3DGS --eval
WIDTH_CAP = 1600  # px: 3DGS, utils/camera_utils.py
MAX_ASPECT_ERROR = 0.01  # relative difference between a photo's aspect and its camera's that rounding explains

Size = tuple[int, int]


@dataclass(frozen=True)
class CameraFileOptions:
    """The user's choices, see `read_cameras`; None means what the files say, or else the format's custom."""

    train_scale: float | None = None
    images: str | None = None
    test_every: int | None = None
    undistort: bool = False

    def __post_init__(self) -> None:
        check_fields(self)
        scale, every = self.train_scale, self.test_every
        if scale is not None and not (math.isfinite(scale) and scale > 0):
            raise UsageError("train_scale", f"should be above 0 (1/4 is 0.25), not {scale}")
        if every is not None and (every < 0 or every == 1):
            raise UsageError("test_every", f"should be 0 (no split), 2 or more, not {every}")


def explicit(train: Sequence[Camera], test: Sequence[Camera], source: str) -> CameraSet:
    """A split that the files give, with a note on where it came from."""
    return CameraSet((*train,), (*test,), notes=(f"split: {len(train)} train, {len(test)} test ({source})",))


def undivided(cameras: Sequence[Camera], source: str) -> CameraSet:
    """No split: every camera is both a training and a test view; with a note on why."""
    views = tuple(cameras)
    note = f"split: none, {counted(len(views), 'camera')} for both training and test ({source})"
    return CameraSet(views, views, notes=(note,))


def every_nth(cameras: Sequence[Camera], options: CameraFileOptions, custom: int, source: str) -> CameraSet:
    """Every n-th camera, beginning with the first, is a test view.

    custom: n if `options` do not give it, for the reason `source`; 0 for no split.
    """
    n = custom
    if options.test_every is not None:
        n, source = options.test_every, f"`test_every` {options.test_every}"
    if not n:
        return undivided(cameras, source)
    if len(cameras) == 1:
        return undivided(cameras, "one camera cannot be divided")
    train = [camera for index, camera in enumerate(cameras) if index % n]
    return explicit(train, cameras[::n], f"1 in {n} by name: {source}")


def at_file_size(cameras: Sequence[Camera], options: CameraFileOptions) -> tuple[list[Camera], str]:
    """The cameras as `at_train_scale`, of a format that gives each photo's path and so takes no folder of photos."""
    if options.images is not None:
        raise UsageError("images", "this format gives each photo's path itself; leave it out")
    return at_train_scale(cameras, options)


def at_train_scale(cameras: Sequence[Camera], options: CameraFileOptions) -> tuple[list[Camera], str]:
    """The cameras trained at their size in the file, times `train_scale` if the user chose one; and why, for a note."""
    scale = options.train_scale
    sizes = [_scaled(camera, 1.0 if scale is None else scale) for camera in cameras]
    most = whole_limit("CAMERA_SIDE")
    if max(map(max, sizes), default=0) > most:
        raise UsageError("train_scale", f"makes an image of more than {most} px a side")
    why = _uncapped(sizes) if scale is None else f" × {scale:g}: `train_scale`"
    return trained_at(cameras, sizes), f"size in the file{why}"


def at_photo_size(cameras: Sequence[Camera], options: CameraFileOptions) -> tuple[list[Camera], str]:
    """The cameras trained at the size of their photos, unless the user chose `train_scale`; and why, for a note."""
    if options.train_scale is not None:
        return at_train_scale(cameras, options)
    there, sizes = len(photographs(cameras)), photo_sizes(cameras)
    why = f"size of the {counted(there, 'photo')} found" if there else "size in the file, no photos found"
    return trained_at(cameras, sizes), why + _uncapped(sizes)


def _uncapped(sizes: Sequence[Size]) -> str:
    """An addition to the reason, for sizes that trainers make smaller."""
    caps = f"; 3DGS caps the width at {WIDTH_CAP} px and nerfstudio halves larger ones: `train_scale` sets it"
    return caps if max(map(max, sizes), default=0) > WIDTH_CAP else ""


def photo_sizes(cameras: Sequence[Camera]) -> list[Size]:
    """The size of each camera's photo; a camera without one is scaled like the first that has one."""
    sizes: list[Size | None] = []
    for camera in cameras:
        size = camera.photo and image_size(camera.photo)
        if size and abs(size[1] - (height := camera.height * size[0] / camera.width)) > 1 + MAX_ASPECT_ERROR * height:
            what = f"is {size[0]}×{size[1]} px, which is not the shape of its camera"
            hint = "is it the wrong folder, or is the photo turned?"
            raise FormatError(camera.photo or "", f"{what} ({camera.width}×{camera.height} px); {hint}")
        sizes.append(size)
    rate = next((size[0] / camera.width for size, camera in zip(sizes, cameras, strict=True) if size), 1.0)
    return [size or _scaled(camera, rate) for size, camera in zip(sizes, cameras, strict=True)]


def trained_at(cameras: Sequence[Camera], sizes: Sequence[Size]) -> list[Camera]:
    """The cameras at their training sizes, with the same fields of view."""
    return [camera.resized(*size).as_trained() for camera, size in zip(cameras, sizes, strict=True)]


def described_sizes(cameras: Sequence[Camera]) -> str:
    """The cameras' sizes, for a note."""
    sizes = sorted({(c.width, c.height) for c in cameras}, key=lambda s: (s[0] * s[1], s))
    words = [f"{width}×{height}" for width, height in sizes]
    return f"{words[0]} px" if len(words) == 1 else f"{words[0]} to {words[-1]} px"


def camera_set(
    kind: str,
    source: Sequence[Camera],
    split: CameraSet,
    why: str,
    background: tuple[float, float, float] | None = None,
    more: Sequence[str] = (),
) -> CameraSet:
    """A split with notes on format and training size beside its own.

    source: the cameras as the file has them.  why: where the training size came from.  more: notes to add.
    """
    format = f"{kind}: {counted(len(source), 'camera')}, {described_sizes(source)} in the file"
    size = f"training size: {described_sizes([*split.train, *split.test])} ({why})"
    return replace(split, background=background, notes=(format, *split.notes, size, *more))


def _scaled(camera: Camera, scale: float) -> Size:
    return max(1, round(camera.width * scale)), max(1, round(camera.height * scale))
