"""Writes .spz of version 3, which every reader of the format knows, by gsply (the extra `spz`).

gsply packs the numbers.  This module adds what it leaves out: the axes of the specification (see `spz`), the flag for
antialiased training, as many bits of a position's fraction as the scene allows, and atomic writing.  The format cannot
record the kernel or what aaplug fused into a scene.
"""

import gzip
import math
import tempfile
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

import numpy as np
import torch

from aaplug.core.errors import OutputError
from aaplug.core.gaussians import Gaussians
from aaplug.io.atomic import replacing
from aaplug.io.scenes.options import Options
from aaplug.io.scenes.packed import half_turn_about_x
from aaplug.io.scenes.scene_file import library_errors

VERSION = 3
MOST_GAUSSIANS = 10_000_000  # accepted by readers of versions before 4 (nianticlabs/spz)
MOST_DEGREE = 3  # of harmonics that gsply writes
POSITION_BITS = 23  # of a position's fixed-point number, beside its sign
MOST_FRACTION = 20  # bits: a millionth of a unit
FLAGS = 14  # byte of the header
ANTIALIASED_FLAG = 1
MAX_LOGIT = 30.0  # in float32 its opacity is 1
# between the axes of the file and OpenCV's, in both directions
TURNS: Mapping[str, Callable[[Gaussians], Gaussians]] = {"opengl": half_turn_about_x, "opencv": lambda scene: scene}


def write(path: Path, parts: Iterable[Gaussians], count: int, overwrite: bool, options: Options) -> None:
    """Write a scene, with values rounded to the format's steps."""
    turn = TURNS[options.spz_axes]
    scenes = [turn(_checked(path, part)) for part in parts]
    content = _packed(path, scenes)
    with replacing(path, overwrite) as stream:
        stream.write(content)


def _checked(path: Path, part: Gaussians) -> Gaussians:
    """The part; refuses what the format cannot hold."""
    if part.flat:
        raise OutputError(path, "cannot hold 2D Gaussians; write a .ply")
    if part.filter_3d is not None:
        raise OutputError(path, "cannot hold a filter_3D; aaplug convert fuses it")
    if part.sh_degree > MOST_DEGREE:
        raise OutputError(
            path, f"gsply writes harmonics up to degree {MOST_DEGREE}, not {part.sh_degree}; write a .ply"
        )  # fmt: skip
    return part


def _packed(path: Path, scenes: list[Gaussians]) -> bytes:
    count = sum(map(len, scenes))
    if count > MOST_GAUSSIANS:
        raise OutputError(path, f"readers take {MOST_GAUSSIANS:,} Gaussians, not {count:,}; write a .ply")
    from gsply.gsdata import GSData  # an optional package, and slow to import
    from gsply.spz import write_spz

    def column(values: Callable[[Gaussians], torch.Tensor]) -> np.ndarray:
        return torch.cat([values(scene) for scene in scenes]).contiguous().numpy()

    means = column(lambda s: s.means)
    with library_errors(path), tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "scene.spz"
        data = GSData.from_arrays(
            means=means,
            scales=column(lambda s: s.log_scales),
            quats=column(lambda s: s.unit_quats),
            opacities=column(lambda s: s.logit_opacities.clamp(-MAX_LOGIT, MAX_LOGIT)),
            sh0=column(lambda s: s.sh[:, 0]),
            shN=column(lambda s: s.sh[:, 1:]),
            format="ply",
        )
        write_spz(file, data, version=VERSION, fractional_bits=_fraction(path, means))
        content = bytearray(gzip.decompress(file.read_bytes()))
    content[FLAGS] = ANTIALIASED_FLAG * scenes[0].convention.compensated
    return gzip.compress(content, mtime=0)


def _fraction(path: Path, means: np.ndarray) -> int:
    """Bits of the fraction with which the farthest position still fits."""
    farthest = float(np.abs(means).max(initial=0.0))
    room = POSITION_BITS - math.frexp(farthest)[1] if farthest else MOST_FRACTION
    if room < 1:
        raise OutputError(path, f"cannot hold positions as far as {farthest:g} from the origin; write a .ply")
    return min(room, MOST_FRACTION)
