"""Recipe: how a scene is rendered, as a combination of filters, a pixel kernel and samples per pixel."""

import math
from dataclasses import dataclass, replace
from typing import Annotated, Any

from aaplug.core.convolution import fuse_stored
from aaplug.core.gaussians import Gaussians
from aaplug.core.interfaces import Compositor, PixelKernel, ReadsColumns, ScreenFilter, Selection, WorldFilter
from aaplug.core.training import TrainingViews
from aaplug.methods import QUALITIES, SplatOrder
from aaplug.methods.pixel_kernels.point import POINT
from aaplug.system.contracts import Range, check_fields, contract
from aaplug.system.digests import digest_of_values
from aaplug.system.plug_ins import filtered

MAX_SAMPLES = 64  # along a pixel's side that a rate asks for; a mean of 4096 tells less than an 8-bit step from more
Rate = Annotated[float, Range(above=0)]  # relative to training
RATE_TOLERANCE = 1e-6  # samples: excess over a whole number of them that takes no further sample


@dataclass(frozen=True)
class Promises:
    """Properties of a recipe on a classic scene; `tests/laws` checks that each holds if true and fails if false.

    equals_training: at the training size the image equals training's.
    keeps_energy: a lone splat's summed alpha scales with the square of the sampling rate.
    fades_when_small: a splat much smaller than a pixel fades out; no sample hits it at full opacity.
    opaque_when_near: at high magnification, alpha at a splat's centre equals its opacity.
    """

    equals_training: bool = False
    keeps_energy: bool = True
    fades_when_small: bool = True
    opaque_when_near: bool = True


@dataclass(frozen=True)
class LevelChoice:
    """The choice of a view's samples and levels of detail.

    A view draws the levels made for its samples' rate while they hold few Gaussians, and coarser levels otherwise.

    most_samples: largest number of samples along a pixel's side where a level was made for the pixel's rate.
    budget: number of Gaussians that counts as few.
    share: share of the scene's Gaussians that counts as few, too.
    finer: octaves by which the levels of several samples are at least finer than those of the pixel.
    """

    most_samples: float = math.inf
    budget: int = 0
    share: float = 0.0
    finer: float = 0.0


@dataclass(frozen=True)
class Recipe:
    """One way to render a scene.

    source: the paper or design that it follows.  when: what it is for, in one line.
    target_rate: relative sampling rate, at most 1 (training's own), that the samples must reach: n × n samples per
        pixel, with the smallest n for which n · relative rate >= target_rate.  0: no such demand.
    grid: smallest number of samples along a pixel's side, at any rate.
    neighbours: weight of the samples on either side of each, in the limit of a sampling rate of 0; see `neighbours_at`.
    takes_quality: `target_rate` is set by the user's choice of quality.
    order: of splats, by depth: of their centres, or in each tile along the ray of its middle, which pops less.
    levels: how levels of detail are chosen; None draws the finest alone.
    for_discs: name of the recipe that takes its place for scenes of 2D Gaussians.
    time: of a view at 1/4 of the training size, over that of `classic`; None if that is about 1 or unknown.
    """

    name: str
    screen: ScreenFilter
    source: str
    when: str
    world: WorldFilter | None = None
    target_rate: Annotated[float, Range(0)] = 0.0
    grid: Annotated[int, Range(1, MAX_SAMPLES)] = 1
    neighbours: Annotated[float, Range(0, 0.5)] = 0.0
    pixel: PixelKernel = POINT
    compositor: Compositor | None = None
    selection: Selection | None = None
    order: SplatOrder = "depth"
    takes_quality: bool = False
    levels: LevelChoice | None = None
    for_discs: str | None = None
    time: Annotated[float, Range(above=0)] | None = None
    promises: Promises = Promises()

    def __post_init__(self) -> None:
        check_fields(self)

    @property
    def parts(self) -> tuple[tuple[str, object], ...]:
        """Kind and object of all that draws a splat once it is filtered, the innermost first."""
        return ("pixel kernel", self.pixel), *([("compositor", self.compositor)] if self.compositor else [])

    @property
    def digest(self) -> str:
        """Hash of all fields but the words about it."""
        return digest_of_values(replace(self, source="", when="", time=None, promises=Promises()))

    @property
    def cost(self) -> str:
        """Samples per pixel at 1/2, 1/4 and 1/8 of the training size, and the time, in words."""
        counts = [str(self.samples_at(rate) ** 2) for rate in (1 / 2, 1 / 4, 1 / 8)]
        samples = counts[0] if len({*counts}) == 1 else "/".join(counts)
        time = "" if self.time is None else f", {self.time:.2g}× classic's time"
        return f"{samples} sample{'s' * (samples != '1')}{time}"

    @contract
    def samples_at(self, relative_rate: Rate) -> int:
        """Samples along a pixel's side, for a view at `relative_rate` against training; see `MAX_SAMPLES`."""
        return max(self.grid, math.ceil(min(MAX_SAMPLES, min(self.target_rate, 1.0) / relative_rate - RATE_TOLERANCE)))

    @contract
    def neighbours_at(self, sampled_rate: Rate) -> float:
        """Weight of the samples on either side of each, where the samples lie at `sampled_rate` against training.

        It is 0 from training's own rate on, where samples are training's pixels, and grows as `Matched`'s pixel filter
        does, with the part of a sample that training's pixel did not cover.
        """
        return self.neighbours * max(0.0, 1 - sampled_rate**2)

    def prepared(self, scene: Gaussians, training: TrainingViews) -> Gaussians:
        """The scene after what acts once on it: its stored 3D filter, which is part of it, then the world filter.

        A world filter is applied even if the scene already contains one: use `mip` if it stores `filter_3D`.
        """
        scene = fuse_stored(scene)
        return scene if self.world is None else filtered("world filter", self.world, scene, training)

    @contract
    def lacks(self, scene: Gaussians) -> str | None:
        """The columns that a scene lacks for this recipe, in words; None if nothing."""
        if self.selection is not None:
            return self.selection.lacks(scene)
        columns = self.screen.columns if isinstance(self.screen, ReadsColumns) else ()
        lacking = ", ".join(name for name in columns if name not in scene.extras)
        return f"the scene lacks {lacking}; `aaplug finetune --learn-filters` makes them" if lacking else None


# 100,000 Gaussians take some 20 ms on two cores, and 27 % of a large scene's a third of the time without levels
LEVELS = {
    "fast": LevelChoice(most_samples=1.0),
    "balanced": LevelChoice(budget=100_000, share=0.27, finer=1.0),
    "best": None,
}


def set_by(quality: str) -> dict[str, Any]:
    """The fields of a recipe that a quality sets."""
    return {"target_rate": QUALITIES[quality], "levels": LEVELS[quality]}
