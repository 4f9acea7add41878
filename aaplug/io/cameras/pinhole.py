"""Plain pinholes in JSON: one object, or a list of them.

{width, height, fx, fy, cx, cy, world_to_camera}.  Sizes, focal lengths and principal point are in px;
world_to_camera is 4×4, row by row, OpenCV axes.
"""

from functools import partial
from pathlib import Path

from aaplug.core.cameras import Camera, CameraSet, numbered
from aaplug.io.cameras.poses import rigid
from aaplug.io.cameras.sets import CameraFileOptions, at_file_size, camera_set, every_nth
from aaplug.io.values import entries, focal, mentions, number, pixels, read_json

name = "pinhole"
sign = "a JSON file with world_to_camera"
sniff = partial(mentions, keys=["world_to_camera"])


def read(path: Path, options: CameraFileOptions) -> CameraSet:
    """The cameras; a single one is named after its file, those of a list by their numbers."""
    document = read_json(path)
    alone = isinstance(document, dict)
    items = entries(path, "camera", [document] if alone else document)
    names = [path.stem] if alone else numbered(len(items), "camera_")
    source = list[Camera]()
    for item, name in zip(items, names, strict=True):
        width, height = item.get("width", pixels), item.get("height", pixels)
        fx, fy, cx, cy = item.get("fx", focal), item.get("fy", focal), item.get("cx", number), item.get("cy", number)
        source.append(Camera(name, width, height, fx, fy, cx, cy, rigid(item, "world_to_camera")))
    trained, why = at_file_size(source, options)
    split = every_nth(trained, options, 0, "the format has no split")
    return camera_set("pinhole JSON", source, split, why)
