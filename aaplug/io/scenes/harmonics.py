"""Harmonics that stay in the scene's file: four fifths of what a scene of degree 3 takes in memory.

A view needs those of the Gaussians that it shows, and reads them when it is drawn.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from aaplug.core.gaussians import Gaussians, joined
from aaplug.io.scenes.scene_file import FLOAT, SHAPE_NUMBERS, SceneFile


@dataclass(frozen=True)
class FileHarmonics:
    """Reads the harmonics of Gaussians from start up to stop; raises FormatError if the file has changed.

    rows: the file's row of each Gaussian, increasing.
    """

    file: SceneFile
    rows: Int[Tensor, " n"]

    def __call__(self, start: int, stop: int) -> Float[Tensor, "c k 3"]:
        """Harmonics as stored."""
        rows = self.rows[start:stop]
        first, end = int(rows[0]), int(rows[-1]) + 1
        harmonics = self.file.raw(first, end).sh
        return harmonics if end - first == len(rows) else harmonics[rows - first]


def without_harmonics(opened: SceneFile, drop_bad: bool = False) -> tuple[Gaussians, FileHarmonics]:
    """The scene but for its harmonics, and what reads them.  `sh` has its shape but is NaN and takes no memory.

    All values are checked, the harmonics too, part by part; raises FormatError as `SceneFile.parts` and `whole`.
    """
    opened.check_memory(opened.count * FLOAT * SHAPE_NUMBERS)
    scene = joined([replace(part, sh=torch.empty(len(part), 0, 3)) for part in opened.parts(drop_bad)])
    assert scene.origin is not None
    nothing = torch.full((1, (opened.sh_degree + 1) ** 2, 3), torch.nan)
    return replace(scene, sh=nothing.expand(len(scene), -1, -1)), FileHarmonics(opened, scene.origin.rows)
