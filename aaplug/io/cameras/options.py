"""What the user may say about cameras, and how a set is split into training and test views."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from aaplug.core.cameras import Camera
from aaplug.core.errors import UsageError

LLFF_HOLD = 8  # views: every 8th by name is a test view, 3DGS --eval and LLFF


@dataclass(frozen=True)
class Options:
    """What the user chose.

    train_scale: training size over source size.  images: the folder of the photos.  test_every: 0
    means no split.

    None: what the files say, or their format's custom.
    """

    train_scale: float | None = None
    images: str | None = None
    test_every: int | None = None

    def __post_init__(self) -> None:
        scale, every = self.train_scale, self.test_every
        if scale is not None and not (math.isfinite(scale) and scale > 0):
            raise UsageError("--train-scale", f"should be above 0 (1/4 is 0.25), not {scale}")
        if every is not None and (every < 0 or every == 1):
            raise UsageError("--test-every", f"should be 0 (no split), 2 or more, not {every}")


@dataclass(frozen=True)
class Split:
    """Training and test views, and a line on where the split came from."""

    train: tuple[Camera, ...]
    test: tuple[Camera, ...]
    note: str


def explicit(train: Sequence[Camera], test: Sequence[Camera], source: str) -> Split:
    """The split that the files spell out."""
    return Split(
        tuple(train), tuple(test), f"split: {len(train)} train, {len(test)} test ({source})"
    )


def undivided(cameras: Sequence[Camera], source: str) -> Split:
    """Every camera in both roles."""
    views = tuple(cameras)
    return Split(
        views, views, f"split: none, all {len(views)} cameras are train and test ({source})"
    )


def every_nth(cameras: Sequence[Camera], options: Options, custom: int, source: str) -> Split:
    """Every n-th of the cameras, in their order and from the first, is a test view.

    custom: n where `options` say nothing, for the reason `source`; 0 means no split.
    """
    n = custom
    if options.test_every is not None:
        n, source = options.test_every, f"--test-every {options.test_every}"
    if not n:
        return undivided(cameras, source)
    if len(cameras) == 1:
        return undivided(cameras, "one camera cannot be divided")
    train = [camera for index, camera in enumerate(cameras) if index % n]
    return explicit(train, cameras[::n], f"1 in {n} by name: {source}")
