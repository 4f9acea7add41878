"""Mip-NeRF's multi-scale Blender datasets: `metadata.json`, a list per property and split.

{train: {file_path, cam2world, width, height, focal, label, ...}, test: ...}, each value a list with an entry per photo.
cam2world: 4×4, OpenGL axes; sizes and focal length in px.  A photo at another scale is a view of its own, trained at
its own size.
"""

import os
from pathlib import Path

from aaplug.core.cameras import WHITE, Camera, CameraSet
from aaplug.core.errors import UsageError
from aaplug.io.cameras.options import Options, explicit, undivided
from aaplug.io.cameras.photos import PhotoFolder, distinct, last_part, refuse_folder, without_suffix
from aaplug.io.cameras.poses import centred, inverse, pose_of_opengl, rigid
from aaplug.io.cameras.sizes import described_sizes, file_sizes, trained_at
from aaplug.io.values import Entry, Place, focal, mentions, object_of, pixels, read_json, text

FILE = "metadata.json"
COLUMNS = ("file_path", "cam2world", "width", "height", "focal")

name = "multiscale"
sign = "metadata.json (multi-scale Blender)"


def sniff(path: Path) -> bool:
    """Whether a folder's metadata.json, or the file, has these keys."""
    file = path / FILE if os.path.isdir(path) else path
    return mentions(file, ["cam2world"]) and mentions(file, ["file_path"])


def read(path: Path, options: Options) -> CameraSet:
    """The cameras of all scales, with the split that the file gives."""
    refuse_folder(options)
    if options.test_every is not None:
        raise UsageError("test_every", f"{FILE} gives the split; leave it out")
    file = path / FILE if os.path.isdir(path) else path
    document = object_of(read_json(file), file, "it", "'train', as multi-scale Blender datasets have", "train")
    train, test = (_cameras(document, split) if split in document else [] for split in ("train", "test"))
    trained, held = (trained_at(v, file_sizes(v, options)[0]) for v in (train, test))
    split = explicit(trained, held, FILE) if held else undivided(trained, f"no test in {FILE}")
    what = f"multi-scale Blender: {len(train) + len(test)} cameras, {described_sizes(train)}"
    size = "training size: each photo's own, as all scales were trained on"
    return CameraSet(split.train, split.test, WHITE, (what, split.note, size, "background: white, Blender's custom"))


def _cameras(document: Entry, split: str) -> list[Camera]:
    columns, file = document.entry(split), document.place.file
    lists = [values for key in COLUMNS if isinstance(values := columns.fields.get(key), list)]
    lengths = {len(values) for values in lists}
    if len(lists) != len(COLUMNS) or len(lengths) != 1 or 0 in lengths:
        raise columns.place.error(f"{', '.join(COLUMNS)} should be lists of one length")
    rows = zip(*lists, strict=True)
    found = [Entry(Place(file, f"{split} {i}"), dict(zip(COLUMNS, row, strict=True))) for i, row in enumerate(rows)]
    paths = [entry.get("file_path", text) for entry in found]
    names = distinct(file, paths, (last_part, without_suffix, str))
    folder = PhotoFolder(file.parent, file.parent)
    return [_camera(entry, name, folder) for entry, name in zip(found, names, strict=True)]


def _camera(entry: Entry, name: str, folder: PhotoFolder) -> Camera:
    motion = rigid(entry, "cam2world")
    world_from_cam = pose_of_opengl(motion, entry.place, "cam2world")
    size, f = (entry.get("width", pixels), entry.get("height", pixels)), entry.get("focal", focal)
    cam_from_world = inverse(world_from_cam, entry.place, "cam2world")
    return centred(name, size, (f, f), cam_from_world, folder.find(entry.get("file_path", text), entry.place))
