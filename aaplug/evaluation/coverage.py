"""The sampling rates of a scene's Gaussians in training, and the scale at which each begins to alias.

A Gaussian is sampled well where its standard deviation along its middle axis is at least √0.2 px at the highest
sampling rate of any training view: Mip-Splatting's bound (arXiv 2311.16493).  The middle axis is the one that counts
on surfaces, whose thin axis shows only edge-on.  Training drew that Gaussian widened by the convention's dilation.  At
relative rate r its variance is r²(σ²ν² + dilation) px², which meets the bound at r = √(0.2 / (σ²ν² + dilation)): below
that scale it aliases.

The share of the splats' energy above the Nyquist rate (`core.spectra`) takes all axes, opacities and the recipe in too.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.cameras import Camera, spread
from aaplug.core.gaussians import MAX_LOG_SCALE, Gaussians
from aaplug.core.sampling import SamplingBounds
from aaplug.core.spectra import energies
from aaplug.core.training import TrainingViews
from aaplug.methods.filters.smoothing import NYQUIST_VARIANCE
from aaplug.methods.pixel_kernels.point import POINT
from aaplug.rendering.renderer import Renderer

BINS = 48
SPECTRUM_VIEWS = 3  # from which the energy above the Nyquist rate is taken
LOWEST_LOG2, HIGHEST_LOG2 = -7.0, 5.0  # of extent over bound; the end bins of the histogram count what lies outside


@dataclass(frozen=True)
class Coverage:
    """The extents of the Gaussians that any training camera sees against their sampling bounds.

    gaussians, seen: numbers of all, and of those that a camera sees.
    edges, counts: histogram of extent over bound at the highest training rate; edges as log2.
    under: share below the bound.  begins: the scale below which half of the Gaussians, as training drew them, alias.
    aliased: (scale, share of the Gaussians, as training drew them, that are below the bound at that scale).
    above_nyquist: share of the splats' energy by recipe and scale.
    """

    gaussians: int
    seen: int
    edges: tuple[float, ...]
    counts: tuple[int, ...]
    under: float | None
    begins: float | None
    aliased: tuple[tuple[float, float], ...]
    above_nyquist: Mapping[tuple[str, float], float | None] = field(default_factory=dict)


def log_multiples(scene: Gaussians, bounds: SamplingBounds) -> Float[Tensor, " seen"]:
    """ln of extent over bound at the highest training rate, of the Gaussians that any training camera sees.

    The extent is that along the middle axis; of a disc, the smaller of its two.
    """
    middle = scene.log_scales.clamp(-MAX_LOG_SCALE, MAX_LOG_SCALE).median(dim=1).values
    extents = middle[bounds.seen].double() + bounds.highest[bounds.seen].log()
    return extents - 0.5 * math.log(NYQUIST_VARIANCE)


def aliasing_begins(multiple: float, dilation: float) -> float:
    """The scale below which a Gaussian of `multiple` times its bound, drawn with `dilation` in px², aliases."""
    return (NYQUIST_VARIANCE / (NYQUIST_VARIANCE * multiple**2 + dilation)) ** 0.5


@torch.no_grad()
def above_nyquist(renderer: Renderer, views: Sequence[Camera], scale: float) -> float | None:
    """Share of the energy of a few views' splats above the Nyquist rate of their samples, at a scale.

    Splats that others hide count as all do.  None if a sample is not a point, or nothing is seen.
    """
    if renderer.recipe.pixel != POINT:
        return None
    total = above = 0.0
    for view in spread(views, SPECTRUM_VIEWS):
        splats = renderer.splats(*renderer.sampled(view.scaled(scale)))
        energy, share = (column.double() for column in energies(splats))
        total, above = total + float(energy.sum()), above + float(energy @ share)
    return above / total if total else None


def coverage(scene: Gaussians, training: TrainingViews, scales: Sequence[float]) -> Coverage:
    """Compare the scene's extents with their bounds, at the training size and at `scales`."""
    multiples = log_multiples(scene, training.bounds)
    logs = (multiples / math.log(2)).clamp(LOWEST_LOG2, HIGHEST_LOG2)
    histogram = torch.histogram(logs.cpu(), torch.linspace(LOWEST_LOG2, HIGHEST_LOG2, BINS + 1, dtype=torch.float64))
    counts = len(scene), len(multiples), tuple(histogram.bin_edges.tolist()), tuple(map(int, histogram.hist))
    if not len(multiples):
        return Coverage(*counts, None, None, ())
    extents, dilation = multiples.exp(), training.convention.kernel
    dilated = (extents.square() + dilation / NYQUIST_VARIANCE).sqrt()
    under = int((multiples < 0).sum()) / len(multiples)
    begins = aliasing_begins(float(extents.median()), dilation)
    return Coverage(*counts, under, begins, tuple((s, float((dilated * s < 1).double().mean())) for s in scales))
