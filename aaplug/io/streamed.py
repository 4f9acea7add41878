"""Streamed levels of detail: a folder of small scene files, one for each part of space at each level, and an index.

Two indexes: PlayCanvas's lod-meta.json, version 1, of SOG folders, and a tileset.json of 3D Tiles 1.1, of .glb files
with KHR_gaussian_splatting_compression_spz_2, as CesiumJS takes them.  Level k is right from 2^-k of the training rate;
a viewer should change to it where its pixels lie at `SWITCH` times that rate.  Both viewers choose by the distance of a
part's nearest point: at a distance d, an image h px high samples a world unit with h / (2 tan(fov / 2) d) px.
"""

import json
import math
import re
import shutil
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from aaplug.core.gaussians import Gaussians
from aaplug.core.placing import box_of
from aaplug.io import StreamName, stream_pages
from aaplug.io.atomic import make_folder, replacing
from aaplug.io.scenes import gltf, write_scene
from aaplug.io.scenes.pyramid_folder import Level
from aaplug.system.errors import OutputError, UsageError, reason

LEAF_GAUSSIANS = 1 << 16  # of the finest level in a part of space
SWITCH = 1.5  # rate at which a viewer should change level, as a multiple of the coarser level's own
TILE_SWITCH = 2.0  # the same of a tile, whose box holds the Gaussians' extents and so begins nearer than they do
EXTENT = 3.0  # standard deviations to which a tile's box holds its splats
PLAYCANVAS_TANGENT = math.tan(math.radians(22.5))  # of half the field of view that its distances are meant for
UPDATE_SHARE = 1 / 16  # of the first distance: PlayCanvas chooses levels again when the camera moved so far
MAX_SCREEN_ERROR = 16.0  # px, `maximumScreenSpaceError` of CesiumJS by default
ALWAYS = 1e6  # error of the root over that of the coarsest level, so that something is drawn at any distance
SPLATS = [gltf.SPLATS, gltf.SPZ]
SETTINGS, PAGE = "settings.json", "index.html"
Box = Float[Tensor, "2 3"]  # smallest and largest coordinates


@dataclass(frozen=True)
class Stream:
    """What a viewer streams.

    viewer: for whose rule levels are tuned.
    index: name of the index.
    content: name of a part's file.
    program: the viewer's program, as a file or folder of node_modules.
    """

    viewer: str
    index: str
    content: str
    program: str

    def part(self, level: int, leaf: int) -> str:
        """Path of a part, from its level and its part of space."""
        return f"{level}_{leaf}/{self.content}"


STREAMS = {
    "sog": Stream("playcanvas", "lod-meta.json", "meta.json", "playcanvas/build/playcanvas.min.mjs"),
    "3dtiles": Stream("cesium", "tileset.json", "splats.spz.glb", "cesium/Build/Cesium"),
}


def leaves_of(finest: Level) -> Int[Tensor, " chunks"]:
    """The part of space of each chunk: consecutive ones along the curve share a part until it is full."""
    assert finest.chunks is not None
    return (torch.bincount(finest.chunks).cumsum(0) - 1) // LEAF_GAUSSIANS


def parts_of(level: Level, leaves: Int[Tensor, " chunks"]) -> list[Gaussians]:
    """A level's Gaussians by part of space."""
    assert level.chunks is not None
    owners = leaves[level.chunks]
    return [level.scene[(owners == leaf).nonzero().squeeze(1)] for leaf in range(int(leaves.max()) + 1)]


def write_level(folder: Path, name: StreamName, number: int, parts: Sequence[Gaussians]) -> None:
    """Write the parts of a level, replacing what is there."""
    for leaf, part in enumerate(parts):
        if len(part):
            path = folder / STREAMS[name].part(number, leaf)
            make_folder(path.parent)
            write_scene(path, part, overwrite=True)


def part_folders(folder: Path, name: StreamName) -> set[Path]:
    """The folders of the parts that the index in a folder lists; none without an index."""
    stream = STREAMS[name]
    text = (folder / stream.index).read_text("utf-8", "replace") if (folder / stream.index).is_file() else ""
    return {folder / part for part in re.findall(rf'"(\d+_\d+)/{re.escape(stream.content)}"', text)}


def remove_parts(folders: Iterable[Path], name: StreamName) -> None:
    """Remove what `write_level` wrote into these folders, and those that are empty then."""
    for folder in folders:
        for file in [folder / STREAMS[name].content, *folder.glob("*.webp")]:
            file.unlink(missing_ok=True)
        with suppress(OSError):
            folder.rmdir()


def write_index(folder: Path, name: StreamName, levels: Sequence[Level], rate: float) -> Mapping[str, Any]:
    """Write the index, and what the viewer must be set to; returns the latter.

    rate: of training, in px per world unit.
    """
    leaves = leaves_of(levels[0])
    parts = list(zip(*(parts_of(level, leaves) for level in levels), strict=True))
    index, settings = {"sog": _lod_meta, "3dtiles": _tileset}[name](STREAMS[name], parts, rate)
    for file, content in {SETTINGS: settings, STREAMS[name].index: index}.items():  # the index last: it is the mark
        with replacing(folder / file, overwrite=True) as stream:
            stream.write(json.dumps(content, indent=1).encode())
    return settings


