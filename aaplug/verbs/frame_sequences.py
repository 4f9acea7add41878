"""Frame sequences: an image file a frame, named by its number, and a record by which a run continues.

A frame appears whole or not at all, so the frames that are there are done.  The record beside them, frame.json for
frame.####.exr, holds what was asked for.
"""

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from aaplug.evaluation.journal import check_request
from aaplug.io.atomic import check_output, refuse_existing, write_file
from aaplug.system.errors import START_AGAIN, FormatError, OutputError, UsageError, counted, listing
from aaplug.verbs.verb import RESUME_OR_OVERWRITE
from aaplug.verbs.views import SUFFIXES, names_image

PLACES = re.compile("#+")  # of a frame's number in a name
SEPARATORS = "._-"  # between it and the rest
USUAL_NAME = "frame.####"  # in a folder


@dataclass(frozen=True)
class FrameSequence:
    """The files of `count` frames.  pattern: their path, with # for the digits of a number, from `first`."""

    pattern: Path
    count: int = 0
    first: int = 1

    @classmethod
    def of(cls, output: Path, format: str | None) -> "FrameSequence | None":
        """The sequence that an output names, or that a format asks for in a folder; else None.

        Raises OutputError if the name has places for more than one number, or is that of no format.
        """
        if not PLACES.search(output.name):
            return None if format is None or names_image(output) else cls(output / f"{USUAL_NAME}.{format}")
        if len(PLACES.findall(output.name)) > 1:
            raise OutputError(output, "has places for two numbers; name a sequence such as frame.####.exr")
        if output.suffix.lower() not in SUFFIXES:
            raise OutputError(output, f"name frames of one of {', '.join(SUFFIXES)}")
        return cls(output)

    @property
    def folder(self) -> Path:
        """Folder of the frames."""
        return self.pattern.parent

    @property
    def paths(self) -> list[Path]:
        """The frames' files, in order."""
        [places] = PLACES.findall(self.pattern.name)
        numbers = (f"{number:0{len(places)}d}" for number in range(self.first, self.first + self.count))
        return [self.folder / PLACES.sub(number, self.pattern.name) for number in numbers]

    @property
    def record(self) -> Path:
        """File of what was asked for."""
        name = PLACES.sub("", self.pattern.stem).strip(SEPARATORS)
        return self.folder / f"{name or 'frames'}.json"

    def check(self, overwrite: bool, resume: bool) -> None:
        """Refuse, before any work, frames that exist unless `overwrite` or `resume` is set, and further ones."""
        if resume and overwrite:
            raise UsageError("resume", RESUME_OR_OVERWRITE)
        files = [*self.paths, self.record]
        before, after = PLACES.split(self.pattern.name)
        numbered = re.compile(rf"{re.escape(before)}\d+{re.escape(after)}", re.ASCII)
        found = sorted(p.name for p in self.folder.iterdir()) if self.folder.is_dir() else []
        further = [name for name in found if numbered.fullmatch(name) and self.folder / name not in files]
        if further:
            problem = f"holds {listing(further, most=3)} beside the {counted(self.count, 'frame')}; remove them"
            raise OutputError(self.folder, problem)
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
