"""Photos of cameras, found by name and never outside their dataset's folder; and names of views.

Functions raise FormatError for names that lead out of the dataset or are there twice and for a folder that may not be
looked into, and UsageError for a folder that the user chose in vain.
"""

import os
import re
import stat
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path, PurePosixPath, PureWindowsPath
from unicodedata import normalize

from aaplug.core.cameras import Camera, CameraSet, photographs
from aaplug.io.cameras.sets import CameraFileOptions
from aaplug.io.values import Place, visible
from aaplug.system.errors import FormatError, UsageError, listing, printable, reason

CAMERA_FILE = re.compile(  # of any format
    r"(dataparser_)?transforms.*\.json|(cameras|metadata)\.json|cfg_args|poses_bounds\.npy|(cameras|images|points3D)\..*"
)
MASKS = "masks"  # a folder beside those of photos
PHOTO_FOLDERS = (re.compile("train|test|val"), re.compile(r"images(_\d+)?"))  # that data sets have beside each other
READ_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp")
MASKED = "masks are not read: metrics count every pixel of the photos"
SUFFIXES = (*READ_SUFFIXES, ".exr")  # of image files


@dataclass(frozen=True)
class PhotoFolder:
    """A folder of photos.

    home: the folder that no path may leave, even by a link.
    chosen: true if the user named the folder.
    """

    folder: Path
    home: Path
    chosen: bool = False

    def find(self, name: str, place: Place) -> Path | None:
        """The photo of that name, or of that name with another suffix or spelling, if there is one."""
        _refuse_escape(name, place)
        suffixes = (*READ_SUFFIXES, *map(str.upper, READ_SUFFIXES))
        tries = (name, *(without_suffix(name) + suffix for suffix in suffixes))
        # some systems and archives write an accent as a letter of its own, or together with its letter
        spelt = dict.fromkeys((*tries, *(normalize(form, each) for each in tries for form in ("NFC", "NFD"))))
        photo = next((path for path in (self.folder / each for each in spelt) if _is_file(path)), None)
        if photo is None:
            return None
        try:
            inside = photo.resolve().is_relative_to(self.home.resolve())
        except (OSError, RuntimeError):  # a loop of links
            inside = False
        if not inside:
            other = "" if self.folder == self.home else "pass `images` to allow another folder, or "
            hint = f"{other}where a link leads there, copy it, or link the whole data set"
            raise place.error(f"photo {name!r} lies outside {self.home}; {hint}")
        return photo

    def check(self, cameras: Sequence[Camera]) -> None:
        """Raise UsageError where the user named the folder and no camera has its photo there."""
        if self.chosen and not photographs(cameras):
            names = listing([camera.name for camera in cameras], most=3)
            raise UsageError("images", f"{self.folder} holds no photo of these cameras ({names})")

    def notes(self, cameras: Sequence[Camera]) -> list[str]:
        """Notes where no camera has its photo although there are folders of photos, or where there are masks."""
        beside = visible(self.folder.parent)
        others = [path.name for path in beside if PHOTO_FOLDERS[1].fullmatch(path.name) and path != self.folder]
        notes = [MASKED] if any(path.name == MASKS for path in beside) else []
        if photographs(cameras) or not (others or self.folder in beside):
            return notes
        hint = "`images` names another folder" + (f", such as {listing(others)}" if others else "")
        return [f"photos: {self.folder.name} holds none of these cameras' ({cameras[0].name}); {hint}", *notes]


def photo_folder(root: Path, options: CameraFileOptions, custom: str, place: Place) -> PhotoFolder:
    """The folder that the user chose, or else `custom`: what the files name, or the format's usual one."""
    if options.images is None:
        _refuse_escape(custom, place)
        return PhotoFolder(root / custom, root)
    folder = root / options.images
    if not os.path.isdir(folder):
        raise UsageError("images", f"there is no folder {folder}: relative paths start at the cameras' folder")
    return PhotoFolder(folder, folder, chosen=True)


def files_of(path: Path, cameras: CameraSet) -> tuple[Path, ...]:
    """The files that these cameras may have been read from, and all photographs of their data set."""
    home = path if path.is_dir() else path.parent
    photos = photographs(cameras.all)
    files = [path, *photos]
    for folder in (home, home / "sparse", home / "sparse" / "0", home / "0"):
        files += [file for file in visible(folder) if CAMERA_FILE.fullmatch(file.name)]
    for folder, names in product({photo.parent for photo in photos}, PHOTO_FOLDERS):
        for each in visible(folder.parent) if names.fullmatch(folder.name) else ():
            if names.fullmatch(each.name):
                files += [file for file in visible(each) if file.suffix.lower() in SUFFIXES]
    return tuple(dict.fromkeys(files))


def _is_file(path: Path) -> bool:
    """As `os.path.isfile`, but raises FormatError for a folder that may not be looked into."""
    try:
        return stat.S_ISREG(os.stat(path).st_mode)
    except PermissionError as error:
        raise FormatError(path.parent, f"cannot be looked into: {reason(error)}") from error
    except (OSError, ValueError):
        return False


def without_suffix(name: str) -> str:
    """A name without an image suffix; other dots belong to the name."""
    path = PurePosixPath(name)
    return str(path.with_suffix("")) if path.suffix.lower() in SUFFIXES else name


def last_part(name: str) -> str:
    """A name without its folders and without an image suffix."""
    return without_suffix(PurePosixPath(name).name)


def distinct(file: Path, names: Sequence[str], forms: Sequence[Callable[[str], str]]) -> list[str]:
    """The names in the first of these forms in which no two are equal."""
    for form in forms:
        short = [form(name) for name in names]
        if len(set(short)) == len(short):
            return short
    twice = Counter(names).most_common(1)[0][0]
    raise FormatError(file, f"names should be unique, but {twice!r} is there twice")


def _refuse_escape(name: str, place: Place) -> None:
    """Apply the path rules of POSIX and Windows, so that a file is accepted or refused on every system."""
    kinds = PurePosixPath(name), PureWindowsPath(name)
    if printable(name) != name or any(kind.anchor or ".." in kind.parts for kind in kinds):
        raise place.error(f"path {name!r} should stay within the dataset: no '..', not absolute")
