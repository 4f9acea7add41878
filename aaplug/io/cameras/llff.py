"""LLFF's `poses_bounds.npy`: a row of 17 numbers per view, in the order of the photos' names.

3×5, row by row: camera-to-world rotation and position, and (height, width, focal) in px; then the nearest and farthest
depth.  The rotation's columns are the camera's axes down, right and back.
"""

import os
import warnings
from pathlib import Path

import numpy as np
import torch

from aaplug.core.cameras import Camera, CameraSet, centred
from aaplug.io.cameras import sets
from aaplug.io.cameras.photos import SUFFIXES, last_part, photo_folder
from aaplug.io.cameras.poses import inverse, pose
from aaplug.io.cameras.sets import CameraFileOptions
from aaplug.io.limits import whole_limit
from aaplug.io.values import Place, focal, number, pixels, read_bounded, visible
from aaplug.system.errors import FormatError

FILE = "poses_bounds.npy"
COLUMNS = 17

name = "llff"
sign = "poses_bounds.npy (LLFF)"


def sniff(path: Path) -> bool:
    """True for the file, and for a folder that holds it."""
    return path.name == FILE or os.path.isfile(path / FILE)


def read(path: Path, options: CameraFileOptions) -> CameraSet:
    """The cameras at the size of their photos, every 8th a test view."""
    file = path / FILE if os.path.isdir(path) else path
    read_bounded(file, whole_limit("JSON"))
    try:
        with warnings.catch_warnings(action="ignore"):  # numpy's, about the file's age
            rows = np.load(file, mmap_mode="r", allow_pickle=False)  # mapping refuses more than the file has
    except Exception as error:  # numpy raises ValueError, EOFError, SyntaxError and others
        raise FormatError(file, "is not a .npy file of numbers") from error
    if not (isinstance(rows, np.ndarray) and rows.ndim == 2 and rows.shape[1] == COLUMNS and len(rows)):
        raise FormatError(file, f"should hold rows of {COLUMNS} numbers, not the shape {getattr(rows, 'shape', '?')}")
    if rows.dtype.kind != "f":
        raise FormatError(file, f"should hold floats, not {rows.dtype}")
    folder = photo_folder(file.parent, options, "images", Place(file, "images"))
    names = [p.name for p in visible(folder.folder) if p.suffix.lower() in SUFFIXES]
    photos = len(names)
    if photos != len(rows):
        names = [f"{i:03}" for i in range(len(rows))]
    source = list[Camera]()
    for i, (row, name) in enumerate(zip(rows, names, strict=True)):
        place = Place(file, f"row {i}")
        values = [number(float(value), place, "it") for value in row]
        matrix = torch.tensor(values[:15], dtype=torch.float64).reshape(3, 5)
        height, width = (pixels(matrix[k, 4].item(), place, field) for k, field in enumerate(("height", "width")))
        f = focal(matrix[2, 4].item(), place, "focal length")
        down, right, back = matrix[:, :3].unbind(dim=1)
        world_from_cam = pose(torch.stack([right, down, -back, matrix[:, 3]], dim=1), place, "rotation")
        source.append(centred(last_part(name), (width, height), f, inverse(world_from_cam), folder.find(name, place)))
    folder.check(source)
    uneven = f"photos: {folder.folder.name} holds {photos} and the file {len(rows)} poses, so none is used"
    more = folder.notes(source) if photos in (0, len(rows)) else [uneven]
    trained, why = sets.at_photo_size(source, options)
    split = sets.every_nth(trained, options, sets.LLFF_HOLD, "LLFF's rule; `test_every` 0 for no split")
    return sets.camera_set(f"LLFF {FILE}", source, split, why, more=more)
