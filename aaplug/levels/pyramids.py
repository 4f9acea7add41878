"""Building a pyramid, level by level, and reading one again."""

from collections.abc import Iterator, Sequence
from os import PathLike
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Int
from torch import Tensor

from aaplug.core.errors import FormatError
from aaplug.core.gaussians import Gaussians
from aaplug.core.pyramids import Pyramid
from aaplug.io.scenes import read_scene
from aaplug.io.scenes.manifests import MANIFEST, Manifest, path_of, read_manifest
from aaplug.levels.chunks import chunks_of


class Level(NamedTuple):
    """A lighter scene.

    rate: the lowest sampling rate relative to training's that it is meant for.
    chunks: of each Gaussian; None if it belongs to no pyramid.
    """

    scene: Gaussians
    rate: float
    chunks: Int[Tensor, " n"] | None = None


def pyramid_of(levels: Sequence[Level]) -> Pyramid:
    """The pyramid of these levels, the finest first."""
    chunks = [level.chunks for level in levels if level.chunks is not None]
    return Pyramid.of([level.scene for level in levels], chunks)


def read_pyramid(folder: str | PathLike[str]) -> Pyramid:
    """Read a folder that `aaplug.lod` wrote.

    Raises:
        FormatError: lod.json or a level is missing, broken, or not what it should be.
    """
    return pyramid_of(list(levels_in(folder, read_manifest(folder))))


def levels_in(folder: str | PathLike[str], manifest: Manifest) -> Iterator[Level]:
    """The levels of a folder; see `read_pyramid`."""
    for place, entry in enumerate(manifest.levels):
        scene, sizes = read_scene(path_of(Path(folder), entry)), torch.tensor(entry.chunks)
        problem = FormatError(Path(folder) / entry.file, f"does not have the chunks that {MANIFEST} lists")
        if sizes.sum() != len(scene):  # before memory is taken for as many as it says
            raise problem
        chunks = (
            torch.arange(len(sizes)).repeat_interleave(sizes) if place else chunks_of(scene.means, manifest.largest)
        )
        if not torch.equal(torch.bincount(chunks, minlength=len(sizes)), sizes):
            raise problem
        yield Level(scene, entry.rate, chunks)
