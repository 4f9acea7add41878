"""Scene files, read into `Gaussians` whole or part by part, and written.

A scene format is a module or object like the protocols below.  aaplug's own are in `OWN`; a plug-in adds one by an
entry point in the group "aaplug.scene_formats" (see `core.registry`).  A file is read by the first format whose `sniff`
accepts it: plug-ins first, as they may read a dialect of a file that an own format would accept too.  A file is written
in the format whose name ends the file's name.
"""

import importlib.util
import re
from collections.abc import Iterable
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Protocol, runtime_checkable

from aaplug.core.choices import SpzAxes
from aaplug.core.errors import FormatError, OutputError, UsageError
from aaplug.core.gaussians import Convention, Gaussians
from aaplug.core.registry import Registry, named
from aaplug.io.atomic import check_output
from aaplug.io.scenes import compressed_ply, ksplat, ply, pt, sog, splat, spz
from aaplug.io.scenes.manifests import is_pyramid, path_of, read_manifest
from aaplug.io.scenes.options import Options
from aaplug.io.scenes.scene_file import SceneFile
from aaplug.io.values import read_start

HEAD_BYTES = 64  # of a file, passed to each format's `sniff`
MODEL_SCENE = "point_cloud/iteration_*/point_cloud.ply"  # in an INRIA model folder
SOG_FOLDER = "meta.json"  # marks a folder of SOG images


@runtime_checkable
class SceneFormat(Protocol):
    """A format that can be read.  name: its files' suffix without the first dot."""

    @property
    def name(self) -> str: ...  # noqa: D102

    def sniff(self, path: Path, head: bytes) -> bool:
        """Whether a file that begins with `head` is of this format.  Never raises."""
        ...

    def open_scene(self, path: Path, options: Options) -> SceneFile:
        """Read what the file says about the scene; Gaussians are loaded when `SceneFile.load` is called.

        Raises FormatError if the file breaks its format.
        """
        ...


@runtime_checkable
class WritableFormat(SceneFormat, Protocol):
    """A format that can be written too.  needs: a package that writing imports, from aaplug's extra `name`; or None."""

    @property
    def needs(self) -> str | None: ...  # noqa: D102

    def write(self, path: Path, parts: Iterable[Gaussians], count: int, overwrite: bool, options: Options) -> None:
        """Write a scene of at least one part and at most `count` Gaussians, whole or not at all.

        Raises OutputError if the format cannot hold the scene, the file exists and `overwrite` is false, or it fails.
        """
        ...


# the first that accepts a file is used
OWN: tuple[SceneFormat, ...] = (compressed_ply, ply, spz, sog, pt, splat, ksplat)
SCENE_FORMATS = Registry[SceneFormat]("scene format", named(OWN), lambda f: isinstance(f, SceneFormat))


def open_scene(
    path: str | PathLike[str],
    *,
    iteration: int | None = None,
    convention: Convention | None = None,
    allow_checkpoint: bool = False,
    spz_axes: SpzAxes = "auto",
) -> SceneFile:
    """Open a scene without reading its Gaussians.

    Args:
        path: a scene file, an INRIA model folder, a folder of SOG images or of levels of detail; see `find_scene`.
        iteration: which iteration of a model folder; None for the last.
        convention: how the scene was trained, if the file does not say or is wrong.
        allow_checkpoint: open a .pt too, a pickle, of which only tensors are read.
        spz_axes: of a .spz: "opengl" by its specification, "opencv" as splat-transform and gsply write them; "auto" is
            the first, with the second as `SceneFile.other`.

    Raises:
        FormatError: the file is missing, of no known format, or breaks its format.
    """
    options = Options(allow_checkpoint, spz_axes)
    folder = Path(path) if is_pyramid(path) else None
    path = find_scene(path, iteration)
    head = read_start(path, HEAD_BYTES)
    if not head:
        raise FormatError(path, "is empty")
    formats = sorted(SCENE_FORMATS.values(), key=OWN.__contains__)  # plug-ins first
    for format in formats:
        if format.sniff(path, head):
            file = format.open_scene(path, options)
            if folder is not None:
                file = replace(file, pyramid=folder, notes=(*file.notes, read_manifest(folder).described))
            return file if convention is None else _stated(file, convention)
    known = ", ".join("." + format.name for format in formats)
    raise FormatError(path, f"is of no known scene format; aaplug reads {known}")


def _stated(file: SceneFile, convention: Convention) -> SceneFile:
    """The file with the convention that the user states."""
    other = file.other and _stated(file.other, convention)
    return replace(file, convention=convention, evidence="stated by the user", other=other)


