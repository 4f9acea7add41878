"""Streamed levels of detail: a folder of small scene files, one for each part of space at each level, and an index.

Two indexes: PlayCanvas's lod-meta.json, version 1, of SOG folders, and a tileset.json of 3D Tiles 1.1, of .glb files
with KHR_gaussian_splatting_compression_spz_2, as CesiumJS takes them.  Level k is right from 2^-k of the training rate;
a viewer should change to it where its pixels lie at `SWITCH` times that rate.  Both viewers choose by the distance of a
part's nearest point: at a distance d, an image h px high samples a world unit with h / (2 tan(fov / 2) d) px.

Spark's .rad is one file of all levels, in which each Gaussian is exchanged for its children alone: see `Front`.
"""

import json
import logging
import math
import re
import shutil
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from importlib.resources import files
from itertools import count, takewhile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from aaplug.core.gaussians import Gaussians, joined
from aaplug.core.orbits import Frame
from aaplug.core.placing import box_of
from aaplug.core.pyramids import Level
from aaplug.io import STREAM_INDEXES, StreamName, stream_pages
from aaplug.io.atomic import make_folder, replacing, write_file
from aaplug.io.rad import MAX_NODE_SIZE, rad_of, tree_of
from aaplug.io.scenes import gltf, read_scene, spz, write_scene
from aaplug.io.scenes.pyramid_folder import MAX_GAUSSIANS
from aaplug.io.scenes.record import MOVED_SHARE
from aaplug.io.scenes.rows import library_errors
from aaplug.io.values import natural, object_of, read_json
from aaplug.system.errors import FormatError, OutputError, UsageError, counted, reason
from aaplug.system.executors import Threads, given_threads

LEAF_GAUSSIANS = 1 << 16  # of the finest level in a part of space
SWITCH = 1.5  # rate at which a viewer should change level, as a multiple of the coarser level's own
TILE_SWITCH = 2.0  # the same of a tile, whose box holds the Gaussians' extents and so begins nearer than they do
PLAYCANVAS_TANGENT = math.tan(math.radians(22.5))  # of half the field of view that its distances are meant for
UPDATE_SHARE = 1 / 16  # of the first distance: PlayCanvas chooses levels again when the camera moved so far
FAR = 16.0  # from here on a scene is far from the origin: its middle's distance over that of its Gaussians from there
ROUNDING = {"sog": 2.0**-20, "rad": 2.0**-11}  # of a position, relative: PlayCanvas's 32-bit exp, Spark's 16-bit floats
MAX_SCREEN_ERROR = 16.0  # px, `maximumScreenSpaceError` of CesiumJS by default
ALWAYS = 1e6  # error of the root over that of the coarsest level, so that something is drawn at any distance
TILE_AXES = [0, 2, 1]  # a scene's (x, y, z) is (-x, -y, z) in glTF and (-x, -z, -y) in a tile, whose z is up
SPLATS = [gltf.SPLATS, gltf.SPZ]
CESIUM = tuple(f"cesium/Build/Cesium/{name}" for name in ("Cesium.js", "Assets", "ThirdParty", "Workers"))
SPARK = "@sparkjsdev/spark/dist/spark.module.min.js"
THREE = (
    "three/build/three.module.min.js",
    "three/build/three.core.min.js",
    "three/examples/jsm/postprocessing/Pass.js",
)
TREE = "tree.npz"  # beside a front's Gaussians, until the index is written
SETTINGS, PAGE = "settings.json", "index.html"
PAGE_SCRIPTS = ("orbit.js", "problems.js")
Middle = Float[Tensor, " 3"]  # in float64
Box = Float[Tensor, "2 3"]  # smallest and largest coordinates
# What is told of a part: the number of its Gaussians, and their smallest and largest coordinates; here of an empty one
NOTHING = [0.0, *[math.inf] * 3, *[-math.inf] * 3]

log = logging.getLogger("aaplug")


