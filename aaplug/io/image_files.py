"""Files of drawn views, one for each: how they are named, and which exist; checked before any work."""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unicodedata import normalize

from aaplug.core.cameras import Camera
from aaplug.io.atomic import check_output, refuse_existing, write_file
from aaplug.io.image_formats import IMAGE_FORMATS
from aaplug.io.video import CODECS
from aaplug.system.digests import check_request
from aaplug.system.errors import START_AGAIN, FormatError, OutputError, counted, listing

SUFFIXES = [suffix for each in IMAGE_FORMATS.values() for suffix in each.suffixes]
IMAGES = (*SUFFIXES, ".tif", ".tiff", ".bmp", ".gif", *CODECS)  # any other name is a folder
DEVICE = re.compile("con|prn|aux|nul|(com|lpt)[0-9¹²³]", re.IGNORECASE)  # no file on Windows, whatever its suffix
PLACES, SEVERAL = re.compile("#+"), "##"  # of a frame's number in a name; one # may be part of a name
SEPARATORS = "._-"  # between it and the rest
USUAL_NAME = "frame.####"  # in a folder
LONGEST_NAME = 200  # bytes to which names are cut; file systems take 255, and a number and a suffix are added


def names_image(output: Path) -> bool:
    """True if a name is that of one image, not of a folder."""
    return output.suffix.lower() in IMAGES


def image_paths(output: Path, views: Sequence[Camera], overwrite: bool, suffix: str = ".png") -> list[Path]:
    """One file per view in the folder `output`, or `output` itself if it names one image; raises OutputError."""
    if SEVERAL in output.name:
        raise OutputError(output, "names a frame sequence, which `video` writes; name a folder, or one image")
    if names_image(output):
        if output.suffix.lower() not in SUFFIXES or len(views) != 1:
            one = f"one {', '.join(SUFFIXES)} for one image"
            raise OutputError(output, f"name a folder, or {one} ({counted(len(views), 'image')} asked for)")
        check_output(output, overwrite)
        return [output]
    paths = [output / f"{name}{suffix}" for name in file_names([view.name for view in views], "view", 5)]
    refuse_existing(paths, overwrite)
    return paths


def file_names(names: Sequence[str], nameless: str, digits: int) -> list[str]:
    """Names fit for files on any system; all are numbered where two would be the same on one."""
    slugs = [re.sub(r"[^\w.\-]+", "_", normalize("NFC", name)).lstrip(".") for name in names]
    slugs = [slug.encode()[:LONGEST_NAME].decode(errors="ignore").rstrip(".") or nameless for slug in slugs]
    slugs = [f"_{slug}" if DEVICE.fullmatch(slug.partition(".")[0]) else slug for slug in slugs]
    if len({slug.casefold() for slug in slugs}) < len(slugs):
        return [f"{index:0{digits}d}_{slug}" for index, slug in enumerate(slugs)]
    return slugs


@dataclass(frozen=True)
class FrameSequence:
    """The files of `count` frames, and a record beside them by which a run continues.

    A frame appears whole or not at all, so the frames that are there are done.  The record, frame.json for
    frame.####.exr, holds what was asked for.

    pattern: path of the frames, with # for the digits of a number, from `first`.
    """

    pattern: Path
    count: int = 0
    first: int = 1

    @classmethod
    def of(cls, output: Path, format: str | None) -> "FrameSequence | None":
        """The sequence that an output names, or that a format asks for in a folder; else None.

        Raises OutputError if the name has places for more than one number or is that of no format, and for places in
        a folder's name.
        """
        if not PLACES.search(output.name):
            return None if format is None or names_image(output) else cls(output / f"{USUAL_NAME}.{format}")
        if SEVERAL in str(output.parent) and not output.parent.is_dir():
            raise OutputError(output, "has a frame's number in a folder's name; give it to the file alone")
        if len(PLACES.findall(output.name)) > 1:
            raise OutputError(output, "has places for two numbers; name a sequence such as frame.####.exr")
        if output.suffix.lower() not in SUFFIXES:
            raise OutputError(output, f"name frames of one of {', '.join(SUFFIXES)}")
        return cls(output)

    @property
    def paths(self) -> list[Path]:
        """The frames' files, in order."""
        [places] = PLACES.findall(self.pattern.name)
        numbers = (f"{number:0{len(places)}d}" for number in range(self.first, self.first + self.count))
        return [self.pattern.parent / PLACES.sub(number, self.pattern.name) for number in numbers]

    @property
    def record(self) -> Path:
        """File of what was asked for."""
        name = PLACES.sub("", self.pattern.stem).strip(SEPARATORS)
        return self.pattern.parent / f"{name or 'frames'}.json"

    def check(self, overwrite: bool, resume: bool) -> None:
        """Refuse, before any work, frames that exist unless `overwrite` or `resume` is set, and further ones."""
        files = [*self.paths, self.record]
        before, after = PLACES.split(self.pattern.name)
        numbered = re.compile(rf"{re.escape(before)}\d+{re.escape(after)}", re.ASCII)
        found = sorted(p.name for p in self.pattern.parent.iterdir()) if self.pattern.parent.is_dir() else []
        further = [name for name in found if numbered.fullmatch(name) and self.pattern.parent / name not in files]
        if further:
            problem = f"holds {listing(further, most=3)} beside the {counted(self.count, 'frame')}; remove them"
            raise OutputError(self.pattern.parent, problem)
        refuse_existing(files, overwrite, resume)
        if resume and not self.record.exists() and any(path.exists() for path in self.paths):
            raise OutputError(self.record, "does not exist, which says what the frames show; pass `overwrite`")

    def begin(self, request: Mapping[str, Any], resume: bool) -> list[int]:
        """Places of the frames to draw; removes those that are there unless `resume` is set, and writes the record.

        Raises UsageError if the frames are of another request, and FormatError if the record is damaged.
        """
        now = json.loads(json.dumps(request, allow_nan=False))
        if resume and self.record.exists():
            try:
                before = dict(json.loads(self.record.read_bytes()))
            except (OSError, ValueError, TypeError) as error:
                raise FormatError(self.record, f"is damaged; {START_AGAIN}") from error
            check_request(self.record, before, now, START_AGAIN)
            return [place for place, path in enumerate(self.paths) if not path.exists()]
        for path in self.paths:
            if path.exists():
                check_output(path, True)
                path.unlink()
        write_file(self.record, json.dumps(now, indent=1).encode() + b"\n", overwrite=True)
        return list(range(self.count))