def program_of(name: StreamName, modules: Path) -> Path:
    """The viewer's program in a folder node_modules; raises UsageError if it is not there."""
    program = modules / STREAMS[name].program
    if not program.exists():
        package = STREAMS[name].program.partition("/")[0]
        raise UsageError("page", f"{modules} does not hold {STREAMS[name].program}: `npm install {package}` makes it")
    return program


def write_page(folder: Path, name: StreamName, modules: Path) -> None:
    """Write index.html, which opens the levels, and the viewer's program into viewer/ beside it.

    A browser reads them from a server, such as `python -m http.server`; nothing is fetched from elsewhere.
    """
    program, viewer = program_of(name, modules), make_folder(folder / "viewer")
    try:
        if program.is_dir():
            shutil.copytree(program, viewer, dirs_exist_ok=True)
        else:
            shutil.copy(program, viewer)
    except OSError as error:
        raise OutputError(viewer, f"cannot be written: {reason(error)}") from error
    with replacing(folder / PAGE, overwrite=True) as stream:
        stream.write(files(stream_pages).joinpath(f"{name}.html").read_bytes())


Indexed = tuple[dict[str, Any], dict[str, Any]]  # an index, and the viewer's settings


def _lod_meta(stream: Stream, parts: Sequence[Sequence[Gaussians]], rate: float) -> Indexed:
    counts = [sum(map(len, level)) for level in zip(*parts, strict=True)]
    filenames, children = [], []
    for leaf, levels in enumerate(parts):
        lods = {}
        for number, part in enumerate(levels):
            if len(part):
                lods[str(number)] = {"file": len(filenames), "offset": 0, "count": len(part)}
                filenames.append(stream.part(number, leaf))
        children.append({"bound": _bound(_box(levels, 0.0)), "lods": lods})
    tree = {"bound": _bound(_box([part for levels in parts for part in levels], 0.0)), "children": children}
    facts = {"version": 1, "asset": {"generator": "aaplug"}, "count": counts[0], "counts": counts}
    settings = {
        "app.scene.gsplat": {"antiAlias": True, "splatBudgetMode": "limit", "splatBudget": 0},
        "gsplat component": {"lodMultiplier": 2.0},
        "lodBaseDistance per px of the image's height": 1 / (PLAYCANVAS_TANGENT * SWITCH * rate),
        "lodUpdateDistance per lodBaseDistance": UPDATE_SHARE,
    }
    return facts | {"lodLevels": len(counts), "filenames": filenames, "tree": tree}, settings


def _tileset(stream: Stream, parts: Sequence[Sequence[Gaussians]], rate: float) -> Indexed:
    def error(number: int) -> float:
        return MAX_SCREEN_ERROR * 2.0**number / (TILE_SWITCH * rate)

    tiles = []
    for leaf, levels in enumerate(parts):
        volume, tile = _volume(_box(levels, EXTENT)), None
        for number, part in enumerate(levels):
            if len(part):
                finer = {} if tile is None else {"children": [tile]}
                content = {"content": {"uri": stream.part(number, leaf)}}
                about = {"boundingVolume": volume, "geometricError": error(number) if finer else 0.0}
                tile = {**about, "refine": "REPLACE", **content, **finer}
        tiles.append(tile)
    root = {
        "transform": torch.eye(4).flatten().tolist(),
        "boundingVolume": _volume(_box([part for levels in parts for part in levels], EXTENT)),
        "geometricError": ALWAYS * error(len(parts[0]) - 1),
        "refine": "REPLACE",
        "children": tiles,
    }
    extension = {"extensionsUsed": SPLATS, "extensionsRequired": SPLATS}
    counts = [sum(map(len, level)) for level in zip(*parts, strict=True)]
    index = {
        "asset": {"version": "1.1", "generator": "aaplug", "extras": {"counts": counts}},
        "extensionsUsed": ["3DTILES_content_gltf"],
        "extensions": {"3DTILES_content_gltf": extension},
        "geometricError": root["geometricError"],
        "root": root,
    }
    return index, {"Cesium3DTileset": {"maximumScreenSpaceError": MAX_SCREEN_ERROR, "dynamicScreenSpaceError": False}}


def _box(parts: Sequence[Gaussians], extent: float) -> Box:
    """The box around the Gaussians of parts to `extent` standard deviations."""
    lows, highs = zip(*(box_of(part, extent) for part in parts if len(part)), strict=True)
    return torch.stack([torch.stack(lows).amin(dim=0), torch.stack(highs).amax(dim=0)]).double()


def _bound(box: Box) -> dict[str, list[float]]:
    return {"min": box[0].tolist(), "max": box[1].tolist()}


def _volume(box: Box) -> dict[str, list[float]]:
    """A tile's box.  Its axes are z up: a scene's (x, y, z) is (-x, -y, z) in glTF and (-x, -z, -y) in a tile."""
    middle, half = -box.mean(dim=0)[[0, 2, 1]], ((box[1] - box[0]) / 2)[[0, 2, 1]]
    return {"box": [*middle.tolist(), *torch.diag(half).flatten().tolist()]}