def read_scene(
    path: str | PathLike[str],
    *,
    iteration: int | None = None,
    convention: Convention | None = None,
    drop_bad: bool = False,
    allow_checkpoint: bool = False,
    spz_axes: SpzAxes = "auto",
) -> Gaussians:
    """Read a scene.

    drop_bad: leave out Gaussians with NaN, infinite or unusable values and log a warning with their number; without it
    they are an error.  Other arguments: see `open_scene`.

    Raises:
        FormatError: the file is missing, of no known format, breaks its format, or is too large for this machine.
    """
    how = {"allow_checkpoint": allow_checkpoint, "spz_axes": spz_axes}
    return open_scene(path, iteration=iteration, convention=convention, **how).whole(drop_bad)


def write_scene(
    path: str | PathLike[str], scene: Gaussians, *, overwrite: bool = False, spz_axes: SpzAxes = "auto"
) -> None:
    """Write a scene in the format of the path's suffix, with everything else that its source file held.

    overwrite: replace an existing file.  spz_axes: see `open_scene`.

    Raises:
        OutputError: no writable format has this suffix, the format cannot hold the scene, or the path is the scene's
            source file, exists and `overwrite` is false, or cannot be written.
        UsageError: the package that writes the format is not installed.
    """
    source = [scene.origin.path] if scene.origin else []
    write_parts(path, [scene], len(scene), source, overwrite=overwrite, spz_axes=spz_axes)


def write_parts(
    path: str | PathLike[str],
    parts: Iterable[Gaussians],
    count: int,
    inputs: Iterable[str | PathLike[str]] = (),
    *,
    overwrite: bool = False,
    spz_axes: SpzAxes = "auto",
) -> None:
    """Write a scene that comes in parts, at most `count` Gaussians of one convention and with the same columns.

    inputs: files that are being read and may not be replaced.  Errors: see `write_scene`.
    """
    writer = check_scene_output(path, overwrite, inputs)
    writer.write(Path(path), parts, count, overwrite, Options(spz_axes=spz_axes))


def written_format(path: str | PathLike[str]) -> WritableFormat | None:
    """The format that writes files of this suffix; None if none does."""
    name = Path(path).name.lower()
    named = [format for format in SCENE_FORMATS.values() if name.endswith("." + format.name)]
    found = max(named, key=lambda format: len(format.name), default=None)
    return found if isinstance(found, WritableFormat) else None


def check_scene_output(
    path: str | PathLike[str], overwrite: bool, inputs: Iterable[str | PathLike[str]] = ()
) -> WritableFormat:
    """The format that will write `path`; refuses an output that cannot be written, before any work.

    Errors: see `write_scene`.
    """
    writer = written_format(path)
    if writer is None:
        known = [f".{format.name}" for format in SCENE_FORMATS.values() if isinstance(format, WritableFormat)]
        raise OutputError(path, f"has no suffix of a format that can be written: {', '.join(known)}")
    if writer.needs is not None and importlib.util.find_spec(writer.needs) is None:
        raise UsageError(str(path), f"writing .{writer.name} needs {writer.needs}: pip install 'aaplug[{writer.name}]'")
    check_output(path, overwrite, inputs)
    return writer


def bytes_of(path: str | PathLike[str]) -> int | None:
    """Size of a scene's file; of levels of detail or SOG images, of their folder's files.  None if it is gone."""
    path = Path(path)
    folder = path.parent if path.name == SOG_FOLDER else path
    files = [file for file in folder.iterdir() if file.is_file()] if folder.is_dir() else [path]
    try:
        return sum(file.stat().st_size for file in files)
    except OSError:
        return None


def find_scene(path: str | PathLike[str], iteration: int | None = None) -> Path:
    """The scene file that a path means.

    A file means itself.  A folder means the last (or the given) iteration of an INRIA model, its SOG images, or the
    finest of its levels of detail.
    Raises FormatError if the folder holds no scene, or not that iteration.
    """
    path = Path(path)
    if not path.is_dir():
        return path
    if is_pyramid(path):
        return path_of(path, read_manifest(path).levels[0])
    pattern, files = re.compile(r"iteration_(\d+)", re.ASCII), path.glob(MODEL_SCENE)
    scenes = {int(match[1]): file for file in files if (match := pattern.fullmatch(file.parent.name))}
    if not scenes and (path / SOG_FOLDER).is_file():
        return path / SOG_FOLDER
    if not scenes:
        raise FormatError(path, "holds no point_cloud/iteration_<N>/point_cloud.ply; name the scene's file")
    chosen = max(scenes) if iteration is None else iteration
    if chosen not in scenes:
        raise FormatError(path, f"has no iteration {chosen}; it has {', '.join(map(str, sorted(scenes)))}")
    return scenes[chosen]


def called(path: Path) -> str:
    """What people call the scene of a file or pyramid: its name, or that of its folder if its format names the file."""
    whole = path.resolve()
    if whole.match(MODEL_SCENE):
        return whole.parents[2].name
    return whole.parent.name if whole.name == SOG_FOLDER else whole.name
