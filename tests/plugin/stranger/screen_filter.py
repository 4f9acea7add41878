"""A screen filter: a compensated dilation of 0.2 px²."""

from dataclasses import dataclass

from aaplug import Camera, Splats2D, TrainingViews


@dataclass(frozen=True)
class Soft:
    """Add `variance` px² to every covariance and keep the splat's energy."""

    variance: float = 0.2

    def __call__(self, splats: Splats2D, camera: Camera, training: TrainingViews) -> Splats2D:
        """Filter the splats of one view."""
        return splats.blurred(self.variance, compensate=True)


SOFT = Soft()
