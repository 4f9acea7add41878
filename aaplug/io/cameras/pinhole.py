"""Plain pinholes in JSON: one object, or a list of them.

{width, height, fx, fy, cx, cy, world_to_camera}.  Sizes, focal lengths and principal point are in px;
world_to_camera is 4×4, row by row, OpenCV axes.
"""

from functools import partial
from pathlib import Path

from aaplug.core.cameras import Camera, CameraSet, numbered
from aaplug.io.cameras.photos import refuse_folder
from aaplug.io.cameras.poses import pose, rigid
from aaplug.io.cameras.sets import CameraFileOptions, at_file_size, camera_set, every_nth
from aaplug.io.values import Entry, entries, focal, mentions, number, pixels, read_json

name = "pinhole"
sign = "a JSON file with world_to_camera"
sniff = partial(mentions, keys=["world_to_camera"])


def read(path: Path, options: CameraFileOptions) -> CameraSet:
    """The cameras; a single one is named after its file, those of a list by their numbers."""
    refuse_folder(options)
    document = read_json(path)
    alone = isinstance(document, dict)
    items = entries(path, "camera", [document] if alone else document)
    names = [path.stem] if alone else numbered(len(items), "camera_")
    source = [_camera(item, name) for item, name in zip(items, names, strict=True)]
    trained, why = at_file_size(source, options)
    split = every_nth(trained, options, 0, "the format has no split")
    return camera_set("pinhole JSON", source, split, why)


def _camera(entry: Entry, name: str) -> Camera:
    motion = rigid(entry, "world_to_camera")
    cam_from_world = pose(motion[:3, :3], motion[:3, 3], entry.place, "world_to_camera")
    width, height = entry.get("width", pixels), entry.get("height", pixels)
    fx, fy, cx, cy = entry.get("fx", focal), entry.get("fy", focal), entry.get("cx", number), entry.get("cy", number)
    return Camera(name, width, height, fx, fy, cx, cy, cam_from_world)
