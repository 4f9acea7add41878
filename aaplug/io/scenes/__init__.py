"""Scene files, read into `Gaussians` whole or part by part, and written.

A scene format is a module or object like the protocols below.  aaplug's own are in `OWN`; a plug-in adds one by an
entry point in the group "aaplug.scene_formats" (`system.registry`).  A file is read by the first format whose `sniff`
accepts it: plug-ins first, as they may read a dialect of a file that an own format would accept too.  A file is written
in the format whose name ends the file's name.
"""

import logging
import re
from collections.abc import Collection, Iterable, Iterator
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from aaplug.core.conventions import CLASSIC, Convention, SpzAxes, SpzVersion
from aaplug.core.gaussians import Gaussians
from aaplug.core.pyramids import Pyramid
from aaplug.io import STREAM_INDEXES
from aaplug.io.atomic import AnyPath, check_output
from aaplug.io.scenes import chunked, compressed_ply, gltf, ksplat, lcc, ply, pt, sog, splat, spz, usd
from aaplug.io.scenes.columns import described_faults, faults_of
from aaplug.io.scenes.pyramid_folder import MANIFEST, is_pyramid, path_of, read_manifest, read_pyramid
from aaplug.io.scenes.rows import HEAD_BYTES, SceneFileOptions, library_errors
from aaplug.io.scenes.scene import COMPENSATED, FOLDER_INDEXES, MODEL_SCENE, Scene, SceneFrames
from aaplug.io.values import read_start, visible
from aaplug.system.contracts import contract
from aaplug.system.errors import FormatError, OutputError, PlugInError, UsageError, listing
from aaplug.system.extras import check_installed
from aaplug.system.plug_ins import asked
from aaplug.system.registry import Registry, named

log = logging.getLogger("aaplug")

RAD_SUFFIX = ".rad"  # of levels for Spark
NUMBERED = re.compile(r"(.*?)(?<!\d)(?<!_lod)(\d+)((?:\.compressed)?\.ply)", re.ASCII)  # levels of detail are no frames


@runtime_checkable
class SceneFormat(Protocol):
    """A format that can be read.  name: its files' suffix without the first dot."""

    @property
    def name(self) -> str: ...  # noqa: D102

    def sniff(self, path: Path, head: bytes, /) -> bool:
        """True if a file that begins with `head` is of this format.  Never raises."""
        ...

    def open_scene(self, path: Path, options: SceneFileOptions) -> Scene:
        """Read what the file says about the scene; rows are read when `Scene.load` is called.

        Raises FormatError if the file breaks its format.
        """
        ...


@runtime_checkable
class WritableFormat(SceneFormat, Protocol):
    """A format that can be written too.

    Attributes that it may have: `needs` is a package that writing imports, which comes with aaplug's extra `extra`, or
    else that of the format's name.  A format whose files another one reads, names it as `read_as`.  What the files of
    this name keep is in `keeps`; a warning names what is lost, all of the following without this attribute:
        "harmonics": those above degree 0.
        "record": the convention and fusions.  "compensation": of the convention, whether opacities are compensated.
        "extras": what `ply.beside` names.
    """

    def write(
        self, path: Path, parts: Iterable[Gaussians], count: int, overwrite: bool, options: SceneFileOptions
    ) -> None:
        """Write a scene of at least one part and at most `count` Gaussians, whole or not at all.

        Raises OutputError if the format cannot hold the scene, the file exists and `overwrite` is false, or it fails.
        """
        ...


MODULES: tuple[SceneFormat, ...] = (compressed_ply, ply, spz, sog, pt, splat, ksplat, lcc)
# the first that accepts a file is used
OWN: tuple[SceneFormat, ...] = (*MODULES, *gltf.FORMATS, sog.UNBUNDLED, *usd.FORMATS, *chunked.FORMATS)
SCENE_FORMATS = Registry[SceneFormat]("scene format", "aaplug.io.scenes:SceneFormat", named(OWN))
SceneLike = Scene | Gaussians | Pyramid | AnyPath


