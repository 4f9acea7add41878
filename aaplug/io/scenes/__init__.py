"""Scene files of any known format, read into `Gaussians` whole or part by part, and written back.

A format is a module with a `name` (also its files' suffix), `sniff`, `open_scene` and, where it can be written,
`write`; it is added by one line in `FORMATS`.  Formats are told apart by content when reading and by suffix when
writing.
"""

import importlib.util
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Literal, Protocol, runtime_checkable

from aaplug.core.errors import FormatError, OutputError, UsageError
from aaplug.core.gaussians import Convention, Gaussians
from aaplug.io.atomic import check_output
from aaplug.io.scenes import compressed_ply, ksplat, ply, pt, sog, splat, spz
from aaplug.io.scenes.packed import half_turn_about_x
from aaplug.io.scenes.scene_file import SceneFile

HEAD_BYTES = 64  # of a file, shown to each format's `sniff`
SpzAxes = Literal["opengl", "opencv"]
SOG_FOLDER = "meta.json"  # what a folder of SOG images is known by


class SceneFormat(Protocol):
    """A format that can be read."""

    name: str

    def sniff(self, path: Path, head: bytes) -> bool:
        """Whether a file that begins with `head` looks like this format."""
        ...

    def open_scene(self, path: Path) -> SceneFile:
        """Look at the scene in the file."""
        ...


@runtime_checkable
class WritableFormat(Protocol):
    """A format that can be written too."""

    def write(self, path: Path, parts: Iterable[Gaussians], count: int, overwrite: bool) -> None:
        """Write the parts of a scene, `count` Gaussians at most, whole or not at all."""
        ...


FORMATS: tuple[SceneFormat, ...] = (compressed_ply, ply, spz, sog, pt, splat, ksplat)
NEEDED = {"spz": "gsply"}  # by extras of ours named as the format: the package that writes it


def open_scene(
    path: Path,
    *,
    convention: Convention | None = None,
    allow_checkpoint: bool = False,
    spz_axes: SpzAxes = "opengl",
) -> SceneFile:
    """Look at the scene in the file `path` without reading its Gaussians.

    Args:
        path: a file; for a folder see `find_scene`.
        convention: how the scene was trained, where the file does not know or is wrong.
        allow_checkpoint: open a .pt file too, a pickle, of which nothing but tensors is taken.
        spz_axes: those of a .spz: "opengl" by its specification, "opencv" as splat-transform and gsply write them.

    Raises:
        FormatError: the file is missing, of no known format, or breaks its format.
    """
    head = _head(path)
    for format in FORMATS:
        if format.sniff(path, head):
            if format.name == "pt" and not allow_checkpoint:
                raise FormatError(
                    path,
                    "is a training checkpoint (a pickle); --allow-checkpoint reads it, or export it as .ply",
                )
            opened = format.open_scene(path).stated(convention)
            return spz.as_stored(opened) if format is spz and spz_axes == "opencv" else opened
    known = ", ".join("." + format.name for format in FORMATS)
    raise FormatError(path, f"is of no known scene format; aaplug reads {known}")


def read_scene(
    path: Path,
    *,
    convention: Convention | None = None,
    drop_bad: bool = False,
    allow_checkpoint: bool = False,
    spz_axes: SpzAxes = "opengl",
) -> Gaussians:
    """Read the scene in the file `path`.

    Args:
        path: a file; for a folder see `find_scene`.
        convention: how the scene was trained, where the file does not know or is wrong.
        drop_bad: leave out Gaussians with NaN, infinite or unusable values, and log a warning with
            their number, instead of refusing.
        allow_checkpoint, spz_axes: see `open_scene`.

    Raises:
        FormatError: the file is missing, of no known format, breaks its format, or is too large for this machine.
    """
    opened = open_scene(
        path, convention=convention, allow_checkpoint=allow_checkpoint, spz_axes=spz_axes
    )
    return opened.whole(drop_bad)


