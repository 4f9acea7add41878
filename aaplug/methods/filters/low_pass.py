"""2DGS's screen-space low-pass filter, scaled with training's pixel."""

from dataclasses import dataclass, replace

from aaplug.core.cameras import Camera
from aaplug.core.splats import Splats2D
from aaplug.core.training import TrainingViews


@dataclass(frozen=True)
class LowPass:
    """Set the width of a disc's low-pass filter: √½ px of the image or, with `matched`, √½ px of training's image."""

    matched: bool = False

    def __call__(self, splats: Splats2D, camera: Camera, training: TrainingViews) -> Splats2D:
        """Set the width; covariances and opacities do not change."""
        return replace(splats, window=training.relative_rate(camera) if self.matched else 1.0)