def scene_of(scene: SceneLike, still: bool = False) -> Scene:
    """The scene itself, or that of Gaussians or a path; still: raise a UsageError for a scene in time."""
    if isinstance(scene, Gaussians | Pyramid):
        return Scene.in_memory(scene)
    opened = scene if isinstance(scene, Scene) else read_scene(scene)
    if still and opened.frames is not None:
        takers = "render, video, evaluate and convert take it whole; here, name one of its files"
        raise UsageError(str(opened.folder), f"is a scene in time, of {len(opened.frames)} frames: {takers}")
    return opened


@contract
def read_scene(
    path: AnyPath,
    *,
    iteration: int | None = None,
    convention: Convention | None = None,
    drop_bad: bool = False,
    allow_checkpoint: bool = False,
    spz_axes: SpzAxes = "auto",
    frames_apart: bool = False,
) -> Scene:
    """Open a scene: a file, or a folder of an INRIA model, of SOG images, chunks, levels of detail or frames.

    Its Gaussians are read when they are first asked for: `read_scene("scene.ply").gaussians()`.

    Args:
        path: of the file or folder; of a folder of several kinds a model's last iteration comes first.
        iteration: which iteration of a model folder; None for the last.
        convention: how the scene was trained, if the file does not say or is wrong.
        drop_bad: leave out Gaussians with NaN, infinite or unusable values and log a warning with their number;
            without it they are an error when they are read.
        allow_checkpoint: open a .pt too, a pickle, of which only tensors are read.
        spz_axes: of the numbers in a .spz: "opengl" by its specification, "opencv" as splat-transform and gsply write
            them; "auto" is what the file states, or else the first, with the second as `Scene.other`.
        frames_apart: the frames of a scene in time were trained apart: no Gaussian of one is in another.

    Raises:
        FormatError: the file is missing, of no known format, or breaks its format.
        UsageError: `iteration` is given for a file.
    """
    options = SceneFileOptions(allow_checkpoint, spz_axes)
    with library_errors(Path(path)):
        given, manifest = Path(path), read_manifest(path) if is_pyramid(path) else None
        path = find_scene(given, iteration)
        in_time = manifest is None and path.parent == given and path.name not in FOLDER_INDEXES
        numbered = frame_files(given) if in_time else {}
    head = read_start(path, HEAD_BYTES)
    if not head:
        raise FormatError(path, "is empty")
    formats = sorted(SCENE_FORMATS.values(), key=OWN.__contains__)  # plug-ins first
    format = next((each for each in formats if asked("scene format", each, "sniff", path, head)), None)
    if format is None and (path.name in STREAM_INDEXES.values() or path.suffix.lower() == RAD_SUFFIX):
        raise FormatError(path, "holds levels for a web viewer alone; name the scene that they were made of")
    if format is None:
        if head.startswith((sog.ZIP_SIGNATURE, spz.GZIP_SIGNATURE)):
            raise FormatError(path, "is an archive; unpack it, and name the scene's file that was in it")
        raise FormatError(path, f"is of no known scene format; aaplug reads {', '.join(map(_ending, formats))}")
    how: dict[str, Any] = {"drop_bad": drop_bad}
    if convention is not None:
        how |= {"convention": convention, "evidence": "stated by the user"}
    scene: Scene = asked("scene format", format, "open_scene", path, options)
    scene = replace(scene, **how, other=scene.other and replace(scene.other, **how))
    if numbered:
        reading = partial(read_scene, convention=convention, drop_bad=drop_bad)
        frames = SceneFrames((*numbered,), (*numbered.values(),), reading, frames_apart)
        frames.check()
        suffixes, names = tuple(f".{format.name}" for format in formats), {file.name for file in frames.paths}
        others = [f.name for f in visible(given) if f.name.lower().endswith(suffixes) and f.name not in names]
        notes = (*scene.notes, f"the first of {len(frames)} frames, to {frames.paths[-1].name}")
        if others:
            notes = (*notes, f"no frames, and left out: {listing(others)}")
        return replace(scene, folder=given, frames=frames, others=frames.paths[1:], notes=notes)
    if manifest is not None:
        others = (given / MANIFEST, *(given / level.file for level in manifest.levels[1:]))
        counts, rate = " > ".join(f"{sum(level.chunks):,}" for level in manifest.levels), manifest.levels[-1].rate
        about = f"{len(manifest.levels)} levels of detail: {counts} Gaussians, down to {rate:.3g} × training"
        read, notes = partial(read_pyramid, given), (*scene.notes, about)
        return replace(scene, folder=given, read_levels=read, others=others, notes=notes)
    return scene