@dataclass(frozen=True)
class Stream:
    """The files of a stream, and the viewer that reads them.

    viewer: for whose rule levels are tuned.  index: name of the index.  content: name of a part's file.
    programs: what the page needs, as files or folders of node_modules.
    extent: standard deviations to which a part's box holds its Gaussians.
    """

    viewer: str
    index: str
    content: str
    programs: tuple[str, ...]
    extent: float = 0.0

    def part(self, level: int, leaf: int) -> str:
        """Path of a part, from its level and its part of space."""
        return f"{level}_{leaf}/{self.content}"


STREAMS = {
    "sog": Stream("playcanvas", STREAM_INDEXES["sog"], "meta.json", ("playcanvas/build/playcanvas.min.mjs",)),
    "3dtiles": Stream("cesium", STREAM_INDEXES["3dtiles"], "splats.spz.glb", CESIUM, 3.0),
    "rad": Stream("spark", STREAM_INDEXES["rad"], "front.ply", (SPARK, *THREE)),
}


class Front(NamedTuple):
    """A tree so far: the Gaussians of the finest level, then those above them.

    parents: place of each one's parent; -1 for one without, which is on the front: Spark draws it at the coarsest rate.
    owners: of each on the front, the place of the coarsest level's Gaussian that stands for it.
    """

    scene: Gaussians
    parents: Int[Tensor, " n"]
    owners: Int[Tensor, " f"]

    @classmethod
    def of(cls, finest: Gaussians) -> "Front":
        """The front of the finest level alone."""
        bare = replace(finest, origin=None, extras={}, filter_3d=None)
        return cls(bare, torch.full((len(finest),), -1), torch.arange(len(finest)))


def leaves_of(finest: Level) -> Int[Tensor, " chunks"]:
    """The part of space of each chunk: consecutive ones along the curve share a part until it is full."""
    assert finest.chunks is not None
    return (torch.bincount(finest.chunks).cumsum(0) - 1) // LEAF_GAUSSIANS


def middle_of(scene: Gaussians, name: StreamName) -> Middle:
    """What positions in a stream's files are relative to: `_far_middle` in 3D Tiles, whose index moves them back."""
    return _far_middle(scene) if name == "3dtiles" else torch.zeros(3, dtype=torch.float64)


def _far_middle(scene: Gaussians) -> Middle:
    """The middle of a scene far from the origin; 0 near it."""
    means = scene.means.double()
    middle = means.median(dim=0).values
    return middle * (middle.abs().max() > FAR * (means - middle).abs().median())


def check_positions(path: Path, name: StreamName, scene: Gaussians) -> None:
    """Raise OutputError if a stream cannot hold the scene's positions; warn if its viewer moves them for being far."""
    distances = (scene.means.double() - middle_of(scene, name)).abs().amax(dim=1)
    if name == "3dtiles" and (farthest := float(distances.max())) >= spz.REACH:
        where = f"a position {farthest:g} units from the scene's middle, only below {spz.REACH:,.0f}"
        raise OutputError(path, f"3D Tiles cannot hold {where}; scale the scene by aaplug merge")
    moved = int((distances * ROUNDING.get(name, 0.0) > scene.scales.amax(dim=1)).sum())
    if moved > MOVED_SHARE * len(scene) and _far_middle(scene).any():
        what = f"moves {moved:,} of {counted(len(scene), 'Gaussian')} by more than their size, so far from the origin"
        log.warning("%s: %s %s; move the scene by aaplug merge, or write 3dtiles", path, STREAMS[name].viewer, what)


def parts_of(level: Level, leaves: Int[Tensor, " chunks"], middle: Middle) -> Iterator[Gaussians]:
    """A level's Gaussians by part of space, their positions relative to `middle`."""
    assert level.chunks is not None
    owners = leaves[level.chunks]
    for leaf in range(int(leaves.max()) + 1):
        part = level.scene[(owners == leaf).nonzero().squeeze(1)]
        yield replace(part, means=(part.means.double() - middle).to(part.means.dtype))


