"""Options of `lod`."""

from dataclasses import dataclass
from typing import Annotated

import tyro

from aaplug.core.choices import LEVEL_STEPS
from aaplug.core.errors import UsageError
from aaplug.options.base import UNSET, number
from aaplug.options.shared import STEPS, OneViewer, ViewOptions

TIMES_FOR_ONE = 2  # as many steps for one scene: its counts are met, so tuning has more to mend


@dataclass(frozen=True, kw_only=True)
class LodOptions(ViewOptions):
    """How light, and how to tune."""

    views: Annotated[str, tyro.conf.arg(metavar="NAME,...|test|train|all")] = "train"
    """Views that levels are tuned on and that tell what is hidden, with free ones between them."""

    simplify: Annotated[float | None, number(1e-6, 1e9), UNSET] = None
    """Write one scene with this share of the Gaussians; above 1, with so many."""
    budget: Annotated[float | None, number(0.001, 1e6), UNSET] = None
    """Write one scene of as many Gaussians as fit into a .ply of so many MB (10^6 bytes)."""
    levels: Annotated[int | None, number(1, 12, whole=True), UNSET] = None
    """Write a folder of levels, each for half the size of the one before, as light as the image allows (default: 4)."""
    merge_below: Annotated[float, number(0, 10)] = 0.0
    """With levels: merge Gaussians up to so many px of the level in any case; faster to draw, and less exact."""
    multi_scale: bool = False
    """Write the levels, merged alone, into one .ply with the columns of Multi-Scale 3DGS, whose own rule picks them."""
    scale: Annotated[float | None, number(0.001, 1), UNSET] = None
    """With --simplify or --budget: size of the images that the scene is meant for (default: root of the share)."""
    viewer: OneViewer = None
    """Tune each file for spark, playcanvas or another of examples/guides/viewers.md, instead of for aaplug."""
    refine: bool = True
    """Merge alone: do not tune the result to look like the scene, which takes minutes."""
    steps: Annotated[int | None, STEPS, UNSET] = None
    """Steps of tuning for each level, more for small ones (default: 1000, or 2000 for one scene)."""
    resume: bool = False
    """Keep the levels that are there, if they were made of the same scene, cameras and options."""
    overwrite: bool = False
    """Replace existing outputs."""

    def __post_init__(self) -> None:
        super().__post_init__()
        given = [name for name in ("simplify", "budget", "levels") if getattr(self, name) is not None]
        if len(given) > 1:
            raise UsageError(given[1], f"cannot be combined with `{given[0]}`: each asks for other files")
        others = [
            name
            for name in ("simplify", "budget", "scale", "merge_below", "viewer", "steps", "resume")
            if getattr(self, name)
        ]
        if self.multi_scale and others:
            raise UsageError(others[0], "cannot be combined with `multi_scale`, whose levels are merged alone")
        if self.scale is not None and not self.single:
            raise UsageError("scale", "belongs to `simplify` and `budget`")
        if self.merge_below and self.single:
            raise UsageError("merge_below", "belongs to levels")
        if self.resume and (self.single or self.viewer is not None):
            raise UsageError("resume", "belongs to levels for aaplug")
        if self.viewer is not None and not self.tuning:
            raise UsageError("viewer", "is what the result is tuned for: leave out `refine`, and `steps` of 0")

    @property
    def single(self) -> bool:
        """Whether one file is asked for, not a folder."""
        return self.simplify is not None or self.budget is not None or self.multi_scale

    @property
    def tuning(self) -> int:
        """Steps of tuning for a rate of 1/4 and above; 0 for none."""
        usual = TIMES_FOR_ONE * LEVEL_STEPS if self.single else LEVEL_STEPS
        return (usual if self.steps is None else self.steps) if self.refine else 0
