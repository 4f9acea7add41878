"""The camera in a .ply that SHARP made of one photograph (Mescheder et al. 2025, arXiv 2512.10685).

Beside its Gaussians the file has tables of one column each, which has the table's name: image_size, width and height in
px; intrinsic, a 3×3 matrix in px, row by row; extrinsic, `cam_from_world`, 4×4, row by row, OpenCV axes.
"""

from pathlib import Path

import numpy as np

from aaplug.core.cameras import Camera, CameraSet
from aaplug.io.cameras.poses import rigid
from aaplug.io.cameras.sets import CameraFileOptions, at_file_size, camera_set, every_nth
from aaplug.io.ply_header import BIG, TEXT, Header, check_size, read_header
from aaplug.io.values import Entry, Place, focal, number, pixels, read_part, read_start
from aaplug.system.errors import FormatError

SHAPES = {"image_size": (2,), "intrinsic": (3, 3), "extrinsic": (4, 4)}  # of the tables' values
MAGIC = b"ply"

name = "sharp"
sign = "a .ply of SHARP, with its camera"


def sniff(path: Path) -> bool:
    """True for a binary .ply with these tables, where no table before them has lists."""
    try:
        return read_start(path, len(MAGIC)) == MAGIC and has_camera(read_header(path))
    except FormatError:  # no file, or damaged, as reading its scene tells
        return False


def has_camera(header: Header) -> bool:
    """True if the tables are there, each with as many values as it needs."""
    tables = {element.name: element for element in header.elements}
    names = [(table, tables[table].count, [*tables[table].codes]) for table in SHAPES if table in tables]
    whole = names == [(table, int(np.prod(shape)), [table]) for table, shape in SHAPES.items()]
    return whole and header.coding != TEXT and not any(element.lists for element in header.elements)


def read(path: Path, options: CameraFileOptions) -> CameraSet:
    """The camera, named after the file."""
    header = read_header(path)
    check_size(header, path.stat().st_size)
    entry = Entry(Place(path, "its camera"), {})
    for element in header.elements:
        if element.name in SHAPES:
            dtype = element.dtype.newbyteorder(">" if header.coding == BIG else "<")
            data = read_part(path, header.start_of(element), element.least_size)
            values = np.frombuffer(data, dtype)[element.name]
            entry.fields[element.name] = values.reshape(SHAPES[element.name]).tolist()
    cam_from_world, intrinsic = rigid(entry, "extrinsic"), entry.value("intrinsic")
    (fx, skew, cx), (zero, fy, cy), last = intrinsic
    entry.place.expect([skew, zero, *last] == [0, 0, 0, 0, 1], "intrinsic", "[[fx 0 cx] [0 fy cy] [0 0 1]]", intrinsic)
    width, height = (pixels(side, entry.place, "image_size") for side in entry.value("image_size"))
    fx, fy = (focal(value, entry.place, "intrinsic") for value in (fx, fy))
    cx, cy = (number(value, entry.place, "intrinsic") for value in (cx, cy))
    source = [Camera(path.stem, width, height, fx, fy, cx, cy, cam_from_world)]
    trained, why = at_file_size(source, options)
    why = "the photograph's" if options.train_scale is None else why  # whose width nothing caps
    return camera_set("SHARP's photograph", source, every_nth(trained, options, 0, "one photograph"), why)
