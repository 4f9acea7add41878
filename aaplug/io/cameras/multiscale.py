"""Mip-NeRF's multi-scale Blender datasets: `metadata.json`, a list per property and split.

{train: {file_path, cam2world, width, height, focal, label, ...}, test: ...}, each value a list with an entry per photo.
cam2world: 4×4, OpenGL axes; sizes and focal length in px.  A photo at another scale is a view of its own, trained at
its own size.
"""

import os
from dataclasses import replace
from pathlib import Path

from aaplug.core.cameras import Camera, CameraSet, centred
from aaplug.core.colours import WHITE
from aaplug.io.cameras.photos import PhotoFolder, distinct, last_part, without_suffix
from aaplug.io.cameras.poses import inverse, rigid
from aaplug.io.cameras.sets import CameraFileOptions, at_file_size, described_sizes, explicit, undivided
from aaplug.io.values import Entry, Place, focal, mentions, object_of, pixels, read_json, text
from aaplug.system.errors import UsageError, counted

FILE = "metadata.json"
COLUMNS = ("file_path", "cam2world", "width", "height", "focal")

name = "multiscale"
sign = "metadata.json (multi-scale Blender)"


def sniff(path: Path) -> bool:
    """True for a folder whose metadata.json, and for a file that, has these keys."""
    file = path / FILE if os.path.isdir(path) else path
    return mentions(file, ["cam2world"]) and mentions(file, ["file_path"])


def read(path: Path, options: CameraFileOptions) -> CameraSet:
    """The cameras of all scales, with the split that the file gives."""
    if options.test_every is not None:
        raise UsageError("test_every", f"{FILE} gives the split; leave it out")
    file = path / FILE if os.path.isdir(path) else path
    document = object_of(read_json(file), file, "it", "'train', as multi-scale Blender datasets have", "train")
    train, test = (_cameras(document, split) if split in document else [] for split in ("train", "test"))
    trained, held_out = (at_file_size(views, options)[0] for views in (train, test))
    split = explicit(trained, held_out, FILE) if held_out else undivided(trained, f"no test in {FILE}")
    what = f"multi-scale Blender: {counted(len(train) + len(test), 'camera')}, {described_sizes(train)}"
    size = "training size: each photo's own, as all scales were trained on"
    notes = what, *split.notes, size, "background: white, Blender's custom"
    unread = (f"val in {FILE} is not read",) if "val" in document else ()
    return replace(split, background=WHITE, notes=notes + unread)


def _cameras(document: Entry, split: str) -> list[Camera]:
    columns, file = document.entry(split), document.place.file
    lists = [values for key in COLUMNS if isinstance(values := columns.fields.get(key), list)]
    lengths = {len(values) for values in lists}
    if len(lists) != len(COLUMNS) or len(lengths) != 1 or 0 in lengths:
        raise columns.place.error(f"{', '.join(COLUMNS)} should be lists of one length")
    rows = zip(*lists, strict=True)
    items = [Entry(Place(file, f"{split} {i}"), dict(zip(COLUMNS, row, strict=True))) for i, row in enumerate(rows)]
    paths = [item.get("file_path", text) for item in items]
    names = distinct(file, paths, (last_part, without_suffix, str))
    folder, cameras = PhotoFolder(file.parent, file.parent), list[Camera]()
    for item, name, photo in zip(items, names, paths, strict=True):
        size, f = (item.get("width", pixels), item.get("height", pixels)), item.get("focal", focal)
        cam_from_world = inverse(rigid(item, "cam2world", opengl=True))
        cameras.append(centred(name, size, f, cam_from_world, folder.find(photo, item.place)))
    return cameras
