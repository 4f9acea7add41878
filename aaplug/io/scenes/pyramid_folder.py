"""Pyramids on disk: a folder of plain .ply files, NAME_lod0.ply to NAME_lodN.ply, and lod.json, which describes them.

lod.json: {"aaplug_levels": 2, "source": hash, "largest": n, "count": n, "levels": [{"file", "rate", "hash", "chunks"}]}
source: of the scene, the cameras and the options that the levels were made of.  largest: see `core.chunks`.  count: of
levels, once all are made; a pyramid that lists fewer is unfinished.  rate: the lowest sampling rate relative to
training's that a level is meant for.  hash: SHA-256 of the file.  chunks: how many Gaussians each chunk has; all levels
but the finest, which keeps the scene's order, lie chunk by chunk.
"""

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import torch

from aaplug.core.chunks import chunks_of
from aaplug.core.pyramids import Level, Pyramid
from aaplug.io.atomic import AnyPath, write_file
from aaplug.io.scenes import ply
from aaplug.io.scenes.rows import SceneFileOptions
from aaplug.io.values import entries, natural, number, object_of, read_json, text
from aaplug.system.digests import digest_of_files
from aaplug.system.errors import FormatError

MANIFEST = "lod.json"
KEY = "aaplug_levels"
VERSION = 2
MAX_GAUSSIANS = 1 << 40  # of a chunk: more is nonsense


@dataclass(frozen=True)
class LevelFile:
    """A level and what its file should be; see the module."""

    file: str
    rate: float
    hash: str
    chunks: tuple[int, ...]


@dataclass(frozen=True)
class Manifest:
    """The contents of lod.json; see the module."""

    source: str
    largest: int
    count: int
    levels: tuple[LevelFile, ...]


def is_pyramid(folder: AnyPath) -> bool:
    """True for a folder that holds a pyramid, finished or not."""
    return (Path(folder) / MANIFEST).is_file()


def read_manifest(folder: AnyPath, unfinished: bool = False) -> Manifest:
    """Read lod.json; one that lists fewer levels than were asked for is refused unless `unfinished` allows it.

    Raises FormatError if it is unfinished, breaks its format or is of another version.
    """
    path = Path(folder) / MANIFEST
    about = object_of(read_json(path), path, "the pyramid", f"'{KEY}'", KEY)
    version = about.get(KEY, number)
    if version != VERSION:
        remedy = "of another aaplug; `aaplug lod --overwrite` makes the levels again"
        raise about.place.error(f"{KEY} should be version {VERSION}, not version {version:g}, {remedy}")
    levels = []
    for entry in entries(path, "levels", about.fields.get("levels")):
        file, rate, chunks = entry.get("file", text), entry.get("rate", number), entry.value("chunks")
        entry.place.expect(file == Path(file).name, "file", "a name without folders", file)
        entry.place.expect(0 < rate <= 1, "rate", "above 0 and at most 1", rate)
        counts = isinstance(chunks, list) and all(type(n) is int and 0 <= n <= MAX_GAUSSIANS for n in chunks)
        entry.place.expect(counts and bool(chunks), "chunks", "a list of counts", chunks)
        levels.append(LevelFile(file, rate, entry.get("hash", text), tuple(chunks)))
    largest, count = (natural(about.value(key), about.place, key, MAX_GAUSSIANS, 1) for key in ("largest", "count"))
    if len(levels) < count and not unfinished:
        remedy = "`aaplug lod --resume` makes the others, `--overwrite` all of them again"
        raise FormatError(path, f"lists {len(levels)} of {count} levels, as making them was interrupted; {remedy}")
    return Manifest(about.get("source", text), largest, count, tuple(levels))


def read_pyramid(folder: AnyPath) -> Pyramid:
    """Read a folder of `aaplug.lod`; raises FormatError if lod.json or a level is missing, broken or another."""
    levels = list(levels_in(folder, read_manifest(folder)))
    return Pyramid.of([level.scene for level in levels], [c for level in levels if (c := level.chunks) is not None])


def levels_in(folder: AnyPath, manifest: Manifest, start: int = 0) -> Iterator[Level]:
    """The levels of a folder from `start` on; see `read_pyramid`.  The files of those before it are checked, too."""
    for place, entry in enumerate(manifest.levels):
        path = path_of(Path(folder), entry)
        if place < start:
            continue
        scene, sizes = ply.open_scene(path, SceneFileOptions()).gaussians(), torch.tensor(entry.chunks)
        problem = FormatError(path, f"does not have the chunks that {MANIFEST} lists")
        if sum(entry.chunks) != len(scene):  # before memory is taken for as many as it says
            raise problem
        chunks = torch.arange(len(sizes)).repeat_interleave(sizes)
        if not place:
            chunks = chunks_of(scene.means, manifest.largest)
        if not torch.equal(torch.bincount(chunks, minlength=len(sizes)), sizes):
            raise problem
        yield Level(scene, entry.rate, chunks)


def write_manifest(folder: AnyPath, manifest: Manifest) -> None:
    """Write lod.json, replacing it; raises OutputError if it cannot be written."""
    content = json.dumps({KEY: VERSION, **asdict(manifest)}).encode()
    write_file(Path(folder) / MANIFEST, content, overwrite=True)


def path_of(folder: Path, level: LevelFile) -> Path:
    """The file of a level; raises FormatError if it is missing or not the one that lod.json names."""
    path = folder / level.file
    if not path.is_file():
        raise FormatError(path, f"is missing: {MANIFEST} names it as a level; `aaplug lod --overwrite` makes it again")
    if digest_of_files([path]) != level.hash:
        raise FormatError(path, f"is not the level that {MANIFEST} names: it was changed, cut short or exchanged")
    return path
