"""2DGS's low-pass filter on the screen, as wide as training's pixel at the rate being rendered."""

from dataclasses import dataclass, replace

from aaplug.core.cameras import Camera
from aaplug.core.splats import Splats2D
from aaplug.core.training import TrainingViews


@dataclass(frozen=True)
class LowPass:
    """Say how wide a disc's low-pass filter is: √½ px of the image, or with `matched` √½ px of training's."""

    matched: bool = False

    def __call__(self, splats: Splats2D, camera: Camera, training: TrainingViews) -> Splats2D:
        """Set the width; covariances and opacities stay."""
        return replace(splats, window=training.relative_rate(camera) if self.matched else 1.0)
