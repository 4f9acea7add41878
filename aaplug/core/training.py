"""Facts about training: its rasterization convention, and how finely its cameras sampled the scene."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import median
from typing import Annotated

from aaplug.core.cameras import Camera, CameraSet, Factor
from aaplug.core.colours import Share
from aaplug.core.conventions import Convention
from aaplug.core.gaussians import Gaussians
from aaplug.core.sampling import SamplingBounds, check_seen, sampling_bounds
from aaplug.system.contracts import Range, check_fields, contract
from aaplug.system.errors import UsageError

Margin = Annotated[float, Range(0)]  # share of an image's longer side


@dataclass(frozen=True, eq=False)
class TrainingViews:
    """The training cameras of one scene, and their sampling rates of each Gaussian.

    convention: how training turned covariances into pixels.
    cameras: at the training size.
    bounds: lowest and highest sampling rate of each Gaussian, in px per world unit.
    cull_margin: training culled Gaussians whose centre lay farther outside the image than this share of its longer
        side.  inf for 3DGS and gsplat, which cull none by centre.  A scene trained with a margin looks hazy without it.
    """

    convention: Convention
    cameras: Sequence[Camera]
    bounds: SamplingBounds
    cull_margin: Margin = math.inf

    def __post_init__(self) -> None:
        check_fields(self)
        if not self.cameras:
            raise UsageError("cameras", "there are none, and sampling bounds need at least one")

    def __repr__(self) -> str:
        known = f"{len(self.cameras)} cameras, {len(self.bounds.views)} Gaussians, cull_margin={self.cull_margin}"
        return f"TrainingViews({known}, convention={self.convention})"

    @classmethod
    @contract
    def of(
        cls,
        scene: Gaussians,
        cameras: CameraSet | Sequence[Camera],
        cull_margin: Margin = math.inf,
        min_seen: Share = 0.0,
    ) -> "TrainingViews":
        """Compute the sampling bounds of a scene.

        min_seen: share of the Gaussians that the cameras must see, as a check that both are in the same frame; assumed
            cameras are not checked.

        Raises:
            FrameError: the cameras see less of the scene.
            UsageError: there are no cameras.
        """
        views = cameras.train if isinstance(cameras, CameraSet) else tuple(cameras)
        bounds = sampling_bounds(scene.means, views)
        if min_seen > 0 and not (isinstance(cameras, CameraSet) and cameras.assumed):
            check_seen(bounds.seen, len(views), scene.name, min_seen)
        return cls(scene.convention, views, bounds, cull_margin)

    @contract
    def relative_rate(self, camera: Camera) -> float:
        """A view's focal length over training's: 1 at the training size, 1/2 at half of it.  Depth plays no part.

        A free camera is compared with the training cameras' median focal length.
        """
        return camera.focal / (camera.trained_focal or median(c.focal for c in self.cameras))

    @contract
    def finer(self, factor: Factor) -> "TrainingViews":
        """The same views with pixels `factor` times as dense, so that every rate is `factor` times as high."""
        bounds = replace(self.bounds, highest=self.bounds.highest * factor, lowest=self.bounds.lowest * factor)
        cameras = [replace(c, fx=c.fx * factor, fy=c.fy * factor) for c in self.cameras]
        return replace(self, cameras=cameras, bounds=bounds)