def write_level(folder: Path, name: StreamName, number: int, parts: Iterable[Gaussians]) -> None:
    """Write the parts of a level, replacing what is there, in as many threads as torch has; then what indexes tell."""
    stream = STREAMS[name]

    def write(item: tuple[int, Gaussians]) -> list[float]:
        leaf, part = item
        if not len(part):
            return []
        path = folder / stream.part(number, leaf)
        make_folder(path.parent)
        write_scene(path, part, overwrite=True)
        return [float(len(part)), *box_of(part, stream.extent).flatten().tolist()]

    facts = [*Threads(given_threads()).map(write, enumerate(parts))]
    write_file(facts_file(folder, number), json.dumps(facts).encode(), overwrite=True)


def write_front(folder: Path, number: int, front: Front, start: int) -> None:
    """Write the Gaussians that a level adds to the front, from `start` on, and what their tree is with them."""
    path = folder / STREAMS["rad"].part(number, 0)
    make_folder(path.parent)
    if start < len(front.scene):
        write_scene(path, front.scene[start:], overwrite=True)
    else:
        path.unlink(missing_ok=True)  # of an earlier run
    with replacing(path.with_name(TREE), overwrite=True) as stream:
        np.savez(stream, parents=front.parents.numpy(), owners=front.owners.numpy())


def read_front(folder: Path, number: int) -> Front:
    """The front after a level; raises FormatError if a file is damaged or missing."""
    paths = [folder / STREAMS["rad"].part(level, 0) for level in range(number + 1)]
    tree = paths[-1].with_name(TREE)
    with library_errors(tree), np.load(tree, allow_pickle=False) as arrays:
        parents, owners = (torch.from_numpy(arrays[name]) for name in Front._fields[1:])
    parts = [read_scene(path).gaussians() for path in paths if path.is_file()]
    total, tops = sum(map(len, parts)), int((parents < 0).sum())
    if len(parents) != total or len(owners) != tops:
        raise FormatError(tree, f"does not belong to the {total:,} Gaussians beside it")
    return Front(joined([replace(part, origin=None) for part in parts]), parents, owners)


def facts_file(folder: Path, number: int) -> Path:
    """The file with an index's facts about a level's parts, kept until the index is written."""
    return folder / f"parts_{number}.json"


def part_folders(folder: Path, name: StreamName) -> set[Path]:
    """The folders of the parts that the index in a folder lists; none without an index, and none of a .rad."""
    stream = STREAMS[name]
    if name == "rad":
        return set()
    text = (folder / stream.index).read_text("utf-8", "replace") if (folder / stream.index).is_file() else ""
    return {folder / part for part in re.findall(rf'"(\d+_\d+)/{re.escape(stream.content)}"', text)}


def remove_parts(folders: Iterable[Path], name: StreamName) -> None:
    """Remove what `write_level` or `write_front` wrote into these folders, and those that are empty then."""
    for folder in folders:
        for file in [folder / STREAMS[name].content, *folder.glob(TREE if name == "rad" else "*.webp")]:
            file.unlink(missing_ok=True)
        with suppress(OSError):
            folder.rmdir()


def front_folders(folder: Path) -> Iterator[Path]:
    """The folders that `write_front` wrote into, of consecutive levels; nobody needs them once the index is written."""
    paths = ((folder / STREAMS["rad"].part(number, 0)).parent for number in count())
    return takewhile(lambda path: (path / TREE).is_file() or (path / STREAMS["rad"].content).is_file(), paths)


