"""Training sizes of cameras, and the set of cameras that a reader returns.

Sizes are (width, height), in px.  Functions raise UsageError for a side above the limit CAMERA_SIDE, and FormatError
for a photo that cannot be read or whose aspect differs from its camera's.
"""

from collections.abc import Sequence

from aaplug.core.cameras import Camera, CameraSet
from aaplug.core.errors import FormatError, UsageError
from aaplug.io.cameras.options import Options, Split
from aaplug.io.images import image_size
from aaplug.io.limits import whole_limit

SAME_SHAPE = 0.01  # relative difference between a photo's aspect and its camera's that rounding explains

Size = tuple[int, int]


def file_sizes(cameras: Sequence[Camera], options: Options) -> tuple[list[Size], str]:
    """Each camera's size in the file, times `train_scale` if the user chose one; and why, for a note."""
    scale = options.train_scale
    sizes = [scaled(camera, 1.0 if scale is None else scale) for camera in cameras]
    most = whole_limit("CAMERA_SIDE")
    if max(map(max, sizes), default=0) > most:
        raise UsageError("train_scale", f"makes an image of more than {most} px a side")
    return sizes, "size in the file" + ("" if scale is None else f" × {scale:g}: `train_scale`")


def photo_sizes(cameras: Sequence[Camera]) -> list[Size]:
    """The size of each camera's photo; a camera without one is scaled like the first that has one."""
    known = [_photo_size(camera) for camera in cameras]
    rate = next((s[0] / c.width for s, c in zip(known, cameras, strict=True) if s), 1.0)
    return [size or scaled(camera, rate) for size, camera in zip(known, cameras, strict=True)]


def scaled(camera: Camera, scale: float) -> Size:
    """The camera's size times `scale`, rounded."""
    return max(1, round(camera.width * scale)), max(1, round(camera.height * scale))


def trained_at(cameras: Sequence[Camera], sizes: Sequence[Size]) -> list[Camera]:
    """The cameras at their training sizes, with the same fields of view."""
    return [c.resized(*size).as_trained() for c, size in zip(cameras, sizes, strict=True)]


def described_sizes(cameras: Sequence[Camera]) -> str:
    """The cameras' sizes, for a note."""
    sizes = sorted({(c.width, c.height) for c in cameras}, key=lambda s: (s[0] * s[1], s))
    shown = [f"{width}×{height}" for width, height in sizes]
    return f"{shown[0]} px" if len(shown) == 1 else f"{shown[0]} to {shown[-1]} px"


def camera_set(
    kind: str,
    source: Sequence[Camera],
    split: Split,
    why: str,
    background: tuple[float, float, float] | None = None,
    more: Sequence[str] = (),
) -> CameraSet:
    """The set of a split of cameras, with notes on format, split and training size.

    source: the cameras as the file has them.  why: where the training size came from.  more: notes to add.
    """
    format = f"{kind}: {len(source)} cameras, {described_sizes(source)} in the file"
    size = f"training size: {described_sizes([*split.train, *split.test])} ({why})"
    return CameraSet(split.train, split.test, background, (format, split.note, size, *more))


def _photo_size(camera: Camera) -> Size | None:
    if camera.photo is None:
        return None
    width, height = image_size(camera.photo)
    expected = camera.height * width / camera.width
    if abs(height - expected) > 1 + SAME_SHAPE * expected:
        what = f"is {width}×{height} px, which is not the shape of its camera ({camera.width}×{camera.height} px)"
        raise FormatError(camera.photo, f"{what}; is it the wrong folder, or is the photo turned?")
    return width, height
