"""Evaluation protocols: the change that a scale makes, the truth and its downscaling, the flavours of SSIM and LPIPS.

A scale is a sampling rate relative to training.  A protocol changes one of these to reach it:
"size": the image has that many times the pixels per side; pose and field of view stay.
"distance": the camera moves along its axis until the view's median depth is 1/scale of what it was; focal length and
image size stay.
"fov": the focal length is multiplied by it; pose and size stay.
"""

from dataclasses import dataclass, replace
from typing import Any, Literal

from jaxtyping import Float
from torch import Tensor

from aaplug.core.camera_paths import moved, zoomed
from aaplug.core.cameras import Camera
from aaplug.core.colours import WHITE
from aaplug.core.imaging import resampled, stretched
from aaplug.system.contracts import check_fields

SsimFlavour = Literal["wang", "3dgs"]
LpipsFlavour = Literal["3dgs", "vgg", "alex"]
Change = Literal["size", "distance", "fov"]
TruthSource = Literal["photographs", "self", "reference"]

ZOOM_OUT = (1.0, 0.5, 0.25, 0.125)
ZOOM_IN = (1.0, 2.0, 4.0, 8.0)


@dataclass(frozen=True)
class Protocol:
    """One way to evaluate.

    source: its publication, or its use.
    truth: None takes photographs where every view has one.
    downscale: a name of `DOWNSCALES`.
    whole_sizes: round side·scale to whole pixels and stretch the image by less than one pixel, instead of cropping it.
    background: None is the scene's own.
    """

    name: str
    source: str
    scales: tuple[float, ...]
    truth: Literal["photographs", "self"] | None = None
    change: Change = "size"
    downscale: str = "box"
    whole_sizes: bool = False
    ssim: SsimFlavour = "wang"
    lpips: LpipsFlavour = "vgg"
    background: tuple[float, float, float] | None = None

    def __post_init__(self) -> None:
        check_fields(self)

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
        """The protocol in a report."""
        cropped, rounded = "what does not fill a pixel is cropped", "rounded, pixels stretched by less than one"
        sizes = rounded if self.whole_sizes else cropped
        return {"name": self.name, "source": self.source, "scale changes": self.change, "sizes": sizes}


DEFAULT = Protocol("default", "aaplug: photographs where every view has one, else self", ZOOM_OUT)
BLENDER = Protocol(
    "blender",
    "NeRF-synthetic, single-train multi-test (Mip-Splatting, section 6.2): trained at full size, tested down to 1/8, "
    "on white",
    ZOOM_OUT,
    "photographs",
    downscale="rgba-box",
    ssim="3dgs",
    lpips="3dgs",
    background=WHITE,
)
ZOOM_OUT_360 = Protocol(
    "360-zoom-out",
    "Mip-NeRF 360 trained at full size, rendered at 1, 1/2, 1/4 and 1/8 of it (3DGS's -r 1, 2, 4, 8)",
    ZOOM_OUT,
    "photographs",
    downscale="pil-bicubic",
    whole_sizes=True,
    ssim="3dgs",
    lpips="3dgs",
)
ZOOM_IN_360 = replace(
    ZOOM_OUT_360,
    name="360-zoom-in",
    source="Mip-NeRF 360, single-train multi-test (Mip-Splatting, section 6.3): trained at -r 8, rendered at "
    "-r 8, 4, 2 and 1",
    scales=ZOOM_IN,
)
DISTANCE = Protocol(
    "distance",
    "the camera moves away and nearer, the focal length stays (the argument of LOD-GS, arXiv 2507.00554); "
    "against the scene's own supersampled look",
    ZOOM_OUT,
    "self",
    change="distance",
)
FIELD_OF_VIEW = Protocol(
    "fov",
    "the focal length changes, pose and image size stay; against the scene's own supersampled look",
    ZOOM_OUT,
    "self",
    change="fov",
)
SELF = Protocol(
    "self",
    "no photographs: against the scene's own training-size look, averaged down, and `matched` above that size",
    ZOOM_OUT,
    "self",
)