def write_scene(
    path: Path, scene: Gaussians, *, overwrite: bool = False, spz_axes: SpzAxes = "opengl"
) -> None:
    """Write a scene in the format of the path's suffix, with all else that its origin held.

    spz_axes: of a .spz, as in `open_scene`.

    Raises:
        OutputError: the suffix is of no format that can be written, the path is the file that the
            scene was read from, exists and `overwrite` is false, or cannot be written.
        UsageError: the package that writes the format is not installed.
    """
    source = [Path(scene.origin.path)] if scene.origin else []
    write_parts(path, [scene], len(scene), source, overwrite=overwrite, spz_axes=spz_axes)


def write_parts(
    path: Path,
    parts: Iterable[Gaussians],
    count: int,
    inputs: Iterable[Path] = (),
    *,
    overwrite: bool = False,
    spz_axes: SpzAxes = "opengl",
) -> None:
    """Write a scene that comes in parts, `count` Gaussians or fewer, of one convention and all with the same columns.

    Raises:
        OutputError: as in `write_scene`; `inputs` are the files that may not be replaced.
    """
    writer = check_scene_output(path, overwrite, inputs)
    if writer is spz and spz_axes == "opencv":
        parts = map(half_turn_about_x, parts)  # which the writer turns back
    writer.write(path, parts, count, overwrite)


def check_scene_output(path: Path, overwrite: bool, inputs: Iterable[Path] = ()) -> WritableFormat:
    """The format that will write `path`; refuses, before any work, what cannot be written.

    Raises:
        OutputError: as in `write_parts`.
        UsageError: the package that writes the format is not installed.
    """
    writers = {"." + f.name: f for f in FORMATS if isinstance(f, WritableFormat)}
    suffix = path.suffix.lower()
    if suffix not in writers or path.name.lower().endswith(".compressed.ply"):
        raise OutputError(
            path, f"has no suffix of a format that can be written: {', '.join(writers)}"
        )
    needed = NEEDED.get(suffix[1:])
    if needed is not None and importlib.util.find_spec(needed) is None:
        raise UsageError(
            str(path), f"writing {suffix} needs {needed}: pip install 'aaplug[{suffix[1:]}]'"
        )
    check_output(path, overwrite, inputs)
    return writers[suffix]


def find_scene(path: Path, iteration: int | None = None) -> Path:
    """The scene file itself, a folder's SOG, or the last (or given) iteration of an INRIA model folder.

    Raises:
        FormatError: nothing there, or not that iteration.
    """
    if not path.is_dir():
        return path
    scenes = _iterations(path)
    if not scenes and (path / SOG_FOLDER).is_file():
        return path / SOG_FOLDER
    if not scenes:
        raise FormatError(
            path, "holds no point_cloud/iteration_<N>/point_cloud.ply; name the scene's file"
        )
    chosen = max(scenes) if iteration is None else iteration
    if chosen not in scenes:
        available = ", ".join(map(str, sorted(scenes)))
        raise FormatError(path, f"has no iteration {chosen}; it has {available}")
    return scenes[chosen]


def _iterations(model: Path) -> dict[int, Path]:
    found = {}
    for scene in model.glob("point_cloud/iteration_*/point_cloud.ply"):
        number = re.fullmatch(r"iteration_(\d+)", scene.parent.name, re.ASCII)
        if number:
            found[int(number[1])] = scene
    return found


def _head(path: Path) -> bytes:
    try:
        if path.is_dir():
            raise FormatError(path, "is a folder; name the scene's file")
        if path.exists() and not path.is_file():
            raise FormatError(path, "is not an ordinary file")  # opening a pipe would wait for ever
        with path.open("rb") as stream:
            head = stream.read(HEAD_BYTES)
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else None
        raise FormatError(path, f"cannot be read: {(reason or str(error)).lower()}") from error
    if not head:
        raise FormatError(path, "is empty")
    return head
