"""aaplug compare: scenes against the first of them."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

import aaplug
from aaplug.core.errors import UsageError
from aaplug.options.base import UNSET, Options, number
from aaplug.options.compare import CompareOptions

from .console import TERMINAL, out, print_json, say
from .main import FAILED
from .options import CameraOptions, FileOptions, Flat, flag


@dataclass(frozen=True)
class ScenesOptions(FileOptions):
    """The scenes."""

    scenes: Annotated[tuple[Path, ...], tyro.conf.Positional, flag("SCENE SCENE [SCENE ...]")] = ()
    """Two or more scenes of any format, or their folders; the first is what the others are held to."""
    reference: Annotated[Path | None, flag("SCENE")] = None
    """The scene that the others are held to, instead of the first."""

    @property
    def paths(self) -> list[Path]:
        """What the user named, the reference first."""
        if self.reference is None:
            return list(self.scenes)
        return [self.reference, *(path for path in self.scenes if path != self.reference)]


@dataclass(frozen=True)
class GuardOptions(Options):
    """A guard for pipelines."""

    fail_under: Annotated[float | None, number(0, 200, unit="dB"), UNSET] = None
    """Exit with 1 if the mean PSNR of a scene at any scale is below so many dB: --fail-under 40dB."""


@dataclass(frozen=True)
class Compare:
    """What compression, conversion, pruning or training again cost: scenes against the first of them, at every size."""

    scenes: Annotated[ScenesOptions, Flat] = field(default_factory=ScenesOptions)
    cameras: CameraOptions = field(default_factory=CameraOptions)
    output: Annotated[Path | None, flag("FOLDER", "-o")] = None
    """Folder for compare.json, compare.csv, report.html and contact-sheet.png."""
    how: Annotated[CompareOptions, Flat] = field(default_factory=CompareOptions)
    guard: Annotated[GuardOptions, Flat] = field(default_factory=GuardOptions)
    json: bool = False
    """Print compare.json on stdout instead of the tables."""

    def __call__(self) -> int:
        """Compare, and guard."""
        paths = self.scenes.paths
        if len(paths) < 2:
            raise UsageError("compare", f"needs two scenes or more, got {len(paths)}: aaplug compare A.ply B.spz")
        from aaplug.verbs.compare import check_compared

        check_compared(self.output, self.how)  # before anything is read
        cameras = self.cameras.read(paths[0])
        opened = [self.scenes.opened(path) for path in paths]
        own = {"drop_bad": self.scenes.drop_bad, "monitor": TERMINAL}
        found = aaplug.compare(opened, cameras, self.output, **vars(self.how) | own)
        if self.json:
            print_json(found.summary())
        else:
            out.print(*found.tables())
        least, value = self.guard.fail_under, found.lowest
        if least is not None and value.value < least:
            say(f"{value.scene} at {value.scale:g}: mean PSNR {value.value:.2f} dB is below {least:g} dB")
            return FAILED
        return 0
