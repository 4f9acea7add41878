"""Cameras from files: what kind of file it is, and which of the cameras are wanted.

A format is one module.  `sniff(path) -> bool` says whether a file or folder is of the format and
never raises; `read(path, options) -> CameraSet` reads it, at the training size, in the conventions
of `aaplug.core.cameras`, and raises FormatError or UsageError and nothing else.  A new format is one
line in `FORMATS`.
"""

import difflib
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from aaplug.core.cameras import Camera, CameraSet
from aaplug.core.errors import FormatError, UsageError, listing
from aaplug.io.cameras import blender, camera_path, colmap, inria, llff, multiscale, pinhole
from aaplug.io.cameras.options import Options

CLOSE_NAMES = 3  # names to offer for one that is unknown


@dataclass(frozen=True)
class CameraFormat:
    """One kind of file or folder that cameras come in.  sign: what it is known by, for the user."""

    sign: str
    sniff: Callable[[Path], bool]
    read: Callable[[Path, Options], CameraSet]


FORMATS = (  # the first that fits is taken
    CameraFormat("a JSON file with world_to_camera", pinhole.sniff, pinhole.read),
    CameraFormat("a JSON file with camera_path (nerfstudio)", camera_path.sniff, camera_path.read),
    CameraFormat("cameras.json with cfg_args (INRIA)", inria.sniff_model, inria.read),
    CameraFormat("sparse/0 or sparse (COLMAP)", colmap.sniff, colmap.read),
    CameraFormat("transforms_train.json (Blender)", blender.sniff_split, blender.read_split),
    CameraFormat("cameras.json (INRIA)", inria.sniff, inria.read),
    CameraFormat("metadata.json (multi-scale Blender)", multiscale.sniff, multiscale.read),
    CameraFormat("transforms.json (nerfstudio, instant-ngp)", blender.sniff, blender.read),
    CameraFormat("poses_bounds.npy (LLFF)", llff.sniff, llff.read),
)


def read_cameras(
    path: Path,
    *,
    train_scale: float | None = None,
    images: str | None = None,
    test_every: int | None = None,
) -> CameraSet:
    """The cameras of a file or folder at their training size.

    train_scale: training size over the source's, overrides what the files say.  images: the folder
    of the photos, relative to the dataset's root.  test_every: every n-th by name is a test view, 0
    for no split.

    Raises:
        FormatError: there are no cameras, or a file is not what it should be.
        UsageError: an option does not fit.
    """
    options = Options(train_scale, images, test_every)
    if not os.path.exists(path):
        raise FormatError(path, "there is no such file or folder")
    for kind in FORMATS:
        if kind.sniff(path):
            return kind.read(path, options)
    signs = "; ".join(kind.sign for kind in FORMATS)
    raise FormatError(path, f"holds no cameras of a known format; looked for: {signs}")


def select_views(cameras: CameraSet, spec: str) -> tuple[Camera, ...]:
    """The views that `spec` asks for: train, test, all, or names with commas between.

    A name that both splits use means the test view.

    Raises:
        UsageError: a name is unknown.
    """
    groups = {"train": cameras.train, "test": cameras.test, "all": cameras.all}
    if spec in groups:
        return groups[spec]
    known = {camera.name: camera for camera in (*cameras.train, *cameras.test)}
    if spec in known:  # a name may itself hold a comma
        return (known[spec],)
    names = dict.fromkeys(name.strip() for name in spec.split(","))
    return tuple(known[name] if name in known else _unknown(name, list(known)) for name in names)


def _unknown(name: str, known: list[str]) -> Camera:
    close = difflib.get_close_matches(name, known, CLOSE_NAMES, cutoff=0) if name else known
    raise UsageError(
        "--views",
        f"there is no view {name!r}; train, test, all or names such as {listing(close, 3)}",
    )