def write_index(
    folder: Path,
    name: StreamName,
    levels: int,
    rate: float,
    frame: Frame,
    compensated: bool = True,
    tree: Front | None = None,
    middle: Middle | None = None,
) -> Mapping[str, Any]:
    """Write the index of so many levels, and what the viewer must be set to; returns the latter.

    rate: of training, in px per world unit.  frame: what a page shows first.
    compensated: levels are for a rule with compensation.  tree: of a .rad.
    middle: what the parts are relative to; see `middle_of`.
    """
    stream = STREAMS[name]
    if tree is not None:
        content, settings = rad_of(tree_of(tree.scene, tree.parents)), _spark_settings(tree)
    else:
        with library_errors(folder):
            parts = torch.stack([_read_parts(folder, stream, number) for number in range(levels)])
        index, settings = {"sog": _lod_meta, "3dtiles": _tileset}[name](stream, parts, rate)
        if middle is not None and name == "3dtiles":
            index["root"]["transform"][12:15] = (0.0 - middle[TILE_AXES]).tolist()  # no -0.0
        content = json.dumps(index, indent=1).encode()
        if name == "sog":
            settings["app.scene.gsplat"]["antiAlias"] = compensated
    view = {name: getattr(frame, name).tolist() for name in ("up", "front", "centre")} | {"radius": frame.radius}
    told = json.dumps({**settings, "levels": levels, "view": view}, indent=1).encode()
    write_file(folder / SETTINGS, told, overwrite=True)
    write_file(folder / stream.index, content, overwrite=True)  # last: it is the mark
    return settings


def level_count(folder: Path, name: StreamName) -> int:
    """Levels of a complete stream; 0 of one that is cut short.  Raises FormatError if its settings are damaged."""
    if not (folder / STREAMS[name].index).exists():
        return 0
    settings = object_of(read_json(folder / SETTINGS), folder / SETTINGS, "the settings", "'levels'", "levels")
    return natural(settings.value("levels"), settings.place, "levels", MAX_GAUSSIANS)


def _read_parts(folder: Path, stream: Stream, level: int) -> Float[Tensor, "leaves 7"]:
    """The facts that `write_level` wrote about a level's parts, whose files must be there."""
    path = facts_file(folder, level)
    with library_errors(path):
        facts = torch.tensor([fact or NOTHING for fact in read_json(path)], dtype=torch.float64).view(-1, len(NOTHING))
    for leaf in facts[:, 0].nonzero()[:, 0].tolist():
        if not (content := folder / stream.part(level, leaf)).is_file():
            raise FormatError(content, f"is missing: {path.name} lists it; `aaplug lod --overwrite` makes all again")
    return facts


def programs_of(name: StreamName, modules: Path) -> list[Path]:
    """The programs of the page in a folder node_modules; raises UsageError if one is not there."""
    programs = STREAMS[name].programs
    for program in programs:
        if not (modules / program).exists():
            packages = " ".join(dict.fromkeys(re.findall(r"^(?:@[^/]+/)?[^/]+", "\n".join(programs), re.MULTILINE)))
            raise UsageError("page", f"{modules} does not hold {program}: `npm install {packages}` makes it")
    return [modules / program for program in programs]


def write_page(folder: Path, name: StreamName, modules: Path) -> None:
    """Write index.html and its scripts, which open the levels, and the viewer's program into viewer/ beside them.

    A browser reads them from a server, such as `python -m http.server`; nothing is fetched from elsewhere.
    """
    viewer = make_folder(folder / "viewer")
    try:
        for program in programs_of(name, modules):
            if program.is_dir():
                shutil.copytree(program, viewer / program.name, dirs_exist_ok=True)
            else:
                shutil.copy(program, viewer)
    except OSError as error:
        raise OutputError(viewer, f"cannot be written: {reason(error)}") from error
    source = files(stream_pages)
    page = source.joinpath(f"{name}.html").read_bytes()
    for script in PAGE_SCRIPTS:
        if script.encode() in page:
            write_file(folder / script, source.joinpath(script).read_bytes(), overwrite=True)
    write_file(folder / PAGE, page, overwrite=True)


Indexed = tuple[dict[str, Any], dict[str, Any]]  # an index, and the viewer's settings


