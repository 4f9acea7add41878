"""Evaluation protocols by name: what a scale changes, the truth and how it is made smaller, which SSIM and LPIPS.

A scale is a factor on how finely the scene is sampled against training.  What carries it:
"size": the image has that many times the pixels a side, at the same pose and field of view.
"distance": the camera moves along its axis until what lies at the view's median depth is 1/scale as far; the focal
length and the image's size stay.
"fov": the focal length is multiplied by it; pose and size stay.
"""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.camera_paths import moved, zoomed
from aaplug.core.cameras import WHITE, Camera
from aaplug.core.errors import UsageError, listing
from aaplug.core.rules import NEAR
from aaplug.evaluation.metrics import LpipsFlavour, SsimFlavour

Change = Literal["size", "distance", "fov"]
Truth = Literal["photographs", "self"]

ZOOM_OUT = (1.0, 0.5, 0.25, 0.125)
ZOOM_IN = (1.0, 2.0, 4.0, 8.0)


@dataclass(frozen=True)
class Protocol:
    """One way to evaluate.

    source: where it comes from.  truth: None takes photographs where every view has one.  downscale: a name of
    `DOWNSCALES`.  whole_sizes: images of round(side·scale) px, stretched by less than one, instead of cropped ones.
    background: None is the scene's own.
    """

    name: str
    source: str
    scales: tuple[float, ...]
    truth: Truth | None = None
    change: Change = "size"
    downscale: str = "box"
    whole_sizes: bool = False
    ssim: SsimFlavour = "wang"
    lpips: LpipsFlavour = "vgg"
    background: tuple[float, float, float] | None = None

    def camera(self, view: Camera, scale: float, depth: float) -> Camera:
        """The view as it is rendered at a scale; depth: the scene's median depth in it, in world units."""
        if self.change == "size":
            if self.whole_sizes:
                sides = (max(1, round(side * scale)) for side in (view.width, view.height))
                return view.resized(*sides)
            return view.scaled(scale)
        if self.change == "fov":
            return zoomed(view, scale)
        return moved(view, scale, depth)


def median_depth(means: Float[Tensor, "n 3"], view: Camera) -> float:
    """Median depth of what projects into the view, in world units.

    Raises:
        UsageError: nothing does.
    """
    pose = view.cam_from_world
    local = means.double() @ pose[:3, :3].T + pose[:3, 3]
    x, y, z = local.unbind(dim=1)
    u, v = x / z * view.fx + view.cx, y / z * view.fy + view.cy
    inside = (z > NEAR) & (u >= 0) & (u <= view.width) & (v >= 0) & (v <= view.height)
    if not bool(inside.any()):
        raise UsageError(view.name, "sees no Gaussian, so there is no distance to change")
    return float(torch.median(z[inside]))


PROTOCOLS = {
    protocol.name: protocol
    for protocol in (
        Protocol("default", "aaplug: photographs where every view has one, else self", ZOOM_OUT),
        Protocol(
            "blender",
            "NeRF-synthetic, single-train multi-test (Mip-Splatting, section 6.2): trained at full size, tested "
            "down to 1/8, on white",
            ZOOM_OUT,
            "photographs",
            downscale="rgba-box",
            ssim="3dgs",
            lpips="3dgs",
            background=WHITE,
        ),
        Protocol(
            "360-zoom-out",
            "Mip-NeRF 360 trained at full size, rendered at 1, 1/2, 1/4 and 1/8 of it (3DGS's -r 1, 2, 4, 8)",
            ZOOM_OUT,
            "photographs",
            downscale="pil-bicubic",
            whole_sizes=True,
            ssim="3dgs",
            lpips="3dgs",
        ),
        Protocol(
            "360-zoom-in",
            "Mip-NeRF 360, single-train multi-test (Mip-Splatting, section 6.3): trained at -r 8, rendered at -r 8, 4, "
            "2 and 1",
            ZOOM_IN,
            "photographs",
            downscale="pil-bicubic",
            whole_sizes=True,
            ssim="3dgs",
            lpips="3dgs",
        ),
        Protocol(
            "distance",
            "the camera moves away and nearer, the focal length stays (the argument of LOD-GS, arXiv 2507.00554); "
            "against the scene's own supersampled look",
            ZOOM_OUT,
            "self",
            change="distance",
        ),
        Protocol(
            "fov",
            "the focal length changes, pose and image size stay; against the scene's own supersampled look",
            ZOOM_OUT,
            "self",
            change="fov",
        ),
        Protocol(
            "self",
            "no photographs: against the scene's own training-size look, averaged down, and `matched` above that size",
            ZOOM_OUT,
            "self",
        ),
    )
}


def find_protocol(name: str) -> Protocol:
    """A protocol by name.

    Raises:
        UsageError: there is none of that name.
    """
    if name not in PROTOCOLS:
        raise UsageError("--protocol", f"'{name}' is not one of {listing(list(PROTOCOLS), 99)}")
    return PROTOCOLS[name]
