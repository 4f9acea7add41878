"""A world filter: smooth by what the coarsest training view could resolve."""

from dataclasses import dataclass, replace

from aaplug import Fusion, Gaussians, TrainingViews, smoothed_by


@dataclass(frozen=True)
class Dull:
    """Widen every Gaussian by `variance` px² at its lowest training rate, and keep its integral."""

    variance: float = 0.05

    def __call__(self, scene: Gaussians, training: TrainingViews) -> Gaussians:
        """Fuse the smoothing into scales and opacities."""
        rates = training.bounds.lowest.where(training.bounds.seen, float("inf"))
        log_sigma = (self.variance**0.5 / rates).log()[:, None]  # -inf changes nothing
        smoothed = smoothed_by(scene, log_sigma, volume=True)
        record = Fusion("dull", {"variance": f"{self.variance:g}"})
        return replace(smoothed, fused=(*scene.fused, record))


DULL = Dull()
