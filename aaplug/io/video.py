"""Videos: VP9 in .webm and H.264 in .mp4, through PyAV.

Frames are RGB float32 [height, width, 3] in [0, 1], all of one size.  Codecs need even sides: the last row or column
of an odd side is repeated, and no pixel is resampled.  A video appears whole or not at all.
"""

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np
from jaxtyping import Float
from torch import Tensor

from aaplug.core.imaging import levels
from aaplug.io import MOST_FPS
from aaplug.io.atomic import AnyPath, check_output, replacing_file
from aaplug.io.images import checked_image
from aaplug.system.errors import OutputError, UsageError

if TYPE_CHECKING:
    from av import VideoStream
    from av.container import OutputContainer

CODECS = {  # by suffix: FFmpeg's name and settings; `crf` is a constant quality, which `b` must not limit
    ".webm": ("libvpx-vp9", {"crf": "24", "b": "0", "row-mt": "1", "cpu-used": "4"}),
    ".mp4": ("libx264", {"crf": "18"}),
}
# Of small frames, x264's macroblock tree makes another file in one run of a hundred
SMALL_FRAME, SMALL_SETTINGS = 128, {".mp4": {"x264-params": "mbtree=0"}}  # px
PIXEL_FORMAT = "yuv420p"  # that every player supports
BT709 = 1  # its code for matrix, primaries and transfer in ITU-T H.273
MPEG_RANGE = 1  # FFmpeg's AVCOL_RANGE_MPEG: black is 16, white is 235
MAX_DENOMINATOR = 1001  # of frames per second, as in 30000/1001
BIT_EXACT = {"fflags": "+bitexact"}  # no random track number, no version: the same frames make the same file


def check_video(path: AnyPath, fps: float, overwrite: bool) -> None:
    """Refuse a video that cannot be written, before any work.

    Raises:
        OutputError: it exists and `overwrite` is false, or its suffix is not .webm or .mp4.
        UsageError: `fps` is out of range.
    """
    if Path(path).suffix.lower() not in CODECS:
        raise OutputError(path, f"name a {' or '.join(CODECS)} file, or frames such as name.####.png")
    if not 0 < fps <= MOST_FPS:
        raise UsageError("fps", f"must be above 0 and at most {MOST_FPS}, got {fps:g}")
    check_output(path, overwrite)


def write_video(path: AnyPath, frames: Iterable[Float[Tensor, "h w 3"]], fps: float, overwrite: bool = False) -> None:
    """Write a video of at least one frame; errors as in `check_video`, and OutputError if it cannot be written."""
    check_video(path, fps, overwrite)
    import av  # it loads FFmpeg
    from av.error import FFmpegError
    from av.video.reformatter import ColorRange, Colorspace

    # converted to BT.709 with rounding, as the file declares: players then show white as white
    range_and_matrix = {"dst_color_range": ColorRange.MPEG, "dst_colorspace": Colorspace.ITU709}
    suffix, stream = Path(path).suffix.lower(), None
    with replacing_file(path, overwrite, suffix) as temporary:
        try:
            with av.open(str(temporary), "w", options=BIT_EXACT) as container:
                for frame in frames:
                    pixels = levels(checked_image(frame), 8).byte().cpu().numpy()
                    height, width, _ = pixels.shape
                    pixels = np.pad(pixels, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
                    height, width, _ = pixels.shape
                    stream = stream or _added_stream(container, suffix, width, height, fps)
                    if (stream.width, stream.height) != (width, height):
                        size = f"{width}x{height} px after one of {stream.width}x{stream.height} px"
                        raise UsageError("frames", f"should all have one size; one has {size}")
                    picture = av.VideoFrame.from_ndarray(pixels, format="rgb24")
                    container.mux(stream.encode(picture.reformat(format=PIXEL_FORMAT, **range_and_matrix)))
                if stream is None:
                    raise UsageError("frames", "has none; a video needs one at least")
                container.mux(stream.encode())
        except FFmpegError as error:
            raise OSError(error.errno, error.strerror) from error


def _added_stream(container: "OutputContainer", suffix: str, width: int, height: int, fps: float) -> "VideoStream":
    name, settings = CODECS[suffix]
    if min(width, height) < SMALL_FRAME:
        settings = settings | SMALL_SETTINGS.get(suffix, {})
    rate = Fraction(fps).limit_denominator(MAX_DENOMINATOR)
    stream = cast("VideoStream", container.add_stream(name, rate, options=settings))
    stream.width, stream.height, stream.pix_fmt = width, height, PIXEL_FORMAT
    colours = stream.codec_context
    colours.color_range, colours.colorspace = MPEG_RANGE, BT709
    colours.color_primaries = colours.color_trc = BT709
    return stream
