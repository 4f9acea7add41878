"""Videos: VP9 in .webm through OpenCV, H.264 in .mp4 where PyAV is installed.

Frames are RGB float32 [height, width, 3] in [0, 1], all of one size.  Codecs need even sides: the last row or column
of an odd side is repeated, and no pixel is resampled.  A video appears whole or not at all.
"""

import importlib.util
from collections.abc import Iterable
from fractions import Fraction
from os import PathLike
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float
from torch import Tensor

from aaplug.core.errors import OutputError, UsageError
from aaplug.core.imaging import levels
from aaplug.io.atomic import check_output, replacing_file
from aaplug.io.images import captured_stderr

WEBM, MP4 = ".webm", ".mp4"
MOST_FPS = 1000


def check_video(path: str | PathLike[str], fps: float, overwrite: bool) -> None:
    """Refuse a video that cannot be written, before any work.

    Raises:
        OutputError: it exists and `overwrite` is false, has no folder, or its suffix is not .webm or .mp4.
        UsageError: its codec is not installed, or `fps` is out of range.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in (WEBM, MP4):
        raise OutputError(path, f"name a {WEBM} or {MP4} file")
    if suffix == MP4 and importlib.util.find_spec("av") is None:
        raise UsageError(str(path), f"H.264 needs PyAV: pip install 'aaplug[mp4]'; {WEBM} needs nothing")
    if not 0 < fps <= MOST_FPS:
        raise UsageError("fps", f"must be above 0 and at most {MOST_FPS}, got {fps:g}")
    check_output(path, overwrite)


def write_video(
    path: str | PathLike[str], frames: Iterable[Float[Tensor, "h w 3"]], fps: float, overwrite: bool = False
) -> None:
    """Write a video of at least one frame; errors as in `check_video`, and OutputError if it cannot be written."""
    check_video(path, fps, overwrite)
    suffix = Path(path).suffix.lower()
    write = _write_mp4 if suffix == MP4 else _write_webm
    with replacing_file(path, overwrite, suffix) as temporary:
        write(temporary, (_even(frame) for frame in frames), fps)


def _even(frame: Float[Tensor, "h w 3"]) -> np.ndarray:
    """8-bit RGB with even sides."""
    pixels = levels(frame, 8).byte().cpu().numpy()
    height, width, _ = pixels.shape
    return np.pad(pixels, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")


def _write_webm(path: Path, frames: Iterable[np.ndarray], fps: float) -> None:
    writer = None
    try:
        for frame in frames:
            if writer is None:
                code = cv2.VideoWriter.fourcc(*"VP90")
                with captured_stderr():  # FFmpeg warns about VP9's tag in WebM, which it accepts
                    size = (frame.shape[1], frame.shape[0])
                    writer = cv2.VideoWriter(str(path), code, fps, size)
                if not writer.isOpened():  # OpenCV does not raise
                    raise OSError("this build of OpenCV cannot write VP9 there")
            writer.write(np.ascontiguousarray(frame[..., ::-1]))
    finally:
        if writer is not None:
            writer.release()
    if not (path.is_file() and path.stat().st_size):
        raise OSError("the codec wrote nothing")


def _write_mp4(path: Path, frames: Iterable[np.ndarray], fps: float) -> None:
    import av  # pyright: ignore[reportMissingImports]

    with av.open(str(path), "w") as container:
        stream = None
        for frame in frames:
            if stream is None:
                stream = container.add_stream("libx264", rate=Fraction(fps).limit_denominator(1001))
                stream.height, stream.width = frame.shape[:2]
                stream.pix_fmt = "yuv420p"  # the pixel format that every player supports
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        if stream is not None:
            container.mux(stream.encode())
