"""What a view should look like at a scale: averages of a larger image below it, a guess from it above.

The larger image is the scene's own render at the training size by the rule that it was trained with, so that no
photograph is needed, or the photograph.  A scale is a size against training's.  Where nothing is large enough, the
guess is the scene's render there, corrected so that its averages are the image at hand (back-projection, Irani and
Peleg 1991), unless an upsampler is given.
"""

from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.cameras import Camera
from aaplug.core.gaussians import Gaussians
from aaplug.core.interfaces import Rasterizer
from aaplug.core.training import TrainingViews
from aaplug.finetuning.upsamplers import Upsampler, bicubic
from aaplug.io.images import resampled
from aaplug.io.photographs import read_photo
from aaplug.methods.recipes import RECIPES
from aaplug.rendering.renderer import render, smooth

MEMORY = 1e9  # bytes of images kept; what does not fit is made anew each time
KEPT = torch.float16  # as finely as 11 bits tell, ten times finer than the 8 that are compared


@dataclass(frozen=True)
class Truth:
    """Images to compare with, kept in memory while there is room."""

    scene: Gaussians
    training: TrainingViews
    rasterizer: Rasterizer
    background: tuple[float, float, float]
    photographs: bool = False
    upsample: Upsampler | None = None
    memory: float = MEMORY
    _kept: dict[tuple[bytes, float], Tensor] = field(default_factory=dict, init=False)

    def __call__(self, view: Camera, scale: float) -> Float[Tensor, "h w 3"]:
        """The image of a view, given at the training size, at a scale."""
        key = view.cam_from_world.numpy().tobytes(), scale  # names recur in other splits
        if key not in self._kept:
            image = self._made(view, scale).to(KEPT)
            used = sum(x.numel() * x.element_size() for x in self._kept.values())
            if used + image.numel() * image.element_size() > self.memory:
                return image.float()
            self._kept[key] = image
        return self._kept[key].float()

    def _made(self, view: Camera, scale: float) -> Float[Tensor, "h w 3"]:
        full, camera = self._full(view), view.scaled(scale)
        factor = scale * view.width / full.shape[1]
        if factor <= 1:
            return resampled(full, factor, camera.hw)
        return (
            self._guess(full, camera) if self.upsample is None else self.upsample(full, camera.hw)
        ).clamp(0.0, 1.0)

    def _guess(self, full: Float[Tensor, "h w 3"], camera: Camera) -> Float[Tensor, "H W 3"]:
        """The scene's render, corrected by what its averages lack."""
        image = self._render(camera)
        averages = resampled(image, full.shape[1] / camera.width, (full.shape[0], full.shape[1]))
        return image + bicubic(full - averages, camera.hw)

    def _full(self, view: Camera) -> Float[Tensor, "h w 3"]:
        if self.photographs:
            assert view.photo is not None
            return read_photo(view.photo, self.background, view.lens)
        return self._render(view)

    @torch.no_grad()
    def _render(self, camera: Camera) -> Float[Tensor, "h w 3"]:
        recipe = RECIPES["matched"]
        own = smooth(self.scene, self.training, recipe)
        image = render(own, camera, recipe, self.training, self.rasterizer, self.background)
        return image.rgb.clamp(0.0, 1.0)