@contract
def write_scene(
    path: AnyPath, scene: Gaussians, *, overwrite: bool = False, spz_axes: SpzAxes = "auto", spz_version: SpzVersion = 4
) -> None:
    """Write a scene in the format of the path's suffix, with everything else that its source file held.

    overwrite: replace an existing file.  spz_axes: see `read_scene`; "auto" is the specification's.
    spz_version: 3 as older readers of .spz take it, or 4, which states its axes.

    Raises:
        OutputError: no writable format has this suffix, the format cannot hold the scene, or the path is the scene's
            source file, exists and `overwrite` is false, or cannot be written.
        UsageError: the package that writes the format is not installed.
    """
    source = [scene.origin.path] if scene.origin else []
    write_parts(path, [scene], len(scene), source, overwrite=overwrite, spz_axes=spz_axes, spz_version=spz_version)


def write_parts(
    path: AnyPath,
    parts: Iterable[Gaussians],
    count: int,
    inputs: Iterable[AnyPath] = (),
    *,
    overwrite: bool = False,
    spz_axes: SpzAxes = "auto",
    spz_version: SpzVersion = 4,
) -> None:
    """Write a scene that comes in parts, at most `count` Gaussians of one convention and with the same columns.

    inputs: files that are being read and may not be replaced.  Errors: see `write_scene`.
    """
    writer = check_scene_output(path, overwrite, inputs)
    storable = _storable(path, parts, writer)
    options = SceneFileOptions(spz_axes=spz_axes, spz_version=spz_version)
    asked("scene format", writer, "write", Path(path), storable, count, overwrite, options)
    if not Path(path).exists():
        raise PlugInError(f"scene format {writer.name}", f"has not written {path}")


def _storable(path: AnyPath, parts: Iterable[Gaussians], writer: WritableFormat) -> Iterator[Gaussians]:
    """The parts as float32 on the CPU; raises OutputError for values that no renderer can use."""
    for place, part in enumerate(parts):
        if not place and (lost := [*_losses(part, kept_by(writer))]):
            log.warning("%s: a %s cannot hold %s; a .ply can", path, _ending(writer), " and ".join(lost))
        part = replace(part, **{name: column.detach().cpu().float() for name, column in part.columns.items()})
        if faults := faults_of(part):
            raise OutputError(path, f"the scene to write cannot be used: {described_faults(faults)}")
        yield part


def _losses(scene: Gaussians, keeps: Collection[str]) -> Iterator[str]:
    """What files do not tell of a scene, in words."""
    told = COMPENSATED if "compensation" in keeps and scene.convention.compensated else CLASSIC
    if "extras" not in keeps and (beside := ply.beside(scene)):
        yield f"the {beside}"
    if "harmonics" not in keeps and scene.sh_degree:
        yield "harmonics above degree 0"
    if "record" not in keeps and scene.convention != told:
        yield f"the record of its training ({scene.convention.name})"
    if "record" not in keeps and scene.fused:
        yield "the record of what was fused"


def kept_by(format: SceneFormat | None) -> Collection[str]:
    """What files of a format keep; see `WritableFormat`."""
    return getattr(format, "keeps", ())


def written_format(path: AnyPath) -> WritableFormat | None:
    """The format that writes files of this suffix; None if none does, or there is no suffix: a folder may be `sog`."""
    name = Path(path).name.lower()
    if not Path(name).suffix:
        return None
    named = [format for format in SCENE_FORMATS.values() if f".{name}".endswith("." + format.name)]
    found = max(named, key=lambda format: len(format.name), default=None)
    return found if isinstance(found, WritableFormat) else None


