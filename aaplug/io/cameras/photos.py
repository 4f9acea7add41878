"""Photos of cameras: found without ever leaving their dataset, and what their sizes say.

Sizes are (width, height), in px.
"""

import os
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath, PureWindowsPath

from aaplug.core.cameras import Camera
from aaplug.core.errors import FormatError, UsageError, listing
from aaplug.io.images import image_size
from aaplug.io.limits import whole_limit
from aaplug.io.values import Place

COMMON = (".png", ".jpg", ".jpeg", ".PNG", ".JPG", ".JPEG")  # tried for names without a suffix
SUFFIXES = (*COMMON, ".webp", ".tif", ".tiff", ".bmp", ".exr")  # what counts as one
SAME_SHAPE = 0.01  # how far rounding may take a small photo's aspect from its camera's

Size = tuple[int, int]


@dataclass(frozen=True)
class PhotoFolder:
    """Where photos lie.

    home: what no path may leave, links included.  chosen: whether the user named the folder.
    """

    folder: Path
    home: Path
    chosen: bool = False

    def find(self, name: str, place: Place) -> Path | None:
        """The photo of that name, with or without its suffix, if there is one.

        Raises:
            FormatError: the name or a link leads out of `home`.
        """
        _refuse_escape(name, place)
        bare = without_suffix(name)
        tries = (name, *(bare + suffix for suffix in COMMON))
        found = next((p for p in (self.folder / t for t in tries) if os.path.isfile(p)), None)
        if found is not None and not _within(found, self.home):
            raise place.error(
                f"photo {name!r} lies outside {self.home}; --images FOLDER allows another folder"
            )
        return found


def photo_folder(root: Path, chosen: str | None, custom: str, place: Place) -> PhotoFolder:
    """The folder that the user chose, else the one that the files name or that is the custom.

    Raises:
        UsageError: the user chose a folder that does not exist.
        FormatError: the files name one outside `root`.
    """
    if chosen is None:
        _refuse_escape(custom, place)
        return PhotoFolder(root / custom, root)
    folder = root / chosen
    if not os.path.isdir(folder):
        raise UsageError("--images", f"there is no folder {folder}")
    return PhotoFolder(folder, folder, chosen=True)


def refuse_folder(chosen: str | None) -> None:
    """Formats that name each photo's path have no use for a folder of photos.

    Raises:
        UsageError: one was chosen.
    """
    if chosen is not None:
        raise UsageError(
            "--images", "this format gives each photo's path itself; leave the option out"
        )


def with_photos(
    cameras: Sequence[Camera], places: Sequence[Place], folder: PhotoFolder
) -> list[Camera]:
    """The cameras, each with its photo where there is one.

    Raises:
        UsageError: the user chose a folder that holds none of them.
        FormatError: a name leads out of the dataset.
    """
    found = [
        replace(camera, photo=folder.find(camera.name, place))
        for camera, place in zip(cameras, places, strict=True)
    ]
    if folder.chosen and not any(camera.photo for camera in found):
        names = listing([camera.name for camera in cameras], most=3)
        raise UsageError("--images", f"{folder.folder} holds no photo of these cameras ({names})")
    return found


def photo_sizes(cameras: Sequence[Camera]) -> list[Size]:
    """Each photo's size; a camera without one shrinks like the first that has one.

    Raises:
        FormatError: a photo cannot be read or has another shape than its camera.
    """
    known = [_size(camera) for camera in cameras]
    rate = next((s[0] / c.width for s, c in zip(known, cameras, strict=True) if s), 1.0)
    return [size or scaled(camera, rate) for size, camera in zip(known, cameras, strict=True)]


def scaled_sizes(cameras: Sequence[Camera], scale: float) -> list[Size]:
    """Each camera's size times the user's `scale`, rounded.

    Raises:
        UsageError: that is more than an image can have.
    """
    sizes = [scaled(camera, scale) for camera in cameras]
    most = whole_limit("CAMERA_SIDE")
    if max(map(max, sizes)) > most:
        raise UsageError("--train-scale", f"makes an image of more than {most} px a side")
    return sizes


def scaled(camera: Camera, scale: float) -> Size:
    """The camera's size times `scale`, rounded."""
    return max(1, round(camera.width * scale)), max(1, round(camera.height * scale))


def trained_at(cameras: Sequence[Camera], sizes: Sequence[Size]) -> list[Camera]:
    """The cameras with an unchanged field of view at the sizes that they were trained at."""
    return [c.resized(*size).as_trained() for c, size in zip(cameras, sizes, strict=True)]


def described_sizes(cameras: Sequence[Camera]) -> str:
    """The cameras' sizes, for a note."""
    sizes = sorted({(c.width, c.height) for c in cameras}, key=lambda s: (s[0] * s[1], s))
    shown = [f"{width}×{height}" for width, height in sizes]
    return f"{shown[0]} px" if len(shown) == 1 else f"{shown[0]} to {shown[-1]} px"


def without_suffix(name: str) -> str:
    """A name without the suffix of an image format; other dots belong to the name."""
    path = PurePosixPath(name)
    return str(path.with_suffix("")) if path.suffix.lower() in SUFFIXES else name


def last_part(name: str) -> str:
    """A name without its folders and without the suffix of an image format."""
    return without_suffix(PurePosixPath(name).name)


def whole(name: str) -> str:
    """The name as it stands."""
    return name


def distinct(file: Path, names: Sequence[str], forms: Sequence[Callable[[str], str]]) -> list[str]:
    """The names in the first form that keeps them apart.

    Raises:
        FormatError: no form does, as a name is there twice.
    """
    for form in forms:
        short = [form(name) for name in names]
        if len(set(short)) == len(short):
            return short
    twice = Counter(names).most_common(1)[0][0]
    raise FormatError(file, f"names should be unique, but {twice!r} is there twice")


def _size(camera: Camera) -> Size | None:
    if camera.photo is None:
        return None
    width, height = image_size(camera.photo)
    expected = camera.height * width / camera.width
    if abs(height - expected) > 1 + SAME_SHAPE * expected:
        raise FormatError(
            camera.photo,
            f"is {width}×{height} px, which is not the shape of its camera "
            f"({camera.width}×{camera.height} px); is it the wrong folder, or is the photo turned?",
        )
    return width, height


def _refuse_escape(name: str, place: Place) -> None:
    """Both systems' rules hold, so that a file means the same thing everywhere."""
    kinds = PurePosixPath(name), PureWindowsPath(name)
    if not name.isprintable() or any(kind.anchor or ".." in kind.parts for kind in kinds):
        raise place.error(f"path {name!r} should stay within the dataset: no '..', not absolute")


def _within(path: Path, home: Path) -> bool:
    try:
        return path.resolve().is_relative_to(home.resolve())
    except (OSError, RuntimeError):  # links in a circle
        return False
