"""A scene format: a text file of balls, each a line of x, y, z, radius, red, green, blue and opacity."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from aaplug import (
    COLOUR_OFFSET,
    SH_C0,
    FormatError,
    Gaussians,
    Scene,
    SceneFileOptions,
    library_errors,
    logit_of,
    replacing,
    sh_of_colour,
)

COLUMNS = 8
EVIDENCE = "the format does not say: assumed classic (3DGS default)"


@dataclass(frozen=True)
class Balls:
    """Spheres of one colour; position and radius in world units, colour and opacity in [0, 1]."""

    name: str = "balls"  # also the files' suffix
    needs: str | None = None  # a package that writing imports

    def sniff(self, path: Path, head: bytes) -> bool:
        """True if the suffix is .balls; a text file has no signature."""
        return path.suffix.lower() == ".balls"

    def open_scene(self, path: Path, options: SceneFileOptions) -> Scene:
        """Read what the file says about the scene.

        Raises:
            FormatError: a line is not what it should be.
        """
        with library_errors(path):
            rows = torch.from_numpy(np.loadtxt(path, dtype=np.float32, ndmin=2))
        if rows.shape[1] != COLUMNS:
            raise FormatError(path, f"has {rows.shape[1]} numbers per line instead of {COLUMNS}")

        def load(start: int, stop: int) -> Gaussians:
            return _gaussians(rows[start:stop])

        return Scene(path, self.name, len(rows), 0, load, EVIDENCE)

    def write(
        self, path: Path, parts: Iterable[Gaussians], count: int, overwrite: bool, options: SceneFileOptions
    ) -> None:
        """Write a scene; the widest axis becomes the radius.

        Raises:
            OutputError: the file exists and `overwrite` is false, or it cannot be written.
        """
        with replacing(path, overwrite) as stream:
            for part in parts:
                radius = part.scales.amax(dim=1, keepdim=True)
                colour = (COLOUR_OFFSET + SH_C0 * part.sh[:, 0]).clamp(0, 1)
                columns = [part.means, radius, colour, part.opacities[:, None]]
                np.savetxt(stream, torch.cat(columns, dim=1).numpy(), fmt="%.9g")


def _gaussians(rows: Tensor) -> Gaussians:
    return Gaussians(
        means=rows[:, :3],
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(len(rows), 1),
        log_scales=rows[:, 3:4].log().expand(-1, 3),
        logit_opacities=logit_of(rows[:, 7]),
        sh=sh_of_colour(rows[:, 4:7])[:, None],
    )


BALLS = Balls()
