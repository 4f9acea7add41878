"""Options that several verbs share, and reading what they name.

The options that the library's verbs have too are stated in `aaplug.options`.  What is read is imported when it is read,
so that help and mistakes take no torch.
"""

import re
from collections.abc import Collection, Iterator
from contextlib import contextmanager, redirect_stderr
from dataclasses import dataclass, field, fields
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast, get_args, get_type_hints

import tyro

import aaplug
from aaplug.core.choices import ConventionName, SpzAxes
from aaplug.core.errors import UsageError
from aaplug.options.base import UNSET, OneOf, Options, flag, number
from aaplug.options.orbit import OrbitOptions
from aaplug.options.shared import SCALE

from .console import TERMINAL, say

if TYPE_CHECKING:
    from aaplug.io.scenes.scene_file import SceneFile
    from aaplug.verbs.inputs import Held

CONFIG = (tyro.conf.OmitArgPrefixes, tyro.conf.FlagCreatePairsOff)  # how classes become options


def worded(text: str, names: Collection[str]) -> str:
    """The library's text with parameters as options: min_seen or `min_seen` becomes --min-seen."""

    def option(match: re.Match[str]) -> str:
        name = match[1] or match[2]
        if name not in names:
            return match[0]
        return "SCENE" if name == "scene" else "--" + name.replace("_", "-")

    return re.sub(r"`(\w+)`|\b([a-z]+(?:_[a-z]+)+)\b", option, text)


_CONVENTIONS = get_args(ConventionName)
Flat = tyro.conf.arg(name="")  # a group whose options stand among the verb's own


@dataclass(frozen=True)
class FileOptions(Options):
    """How scene files are read."""

    convention: Annotated[str | None, flag("|".join(_CONVENTIONS)), OneOf(_CONVENTIONS)] = None
    """How the scene was trained or, for playcanvas and playcanvas-classic, converted, if its file does not say."""
    drop_bad: bool = False
    """Leave out Gaussians with NaN, infinite or unusable values instead of stopping."""
    allow_checkpoint: bool = False
    """Also read gsplat's .pt, a pickle; only its tensors are loaded."""
    spz_axes: SpzAxes = "auto"
    """Axes of a .spz: opengl (its specification), opencv (splat-transform, gsply), or auto: as the cameras tell."""

    def opened(self, path: Path, iteration: int | None = None) -> "SceneFile":
        """Open a scene's file and say what it is."""
        from aaplug.core.gaussians import CONVENTIONS
        from aaplug.methods.viewers import describe

        opened = aaplug.open_scene(
            path,
            iteration=iteration,
            convention=None if self.convention is None else CONVENTIONS[self.convention],
            allow_checkpoint=self.allow_checkpoint,
            spz_axes=self.spz_axes,
        )
        say(
            f"scene: {opened.path}: {opened.count:,} Gaussians, SH degree {opened.sh_degree}, "
            f"{opened.convention.name} ({opened.evidence})"
        )
        for note in opened.notes:
            open_yet = opened.other is not None and note == opened.notes[-1]
            told = f"unless the cameras tell otherwise, {note}" if open_yet else note
            say(worded(f"scene: {told}", FileOptions.__dataclass_fields__))
        for fusion in opened.fused:
            say(f"fused: {describe(fusion)}")
        return opened


@dataclass(frozen=True)
class SceneOptions(FileOptions):
    """The scene."""

    scene: Annotated[Path | None, tyro.conf.Positional, flag("SCENE")] = None
    """A scene (.ply, .compressed.ply, .spz, .sog, .splat, .ksplat) or a folder (INRIA model, SOG, levels of detail)."""
    model_path: Annotated[Path | None, flag("FOLDER", "-m")] = None
    """An INRIA model folder, instead of SCENE."""
    iteration: Annotated[int | None, number(0, 10**9, whole=True), UNSET] = None
    """Iteration of a model folder (default: the last)."""

    @property
    def path(self) -> Path:
        """What the user named."""
        if (self.scene is None) == (self.model_path is None):
            raise UsageError("scene", "name one scene, before the options: a .ply, a model folder, or -m FOLDER")
        return self.scene or cast(Path, self.model_path)

    def open(self) -> "SceneFile":
        """Open the scene's file and say what it is."""
        return self.opened(self.path, self.iteration)


