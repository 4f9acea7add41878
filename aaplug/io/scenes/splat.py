"""antimatter15's .splat: records of 32 bytes and nothing else, read and written.

Position and scales (float32, linear), colour and opacity (bytes), quaternion wxyz (bytes, 128 is 0).  The format has no
header, no harmonics above degree 0, and does not say how the scene was trained, so it is recognized by its suffix.
"""

from collections.abc import Iterable
from functools import partial
from pathlib import Path

import numpy as np
import torch

from aaplug.core.gaussians import Gaussians
from aaplug.io.atomic import replacing
from aaplug.io.scenes.packed import byte_opacities, bytes_of, floats, sh_of_colour
from aaplug.io.scenes.record import holdable
from aaplug.io.scenes.rows import SceneFileOptions, by_name, library_errors, read_rows
from aaplug.io.scenes.scene import Scene
from aaplug.system.errors import FormatError, OutputError

RECORD = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("quats", "u1", 4)])
MOST_DEGREE = 4  # of harmonics, of which degree 0 is written
ZERO_BYTE = 128  # the byte that stands for a quaternion component of 0
EVIDENCE = "the format does not say: assumed classic (3DGS default)"

name = "splat"
sniff = by_name(".splat")


def open_scene(path: Path, options: SceneFileOptions) -> Scene:
    """See `SceneFormat`."""
    with library_errors(path):
        size = path.stat().st_size
    if size % RECORD.itemsize:
        what = f"has {size:,} bytes, which is not a multiple of {RECORD.itemsize}"
        raise FormatError(path, f"{what}; it is cut short or not a .splat")
    count = size // RECORD.itemsize
    return Scene(path, name, count, 0, partial(_rows, path), EVIDENCE)


def write(path: Path, parts: Iterable[Gaussians], count: int, overwrite: bool, options: SceneFileOptions) -> None:
    """Write a scene part by part; harmonics above degree 0 and the convention are lost, as a warning says."""
    with replacing(path, overwrite) as stream:
        for part in parts:
            scene, records = holdable(path, part, name, MOST_DEGREE), np.zeros(len(part), RECORD)
            records["means"], records["scales"] = scene.means.numpy(), scene.scales.numpy()
            records["rgba"] = bytes_of(torch.cat([scene.base_colours, scene.opacities[:, None]], dim=1) * 255)
            records["quats"] = bytes_of(scene.unit_quats * ZERO_BYTE + ZERO_BYTE)
            stream.write(records.tobytes())
        if not stream.tell():
            raise OutputError(path, "cannot hold a scene without Gaussians; write a .ply")


def _rows(path: Path, start: int, stop: int) -> Gaussians:
    records = read_rows(path, RECORD, start, stop)
    rgba = records["rgba"]
    means, quats = floats(records["means"]), (floats(records["quats"]) - ZERO_BYTE) / ZERO_BYTE
    sh = sh_of_colour(floats(rgba[:, :3]) / 255)[:, None]
    return Gaussians(means, quats, floats(records["scales"]).log(), byte_opacities(rgba[:, 3]), sh)
