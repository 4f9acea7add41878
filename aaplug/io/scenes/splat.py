"""antimatter15's .splat: 32 bytes a Gaussian and nothing else, read and written.

Position and scales (float32, linear), colour with opacity (bytes), quaternion wxyz (bytes, 128 is 0).  No harmonics
beyond degree 0, and no word on how the scene was trained, so it is known by its name and its size.
"""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import torch

from aaplug.core.errors import FormatError
from aaplug.core.gaussians import Gaussians
from aaplug.io.atomic import replacing
from aaplug.io.scenes.packed import byte_opacities, floats
from aaplug.io.scenes.scene_file import C0, SceneFile, check_count, library_errors, sh_of_colour

RECORD = np.dtype(
    [("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("quats", "u1", 4)]
)
ZERO = 128  # the byte of a quaternion's 0
EVIDENCE = "the format does not say: assumed classic (3DGS default)"

name = "splat"


def sniff(path: Path, head: bytes) -> bool:
    """Whether the file is called .splat; its content has no sign."""
    return path.suffix.lower() == ".splat"


def open_scene(path: Path) -> SceneFile:
    """Look at a scene; see `aaplug.io.scenes.open_scene`.

    Raises:
        FormatError: the file does not hold whole records.
    """
    with library_errors(path):
        size = path.stat().st_size
    if size % RECORD.itemsize:
        raise FormatError(
            path, f"has {size:,} bytes, which is no multiple of {RECORD.itemsize}; it is cut short or no .splat"
        )  # fmt: skip
    count = size // RECORD.itemsize
    check_count(path, count)
    return SceneFile(path, name, count, 0, lambda a, b: _rows(path, a, b), EVIDENCE)


def write(path: Path, parts: Iterable[Gaussians], count: int, overwrite: bool) -> None:
    """Write a scene part by part; harmonics beyond degree 0 and the convention are lost.

    Raises:
        OutputError: the file exists and `overwrite` is false, or it cannot be written.
    """
    with replacing(path, overwrite) as stream:
        for part in parts:
            stream.write(_records(part).tobytes())


def _rows(path: Path, start: int, stop: int) -> Gaussians:
    with library_errors(path):
        records = np.fromfile(path, RECORD, stop - start, offset=start * RECORD.itemsize)
    if len(records) != stop - start:
        raise FormatError(path, "was cut short while it was being read")
    rgba = records["rgba"]
    return Gaussians(
        floats(records["means"]),
        (floats(records["quats"]) - ZERO) / ZERO,
        floats(records["scales"]).log(),
        byte_opacities(rgba[:, 3]),
        sh_of_colour(floats(rgba[:, :3]) / 255)[:, None],
    )


def _records(scene: Gaussians) -> np.ndarray:
    records = np.zeros(len(scene), RECORD)
    rgb = 0.5 + C0 * scene.sh[:, 0]
    rgba = torch.cat([rgb, scene.opacities[:, None]], dim=1)
    records["means"] = scene.means.numpy()
    records["scales"] = scene.scales.numpy()
    records["rgba"] = (rgba.clamp(0, 1) * 255).round().numpy()
    records["quats"] = (scene.unit_quats * ZERO + ZERO).round().clamp(0, 255).numpy()
    return records