@dataclass(frozen=True)
class CameraOptions(Options):
    """The cameras."""

    cameras: Annotated[Path | None, flag("PATH")] = None
    """cameras.json, COLMAP model, Blender transforms_*.json, or their folder (default: SCENE's model folder)."""
    train_scale: Annotated[float | None, SCALE, UNSET] = None
    """Training size relative to the cameras' source size, where the files do not say."""
    images: Annotated[str | None, flag("FOLDER")] = None
    """Folder of photographs inside the data set (default: the format's own)."""
    test_every: Annotated[int | None, number(0, 1_000_000, whole=True), UNSET] = None
    """Hold out every N-th view by name; 0 for no split (default: as usual for the format)."""

    orbit: OrbitOptions = field(default_factory=OrbitOptions)

    @property
    def around(self) -> "aaplug.Orbit":
        """What stands in for cameras."""
        return aaplug.Orbit(**vars(self.orbit))

    def read(self, scene: Path) -> "aaplug.CameraSet | aaplug.Orbit":
        """Read the cameras and say where sizes and split come from; without any, what stands in for them.

        scene: what the user named, whose model folder may hold cameras.
        """
        from aaplug.verbs.inputs import folder_of_cameras

        path = self.cameras or folder_of_cameras(scene)
        if path is None:
            return self.around
        for name, usual in vars(OrbitOptions()).items():
            if getattr(self.orbit, name) != usual:
                raise UsageError(name, f"is for scenes without cameras, and there are some: {path}")
        cameras = aaplug.read_cameras(
            path, train_scale=self.train_scale, images=self.images, test_every=self.test_every
        )
        for note in cameras.notes:
            say(worded(f"cameras: {note}", CameraOptions.__dataclass_fields__))
        return cameras


@dataclass(frozen=True)
class SeveralScenes:
    """Several scenes."""

    batch: Annotated[Path | None, flag("FILE.toml")] = None
    """Scenes and their settings from a file; --output is then a folder for all of them."""
    keep: bool = False
    """With --batch: leave out scenes whose output is there."""
    scheduler: Annotated[str | None, flag("local|tcp://HOST:PORT")] = None
    """With --batch: a scene at a time on each worker of a Dask cluster; see examples/guides/cluster.md."""


@contextmanager
def one_line(program: str) -> Iterator[None]:
    """Turn tyro's box about words that it cannot read into an error of one line.

    Raises:
        UsageError: the words inside the block do not fit the program.
    """
    box = StringIO()
    try:
        with redirect_stderr(box):
            yield
    except SystemExit as end:
        if not end.code:  # --help
            raise
        lines = [line.strip("│╭╮╰╯─|+ ") for line in box.getvalue().splitlines()]  # drawn in ASCII on some terminals
        said = " ".join(filter(re.compile(r"\w").search, lines[1:]))  # without the box's title and rules
        said = re.split(" For full helptext| Argument helptext", said)[0].removeprefix("Error parsing ")
        raise UsageError(program, f"{said.rstrip('. ')}; see `{program} --help`") from end


def read_inputs(scene: SceneOptions, cameras: CameraOptions) -> "tuple[Held, aaplug.CameraSet]":
    """Read a scene and its cameras, and say what they are."""
    opened, known = scene.open(), cameras.read(scene.path)
    from aaplug.verbs.inputs import inputs_of

    return inputs_of(opened, known, TERMINAL, scene.drop_bad)


def option_types(noun: type) -> dict[str, Any]:
    """Types of all options of a verb by name, those of its groups included."""
    found: dict[str, Any] = {}
    hints = get_type_hints(noun)
    for each in fields(noun):
        kind = hints[each.name]
        found |= option_types(kind) if hasattr(kind, "__dataclass_fields__") else {each.name: kind}
    return found
