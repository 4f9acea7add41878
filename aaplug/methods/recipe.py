"""Recipe: how a scene is rendered, as a combination of filters, a pixel kernel and samples per pixel."""

import math
from dataclasses import dataclass, replace

from aaplug.core.digests import digest_of_values
from aaplug.core.gaussians import Gaussians
from aaplug.core.interfaces import Compositor, PixelKernel, ScreenFilter, Selection, WorldFilter
from aaplug.methods.pixel_kernels import POINT

SLACK = 1e-6  # before one more sample is taken


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
    """How a view's samples and levels of detail are chosen.

    most_samples: along a pixel's side, where a level is meant for the pixel.
    budget: Gaussians up to which a view draws the levels of its samples' rate; else coarser ones.
    share: of the scene's Gaussians, up to which it does so too.
    finer: octaves that the levels of several samples are finer than the pixel's own, at least.
    """

    most_samples: float = math.inf
    budget: int = 0
    share: float = 0.0
    finer: float = 0.0


@dataclass(frozen=True)
class Recipe:
    """How to render a scene.

    source: the paper or design that it follows.  when: what it is for, in one line.
    target_rate: relative sampling rate, at most 1 (training's own), that the samples must reach: n × n samples per
        pixel, with the smallest n for which n · relative rate >= target_rate.  0: no such demand.
    grid: smallest number of samples along a pixel's side, at any rate.
    neighbours: weight of the samples on either side of each, in the limit of a sampling rate of 0; see `neighbours_at`.
    takes_quality: `target_rate` is set by the user's choice of quality.
    levels: how levels of detail are chosen; None draws the finest alone.
    for_discs: name of the recipe that takes its place for scenes of 2D Gaussians.
    """

    name: str
    screen: ScreenFilter
    source: str
    when: str
    world: WorldFilter | None = None
    target_rate: float = 0.0
    grid: int = 1
    neighbours: float = 0.0
    pixel: PixelKernel = POINT
    compositor: Compositor | None = None
    selection: Selection | None = None
    takes_quality: bool = False
    levels: LevelChoice | None = None
    for_discs: str | None = None
    promises: Promises = Promises()

    @property
    def digest(self) -> str:
        """Hash of what it draws by: all but the words about it."""
        return digest_of_values(replace(self, source="", when="", promises=Promises()))

    def samples_at(self, relative_rate: float) -> int:
        """Samples along a pixel's side, for a view at `relative_rate` against training."""
        return max(self.grid, math.ceil(min(self.target_rate, 1.0) / relative_rate - SLACK))

    def neighbours_at(self, sampled_rate: float) -> float:
        """Weight of the samples on either side of each, where the samples lie at `sampled_rate` against training.

        It is 0 from training's own rate on, where samples are training's pixels, and grows as `Matched`'s pixel filter
        does, with the part of a sample that training's pixel did not cover.
        """
        return self.neighbours * max(0.0, 1 - sampled_rate**2)

    def lacks(self, scene: Gaussians) -> str | None:
        """What a scene lacks for this recipe, in words; None if nothing."""
        return None if self.selection is None else self.selection.lacks(scene)
