"""The gallery's images: the bundled chair rendered smaller and larger, and its photographs made smaller."""

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.cameras import WHITE, Camera, CameraSet
from aaplug.core.gaussians import Gaussians
from aaplug.core.imaging import resampled
from aaplug.core.training import TrainingViews
from aaplug.io.images import encode_webp, read_image
from aaplug.rendering.renderer import Renderer

PHOTOGRAPH = "photograph"
SHOWN = (  # a view, its scale, and who draws it
    ("r_136", 1 / 4, ("classic", "mip", "auto", PHOTOGRAPH)),
    ("r_136", 1 / 8, ("classic", "auto", PHOTOGRAPH)),
    ("r_24", 1 / 8, ("classic", "auto")),
    ("r_136", 4.0, ("classic", "auto")),
)
MARGIN = 0.02  # of the image, around what is opaque
CENTRE, DETAIL = (0.46, 0.68), 0.2  # of an enlarged view: what is shown of it, and its side, as shares of the image
ENLARGED_QUALITY = 80  # WebP: an enlarged view is smooth


def gallery(scene: Gaussians, cameras: CameraSet) -> dict[str, bytes]:
    """Files by name: chair-VIEW-PIXELS-WHO.webp."""
    training, files = TrainingViews.of(scene, cameras), {}
    views = {view.name: view for view in cameras.test}
    for name, scale, who in SHOWN:
        camera = views[name].scaled(scale)
        drawn = {one: _drawn(scene, training, views[name], camera, one) for one in who}
        y, x = _enlarged(camera) if scale > 1 else _opaque(drawn["auto"])
        quality = ENLARGED_QUALITY if scale > 1 else None
        for one, image in drawn.items():
            files[f"chair-{name}-{camera.width}-{one}.webp"] = encode_webp(image[y, x], quality)
    return files


@torch.no_grad()
def _drawn(scene: Gaussians, training: TrainingViews, view: Camera, camera: Camera, who: str) -> Float[Tensor, "h w 3"]:
    if who == PHOTOGRAPH:
        assert view.photo is not None
        return resampled(read_image(view.photo, WHITE), camera.width / view.width)
    return Renderer.of(scene, training, who, background=WHITE)(camera).rgb


def _opaque(image: Float[Tensor, "h w 3"]) -> tuple[slice, slice]:
    """Rows and columns that are not background, with a margin."""
    ink = (image < 1 - 1 / 255).any(dim=2)
    margin = round(MARGIN * len(image)) + 1
    sides = [ink.any(dim=side).nonzero() for side in (1, 0)]
    rows, columns = (slice(max(0, int(side.min()) - margin), int(side.max()) + 1 + margin) for side in sides)
    return rows, columns


def _enlarged(camera: Camera) -> tuple[slice, slice]:
    (x, y), half = CENTRE, DETAIL / 2
    spans = ((y, camera.height), (x, camera.width))
    rows, columns = (slice(round((at - half) * side), round((at + half) * side)) for at, side in spans)
    return rows, columns
