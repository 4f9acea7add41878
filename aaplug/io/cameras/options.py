"""Options for reading cameras, and the split into training and test views."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from aaplug.core.cameras import Camera
from aaplug.core.errors import UsageError

LLFF_HOLD = 8  # every 8th view by name is a test view: LLFF, 3DGS --eval


@dataclass(frozen=True)
class Options:
    """The user's choices; None means what the files say, or else the format's custom.

    train_scale: training size over the size in the files.
    images: the folder of the photos.
    test_every: every n-th view is a test view; 0 for no split.
    """

    train_scale: float | None = None
    images: str | None = None
    test_every: int | None = None

    def __post_init__(self) -> None:
        scale, every = self.train_scale, self.test_every
        if scale is not None and not (math.isfinite(scale) and scale > 0):
            raise UsageError("train_scale", f"should be above 0 (1/4 is 0.25), not {scale}")
        if every is not None and (every < 0 or every == 1):
            raise UsageError("test_every", f"should be 0 (no split), 2 or more, not {every}")


@dataclass(frozen=True)
class Split:
    """Training and test views, and a note on where the split came from."""

    train: tuple[Camera, ...]
    test: tuple[Camera, ...]
    note: str


def explicit(train: Sequence[Camera], test: Sequence[Camera], source: str) -> Split:
    """A split that the files give."""
    return Split(tuple(train), tuple(test), f"split: {len(train)} train, {len(test)} test ({source})")


def undivided(cameras: Sequence[Camera], source: str) -> Split:
    """No split: every camera is both a training and a test view."""
    views = tuple(cameras)
    return Split(views, views, f"split: none, all {len(views)} cameras are train and test ({source})")


def every_nth(cameras: Sequence[Camera], options: Options, custom: int, source: str) -> Split:
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