def kind_written(path: AnyPath) -> str:
    """Name of the format that `path` will be read as; ply for a folder of frames."""
    format = written_format(path)
    return "ply" if format is None else getattr(format, "read_as", None) or format.name


def _ending(format: SceneFormat) -> str:
    """The end of its files' names: a suffix, or such as meta.json the whole name."""
    return format.name if format.name.endswith(".json") else f".{format.name}"


def check_scene_output(path: AnyPath, overwrite: bool, inputs: Iterable[AnyPath] = ()) -> WritableFormat:
    """The format that will write `path`; refuses one that cannot be written, before any work, as `write_scene`."""
    writer = written_format(path)
    if writer is None:
        known = [_ending(format) for format in SCENE_FORMATS.values() if isinstance(format, WritableFormat)]
        raise OutputError(path, f"has no suffix of a format that can be written: {', '.join(known)}")
    if needs := getattr(writer, "needs", None):
        extra = getattr(writer, "extra", writer.name)
        check_installed(needs, extra, str(path), f"writing .{writer.name} needs {needs}")
    check_output(path, overwrite, inputs)
    return writer


def find_scene(path: AnyPath, iteration: int | None = None) -> Path:
    """The scene file that a path means.

    A file means itself.  A folder means the last (or the given) iteration of an INRIA model, its SOG images or chunks,
    the finest of its levels of detail, the first of its frames, or an index of levels for another viewer.
    Raises FormatError if the folder holds no scene, or not that iteration, and UsageError for an iteration of a file.
    """
    path = Path(path)
    if not path.is_dir():
        if iteration is not None and path.exists():
            raise UsageError("iteration", f"is of a model folder, and {path} is a file")
        return path
    if is_pyramid(path):
        return path_of(path, read_manifest(path).levels[0])
    pattern, files = re.compile(r"iteration_(\d+)", re.ASCII), path.glob(MODEL_SCENE)
    scenes = {int(match[1]): file for file in files if (match := pattern.fullmatch(file.parent.name))}
    if not scenes:
        for index in FOLDER_INDEXES:
            if (path / index).is_file():
                return path / index
        if frames := frame_files(path):
            return path / next(iter(frames)).name
        for index in STREAM_INDEXES.values():
            if (path / index).is_file():
                return path / index
        known = f"{MANIFEST}, {', '.join(FOLDER_INDEXES)} or numbered .ply files"
        raise FormatError(path, f"holds no point_cloud/iteration_<N>/point_cloud.ply, {known}; name the scene's file")
    chosen = max(scenes) if iteration is None else iteration
    if chosen not in scenes:
        raise FormatError(path, f"has no iteration {chosen}; it has {', '.join(map(str, sorted(scenes)))}")
    return scenes[chosen]


def frame_files(folder: Path) -> dict[Path, str]:
    """The numbers of the files of a scene in time, by file and in order; none if no two differ by a number alone.

    Raises FormatError where frames are missing or there twice, or of several sequences.
    """
    matches = [match for path in visible(folder) if (match := NUMBERED.fullmatch(path.name))]
    named: dict[tuple[str, str], list[re.Match[str]]] = {}
    for match in sorted(matches, key=lambda match: (int(match[2]), match[0])):
        named.setdefault((match[1], match[3]), []).append(match)
    sequences = {name: found for name, found in named.items() if len(found) > 1}
    if not sequences:
        return {}
    if len(sequences) > 1:
        patterns = listing(sorted(f"{first}####{last}" for first, last in sequences))
        raise FormatError(folder, f"holds frames of {len(sequences)} sequences ({patterns}); give each a folder")
    [found] = sequences.values()
    for before, after in pairwise(found):
        if int(after[2]) != (expected := int(before[2]) + 1):
            problem = f"expected frame {expected} after {before[0]}, got {after[0]}"
            raise FormatError(folder, f"{problem}; or name one of the files")
    return {folder.absolute() / match[0]: match[2] for match in found}
