"""Harmonics that stay in the scene's file: four fifths of what a scene of degree 3 takes in memory.

A view needs those of the Gaussians that it shows, and reads them when it is drawn.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Float, Int
from torch import Tensor

from aaplug.core.gaussians import Gaussians, joined
from aaplug.io.scenes.rows import library_errors
from aaplug.io.scenes.scene import Scene

MAX_HARMONICS_BYTES = 2 * 10**9  # reading more for each view costs less than holding them; 10 M Gaussians of degree 3


@dataclass(frozen=True)
class FileHarmonics:
    """Reads the harmonics of Gaussians from start up to stop; raises FormatError if the file has changed.

    path: the scene's file.  load: see `Scene`.  rows: the file's row of each Gaussian, increasing.
    """

    path: Path
    load: Callable[[int, int], Gaussians]
    rows: Int[Tensor, " n"]

    def __call__(self, start: int, stop: int) -> Float[Tensor, "c k 3"]:
        """Harmonics as stored."""
        rows = self.rows[start:stop]
        first, end = int(rows[0]), int(rows[-1]) + 1
        with library_errors(self.path):
            harmonics = self.load(first, end).sh
        return harmonics if end - first == len(rows) else harmonics[rows - first]


def without_harmonics(scene: Scene) -> tuple[Gaussians, FileHarmonics | None]:
    """The scene's Gaussians, and what reads their harmonics where these are large and stay in the file; else None.

    `sh` then has its shape but is NaN and takes no memory.  All values are checked, the harmonics too, part by part.
    Only a .ply is read by rows, and only while nobody has asked for all of its Gaussians.  Raises FormatError as
    `Scene.gaussians`.
    """
    path, in_memory = scene.path, "gaussians" in scene.memory
    if path is None or in_memory or scene.format != "ply" or scene.harmonics_bytes <= MAX_HARMONICS_BYTES:
        return scene.gaussians(), None
    if "without harmonics" not in scene.memory:
        scene.check_memory(harmonics=False)
        nothing = torch.full((1, 1, 3), torch.nan)
        bare = joined([replace(part, sh=nothing.expand(len(part), 1, 3)) for part in scene.parts()])
        assert bare.origin is not None
        nothing = nothing.expand(len(bare), (scene.sh_degree + 1) ** 2, 3)
        scene.memory["without harmonics"] = replace(bare, sh=nothing), FileHarmonics(path, scene.load, bare.origin.rows)
    return scene.memory["without harmonics"]
