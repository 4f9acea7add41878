"""Cameras from files.

A camera format is a module or object like the `CameraFormat` below.  aaplug's own are in `OWN`; a plug-in adds one by
an entry point in the group "aaplug.camera_formats" (`system.registry`).  `read_cameras` takes the first format whose
`sniff` accepts the path: plug-ins first, as they may read a dialect of a file that an own format would accept too.
"""

import difflib
import os
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Annotated, Protocol, runtime_checkable

from aaplug.core.cameras import Camera, CameraSet
from aaplug.io.cameras import (
    camera_path,
    colmap,
    gltf,
    inria,
    lichtfeld,
    llff,
    multiscale,
    pinhole,
    sharp,
    supersplat,
    transforms,
    usd,
)
from aaplug.io.cameras.camera_path import CameraPath
from aaplug.io.cameras.photos import files_of, without_suffix
from aaplug.io.cameras.sets import CameraFileOptions
from aaplug.system.contracts import Range, contract
from aaplug.system.errors import FormatError, PlugInError, UsageError, listing
from aaplug.system.plug_ins import asked
from aaplug.system.registry import Registry, named

CLOSE_NAMES = 3  # names suggested for an unknown one


@runtime_checkable
class CameraFormat(Protocol):
    """One kind of file or folder that holds cameras.

    name: unique.
    sign: what the format is recognized by, for the error that lists all formats.
    """

    @property
    def name(self) -> str: ...  # noqa: D102

    @property
    def sign(self) -> str: ...  # noqa: D102

    def sniff(self, path: Path) -> bool:
        """True if a file or folder is of this format.  Never raises."""
        ...

    def read(self, path: Path, options: CameraFileOptions) -> CameraSet:
        """The cameras at their training size, with the axes and pixel centres of `aaplug.core.cameras`.

        Raises:
            FormatError: the file breaks its format.
            UsageError: an option does not fit.
        """
        ...


OWN: tuple[CameraFormat, ...]
OWN = (pinhole, camera_path, inria.Model(), colmap, transforms.Blender(), inria, multiscale, transforms, llff, sharp)
PATH_FORMATS = (camera_path, supersplat, lichtfeld, gltf, usd)
CAMERA_FORMATS = Registry[CameraFormat]("camera format", "aaplug.io.cameras:CameraFormat", named(OWN))


@contract
def read_cameras(
    path: str | PathLike[str],
    *,
    train_scale: float | None = None,
    images: str | None = None,
    test_every: int | None = None,
    undistort: bool = False,
) -> CameraSet:
    """Read the cameras of a file or folder at their training size.

    Args:
        path: a file or folder of any format in `CAMERA_FORMATS`.
        train_scale: training size over the size in the files; overrides what the files say.
        images: the folder of the photos, relative to the dataset's root.
        test_every: every n-th view by name is a test view; 0 for no split.
        undistort: straighten photographs whose lens distorts, and draw the pinhole that sees the same.

    Raises:
        FormatError: there are no cameras, or a file breaks its format.
        UsageError: an option does not fit.
    """
    cameras = _read(path, CameraFileOptions(train_scale, images, test_every, undistort))
    if cameras is not None:
        return cameras
    path = Path(path)
    if any(format.sniff(path) for format in PATH_FORMATS):
        raise FormatError(path, "is of a format of camera paths, which `path` of render and video takes")
    signs = "; ".join(format.sign for format in CAMERA_FORMATS.values())
    raise FormatError(path, f"holds no cameras of a known format; looked for: {signs}")


@contract
def read_camera_path(path: str | PathLike[str], *, fps: Annotated[float, Range(above=0)] | None = None) -> CameraPath:
    """Read the cameras of a path in order: of a path file, or of any file or folder that `read_cameras` takes.

    fps: frames per second that keyframes are sampled at, where the file has some; None for the file's own rate.

    Raises:
        FormatError: there are no cameras, or a file breaks its format.
        UsageError: a package is missing.
    """
    for format in PATH_FORMATS:
        if format.sniff(Path(path)):
            with of_file(path):
                return format.path_of(Path(path), fps)
    try:
        cameras = _read(path, CameraFileOptions(test_every=0))
    except UsageError:  # of files that give the split: training views, then test views
        cameras = _read(path, CameraFileOptions())
    if cameras is None:
        raise FormatError(path, "holds no camera path of a known format; `aaplug guide film-camera` lists them")
    return CameraPath(tuple(replace(view, trained_focal=None, photo=None, undistortion=None) for view in cameras.all))


def _read(path: str | PathLike[str], options: CameraFileOptions) -> CameraSet | None:
    """The cameras of a file or folder; None if no format recognizes it.  Raises as `read_cameras`."""
    if not os.path.exists(path):
        raise FormatError(path, "there is no such file or folder")
    path = Path(path)
    with of_file(path):
        if not (found := recognized(path)):
            return None
        cameras = asked("camera format", found[0], "read", path, options)
    if not cameras.train:
        raise FormatError(path, "holds no training cameras")
    others = [each.sign for each in found if path.is_dir() and each.read != found[0].read]
    more = [f"other cameras in the folder, not read: {'; '.join(others)}"] if others else []
    return replace(cameras, files=files_of(path, cameras), notes=(*cameras.notes, *more))


def recognized(path: str | PathLike[str]) -> list[CameraFormat]:
    """The formats that recognize cameras at this path, plug-ins first."""
    formats = sorted(CAMERA_FORMATS.values(), key=OWN.__contains__)
    return [each for each in formats if asked("camera format", each, "sniff", Path(path))]


@contextmanager
def of_file(path: str | PathLike[str]) -> Iterator[None]:
    """A block in which an error about a camera's own values is one of this file."""
    try:
        yield
    except UsageError as error:
        value = error.__cause__ if isinstance(error, PlugInError) else error
        if not isinstance(value, UsageError) or not value.where.startswith("camera "):  # but an option
            raise
        raise FormatError(path, str(value)) from error


def select_views(cameras: CameraSet, spec: str, option: str = "views") -> tuple[Camera, ...]:
    """The views named by `spec`: train, test, all, or view names separated by commas.

    option: that `spec` is of, for errors.
    A name in both splits means the test view.  An unknown name, or a split without views, raises UsageError.
    """
    groups = {"train": cameras.train, "test": cameras.test, "all": cameras.all}
    if spec in groups:
        if not groups[spec]:
            raise UsageError(option, f"{spec} has no views; the cameras have {len(cameras.all)} in all")
        return groups[spec]
    known = {camera.name: camera for camera in (*cameras.train, *cameras.test)}
    return tuple(known[name] for name in view_names(known, spec, option, "train, test, all or names"))


def view_names(known: Collection[str], spec: str, option: str, takes: str) -> list[str]:
    """Those of the known names that `spec` lists between commas, each once; `r_0.png`, of a photograph, is `r_0`.

    option: that `spec` is of, and what it takes, for the UsageError of an unknown name.
    """
    if spec in known:  # a name may itself hold a comma
        return [spec]
    words = [*filter(None, map(str.strip, spec.split(",")))] or [spec]
    names = dict.fromkeys(word if word in known else without_suffix(word) for word in words)
    for name in (name for name in names if name not in known):
        close = difflib.get_close_matches(name, known, CLOSE_NAMES, cutoff=0) if name else list(known)
        raise UsageError(option, f"there is no view {name!r}; {takes} such as {listing(close, 3)}")
    return [*names]
