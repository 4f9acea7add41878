"""Conventions: how training turned a projected covariance into pixels, and when scene and cameras fit together.

They are plain data and import no torch, so that the command line knows their names at once.
"""

from dataclasses import dataclass
from typing import Annotated, Literal

from aaplug.core.rules import RULES_3DGS, Rules
from aaplug.system.contracts import Range, check_fields

SpzAxes = Literal["auto", "opengl", "opencv"]  # of a .spz: as the cameras tell, its specification, splat-transform
SpzVersion = Literal[3, 4]  # of a .spz to write: as older readers take it, or with its axes stated
MAX_KERNEL = 1e6  # px²: what is computed from it stays finite
MIN_SEEN_SHARE = 0.5  # cameras that see a smaller share of the Gaussians are taken to be in another frame


@dataclass(frozen=True)
class Convention:
    """The steps by which training turned a projected covariance into pixels.

    kernel: variance added to the covariance's diagonal, in px² of the training image.
    compensated: true where opacity was then multiplied by √(det C / det(C + kernel·I)).
    rules: of compositing.
    """

    name: str
    kernel: Annotated[float, Range(0, MAX_KERNEL)]
    compensated: bool
    rules: Rules = RULES_3DGS

    def __post_init__(self) -> None:
        check_fields(self)


CLASSIC = Convention("classic", 0.3, compensated=False)  # 3DGS (Kerbl et al. 2023)
ANTIALIASED = Convention("antialiased", 0.3, compensated=True)  # 3DGS --antialiasing, gsplat "antialiased"
MIP = Convention("mip", 0.1, compensated=True)  # Mip-Splatting (Yu et al. 2024), arXiv 2311.16493
# PlayCanvas (engine 2.23.3) adds 0.3 in half pixels; what is fitted to it records that as its training
PLAYCANVAS = Convention("playcanvas", 0.3 / 4, compensated=True)
PLAYCANVAS_CLASSIC = Convention("playcanvas-classic", 0.3 / 4, compensated=False)  # its anti-aliasing is off
KHR = Convention("khr", 0.0, compensated=False)  # glTF's KHR_gaussian_splatting and OpenUSD: nothing is added
CESIUM = Convention("cesium", 0.3 / 16, compensated=False)  # CesiumJS adds 0.3 in quarters of a pixel
CONVENTIONS = {c.name: c for c in (CLASSIC, ANTIALIASED, MIP, PLAYCANVAS, PLAYCANVAS_CLASSIC, KHR, CESIUM)}
