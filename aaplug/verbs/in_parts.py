"""Conversion of scenes larger than memory, part by part, with the values that converting the whole would give.

A closed form treats each Gaussian alone, so parts can be read, converted and written one after the other.  One value
depends on all of them: the coarsest sampling rate, which stands in for Gaussians that no camera sees.  A first pass
over the file finds it.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import torch

from aaplug.core.cameras import Camera
from aaplug.core.gaussians import Gaussians
from aaplug.core.sampling import SamplingBounds, sampling_bounds
from aaplug.core.training import TrainingViews
from aaplug.io.scenes.scene import PART, Scene
from aaplug.methods.conversion import Form, fuse
from aaplug.system.executors import Threads
from aaplug.system.monitor import Tell

LARGE_SCENE = 1_000_000  # Gaussians: larger files are converted in parts; a million take 0.3 GB, and more at work


def convert_parts(
    scene: Scene,
    cameras: Sequence[Camera],
    form: Form,
    tell: Tell = lambda done, total: None,
    size: int = PART,
    threads: int = 1,
) -> Iterator[Gaussians]:
    """Yield the parts of the scene, each converted as `conversion.fuse` would convert the whole.

    cameras: training cameras; none where the scene stores its 3D filter.
    tell: called with (Gaussians done, Gaussians in all).
    size: Gaussians per part.  threads: parts converted at once.
    """
    coarsest = _coarsest(scene, cameras, size) if cameras and form.uses_bounds else None

    def converted(part: Gaussians) -> Gaussians:
        if not cameras:
            return fuse(part, None, form)
        bounds = _bounds(part, cameras, coarsest)
        return fuse(part, TrainingViews(part.convention, cameras, bounds), form)

    done = 0
    for part in Threads(threads).map(converted, scene.parts(size)):
        yield part
        done += len(part)
        tell(min(done, scene.count), scene.count)


def _bounds(part: Gaussians, cameras: Sequence[Camera], coarsest: float | None) -> SamplingBounds:
    """The part's bounds, with unseen Gaussians at the coarsest rate; zeros where the form reads none."""
    if coarsest is None:
        none = torch.zeros(len(part))
        return SamplingBounds(none, none, none, torch.zeros(len(part), dtype=torch.int32))
    bounds = sampling_bounds(part.means, cameras)
    highest = torch.where(bounds.seen, bounds.highest, coarsest)
    return replace(bounds, highest=highest, views=bounds.views.clamp(min=1))


def _coarsest(scene: Scene, cameras: Sequence[Camera], size: int) -> float:
    found = (sampling_bounds(part.means, cameras) for part in scene.parts(size))
    return min((part.highest[part.seen].min().item() for part in found if part.seen.any()), default=math.inf)
