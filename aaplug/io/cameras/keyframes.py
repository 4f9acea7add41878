"""Animated cameras between their keyframes, at the times of a path's frames.

n: keys.  f: frames.  Every function raises FormatError.
"""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from aaplug.core.cameras import WHOLE_SLACK, Camera, centred, numbered
from aaplug.io.cameras.poses import inverse
from aaplug.io.values import Place, focal

MAX_FRAMES = 10_000  # of a path file: 5 minutes and a half at 30 a second
FPS = 30.0  # frames per second, where the file does not say
UNSIZED = (1920, 1080)  # px: width and height, where the file does not say


def frame_times(first: float, last: float, fps: float, place: Place) -> Float[Tensor, " f"]:
    """Times of a frame at `first` and of all whole frames up to `last`, in s."""
    steps = max(0.0, (last - first) * fps)
    place.expect(steps < MAX_FRAMES, "the animation", f"at most {MAX_FRAMES:,} frames", steps)
    return first + torch.arange(math.floor(steps + WHOLE_SLACK) + 1, dtype=torch.float64) / fps


def rising(times: Float[Tensor, " n"], place: Place) -> Float[Tensor, " n"]:
    """The times of keys, which rise."""
    place.expect(bool((times.diff() > 0).all()), "times", "rising", times.tolist())
    return times


def segments(
    times: Float[Tensor, " n"], at: Float[Tensor, " f"]
) -> tuple[Int[Tensor, " f"], Int[Tensor, " f"], Float[Tensor, " f"]]:
    """The keys before and after each time, and the share of the way between them; beyond the ends, the end."""
    if len(times) == 1:
        return torch.zeros(len(at), dtype=torch.int64), torch.zeros(len(at), dtype=torch.int64), torch.zeros_like(at)
    index = (torch.searchsorted(times, at, right=True) - 1).clamp(0, len(times) - 2)
    return index, index + 1, ((at - times[index]) / (times[index + 1] - times[index])).clamp(0.0, 1.0)


def hermite(
    start: Float[Tensor, "f c"],
    out: Float[Tensor, "f c"],
    into: Float[Tensor, "f c"],
    end: Float[Tensor, "f c"],
    share: Float[Tensor, " f"],
) -> Float[Tensor, "f c"]:
    """The cubic from `start` to `end`; out, into: its slopes there, per share (Hermite)."""
    s = share[:, None]
    bend = s * (1 - s)
    return start + s * s * (3 - 2 * s) * (end - start) + bend * ((1 - s) * out - s * into)


def slerp(first: Float[Tensor, "f 4"], last: Float[Tensor, "f 4"], share: Float[Tensor, " f"]) -> Float[Tensor, "f 4"]:
    """Unit quaternions xyzw on the shorter way between unit quaternions xyzw (Shoemake 1985)."""
    from scipy.spatial.transform import Rotation  # takes a third of a second to import

    start = Rotation.from_quat(first.numpy())
    way = (start.inv() * Rotation.from_quat(last.numpy())).as_rotvec()
    return torch.from_numpy((start * Rotation.from_rotvec(share[:, None].numpy() * way)).as_quat())


def cameras_of(
    world_from_cam: Float[Tensor, "f 4 4"], focals: Float[Tensor, " f"], place: Place, size: tuple[int, int] = UNSIZED
) -> tuple[Camera, ...]:
    """Cameras named by number.  world_from_cam: rigid, OpenCV axes.  focals: focal lengths, in px."""
    rows = zip(numbered(len(focals)), world_from_cam, focals.tolist(), strict=True)
    return tuple(centred(name, size, focal(f, place, "the focal length"), inverse(pose)) for name, pose, f in rows)