def _lod_meta(stream: Stream, parts: Float[Tensor, "levels leaves 7"], rate: float) -> Indexed:
    def bound(some: Float[Tensor, "*n 7"]) -> dict[str, list[float]]:
        return dict(zip(("min", "max"), _box(some).tolist(), strict=True))

    counts, filenames, children = parts[..., 0].sum(dim=1).long().tolist(), [], []
    for leaf, levels in enumerate(parts.unbind(dim=1)):
        lods = {}
        for number, part in enumerate(levels):
            if part[0]:
                lods[str(number)] = {"file": len(filenames), "offset": 0, "count": int(part[0])}
                filenames.append(stream.part(number, leaf))
        children.append({"bound": bound(levels), "lods": lods})
    tree = {"bound": bound(parts), "children": children}
    facts = {"version": 1, "asset": {"generator": "aaplug"}, "count": counts[0], "counts": counts}
    settings = {
        "app.scene.gsplat": {"antiAlias": True, "splatBudgetMode": "limit", "splatBudget": 0},
        "gsplat component": {"lodMultiplier": 2.0},
        "lodBaseDistance per px of the image's height": 1 / (PLAYCANVAS_TANGENT * SWITCH * rate),
        "lodUpdateDistance per lodBaseDistance": UPDATE_SHARE,
    }
    return facts | {"lodLevels": len(counts), "filenames": filenames, "tree": tree}, settings


def _tileset(stream: Stream, parts: Float[Tensor, "levels leaves 7"], rate: float) -> Indexed:
    def error(number: int) -> float:
        return MAX_SCREEN_ERROR * 2.0**number / (TILE_SWITCH * rate)

    tiles = []
    for leaf, levels in enumerate(parts.unbind(dim=1)):
        volume, tile = _volume(_box(levels)), None
        for number, part in enumerate(levels):
            if part[0]:
                finer = {} if tile is None else {"children": [tile]}
                content = {"content": {"uri": stream.part(number, leaf)}}
                about = {"boundingVolume": volume, "geometricError": error(number) if finer else 0.0}
                tile = {**about, "refine": "REPLACE", **content, **finer}
        tiles.append(tile)
    root = {
        "transform": torch.eye(4).flatten().tolist(),
        "boundingVolume": _volume(_box(parts)),
        "geometricError": ALWAYS * error(len(parts) - 1),
        "refine": "REPLACE",
        "children": tiles,
    }
    extension = {"extensionsUsed": SPLATS, "extensionsRequired": SPLATS}
    counts = parts[..., 0].sum(dim=1).long().tolist()
    index = {
        "asset": {"version": "1.1", "generator": "aaplug", "extras": {"counts": counts}},
        "extensionsUsed": ["3DTILES_content_gltf"],
        "extensions": {"3DTILES_content_gltf": extension},
        "geometricError": root["geometricError"],
        "root": root,
    }
    return index, {"Cesium3DTileset": {"maximumScreenSpaceError": MAX_SCREEN_ERROR, "dynamicScreenSpaceError": False}}


def _spark_settings(front: Front) -> dict[str, Any]:
    """Settings of Spark by which neither its budget nor splats packed into 16 bytes lower the detail."""
    leaves, rule = len(front.scene) - len(front.parents[front.parents >= 0].unique()), front.scene.convention
    blur = {"preBlurAmount": 0.0, "blurAmount": 0.0, "blurAmount" if rule.compensated else "preBlurAmount": rule.kernel}
    budget = {"lodSplatCount": leaves, "lodRenderScale": MAX_NODE_SIZE}
    return {"SparkRenderer": blur | budget | {"accumExtSplats": True}}


def _box(parts: Float[Tensor, "*n 7"]) -> Box:
    """The box around the boxes of parts."""
    return torch.stack([parts[..., 1:4].reshape(-1, 3).amin(dim=0), parts[..., 4:].reshape(-1, 3).amax(dim=0)])


def _volume(box: Box) -> dict[str, list[float]]:
    """A tile's box, in its axes."""
    middle, half = -box.mean(dim=0)[TILE_AXES], ((box[1] - box[0]) / 2)[TILE_AXES]
    return {"box": [*middle.tolist(), *torch.diag(half).flatten().tolist()]}
