"""Evaluation protocols by name: what a scale changes, the truth and how it is made smaller, which SSIM and LPIPS.

A scale is a sampling rate relative to training.  A protocol changes one of these to reach it:
"size": the image has that many times the pixels per side; pose and field of view stay.
"distance": the camera moves along its axis until what lies at the view's median depth is 1/scale as far; focal length
and image size stay.
"fov": the focal length is multiplied by it; pose and size stay.
"""

from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.camera_paths import moved, zoomed
from aaplug.core.cameras import WHITE, Camera
from aaplug.core.errors import UsageError
from aaplug.core.imaging import resampled, stretched
from aaplug.core.registry import Registry
from aaplug.core.rules import NEAR

SsimFlavour = Literal["wang", "3dgs"]
LpipsFlavour = Literal["3dgs", "vgg", "alex"]
Change = Literal["size", "distance", "fov"]
TruthSource = Literal["photographs", "self", "reference"]

ZOOM_OUT = (1.0, 0.5, 0.25, 0.125)
ZOOM_IN = (1.0, 2.0, 4.0, 8.0)


@dataclass(frozen=True)
class Protocol:
    """One way to evaluate.

    source: where it comes from.
    truth: None takes photographs where every view has one.
    downscale: a name of `DOWNSCALES`.
    whole_sizes: round side·scale to whole pixels and stretch the image by less than one pixel, instead of cropping it.
    background: None is the scene's own.
    """

    name: str
    source: str
    scales: tuple[float, ...]
    truth: TruthSource | None = None
    change: Change = "size"
    downscale: str = "box"
    whole_sizes: bool = False
    ssim: SsimFlavour = "wang"
    lpips: LpipsFlavour = "vgg"
    background: tuple[float, float, float] | None = None

    def camera(self, view: Camera, scale: float, depth: float) -> Camera:
        """The view as it is rendered at a scale; depth: median depth of the scene in it, in world units."""
        if self.change == "fov":
            return zoomed(view, scale)
        if self.change == "distance":
            return moved(view, scale, depth)
        if not self.whole_sizes:
            return view.scaled(scale)
        return view.resized(*(max(1, round(side * scale)) for side in (view.width, view.height)))

    def resized(self, full: Float[Tensor, "h w 3"], camera: Camera, scale: float) -> Float[Tensor, "h2 w2 3"]:
        """An image of the training size at the size of `camera`, which is that of `scale`."""
        return stretched(full, camera.hw) if self.whole_sizes else resampled(full, scale, camera.hw)

    @property
    def facts(self) -> dict[str, Any]:
        """What a report says about the protocol."""
        cropped, rounded = "what does not fill a pixel is cropped", "rounded, pixels stretched by less than one"
        sizes = rounded if self.whole_sizes else cropped
        return {"name": self.name, "source": self.source, "scale changes": self.change, "sizes": sizes}


def median_depth(means: Float[Tensor, "n 3"], view: Camera) -> float:
    """Median depth of the Gaussians that project into the view, in world units; raises UsageError if none does."""
    pixels, depth = view.project(means)
    x, y = pixels.unbind(dim=1)
    inside = (depth > NEAR) & (x >= 0) & (x <= view.width) & (y >= 0) & (y <= view.height)
    if not bool(inside.any()):
        raise UsageError(view.name, "sees no Gaussian, so there is no distance to change")
    return float(torch.median(depth[inside]))


_SOURCES = {
    "default": "aaplug: photographs where every view has one, else self",
    "blender": "NeRF-synthetic, single-train multi-test (Mip-Splatting, section 6.2): trained at full size, tested "
    "down to 1/8, on white",
    "360-zoom-out": "Mip-NeRF 360 trained at full size, rendered at 1, 1/2, 1/4 and 1/8 of it (3DGS's -r 1, 2, 4, 8)",
    "360-zoom-in": "Mip-NeRF 360, single-train multi-test (Mip-Splatting, section 6.3): trained at -r 8, rendered at "
    "-r 8, 4, 2 and 1",
    "distance": "the camera moves away and nearer, the focal length stays (the argument of LOD-GS, arXiv 2507.00554); "
    "against the scene's own supersampled look",
    "fov": "the focal length changes, pose and image size stay; against the scene's own supersampled look",
    "self": "no photographs: against the scene's own training-size look, averaged down, and `matched` above that size",
}
_SELF = Protocol("self", "", ZOOM_OUT, "self")
_3DGS = Protocol("", "", ZOOM_OUT, "photographs", ssim="3dgs", lpips="3dgs")
_360 = replace(_3DGS, name="360-zoom-out", downscale="pil-bicubic", whole_sizes=True)
_OWN = (
    Protocol("default", "", ZOOM_OUT),
    replace(_3DGS, name="blender", downscale="rgba-box", background=WHITE),
    _360,
    replace(_360, name="360-zoom-in", scales=ZOOM_IN),
    replace(_SELF, name="distance", change="distance"),
    replace(_SELF, name="fov", change="fov"),
    _SELF,
)
PROTOCOLS: Registry[Protocol] = Registry(
    "protocol", {p.name: replace(p, source=_SOURCES[p.name]) for p in _OWN}, lambda value: isinstance(value, Protocol)
)
