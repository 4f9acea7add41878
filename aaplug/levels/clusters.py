"""Clusters: groups of Gaussians, each as the one Gaussian that has the group's moments.

n: clusters.  A cluster is kept as training saw it, with training's dilation in its covariance (`seen`), because many
Gaussians are thinner than the pixel that they were trained with.  `alone` takes the dilation out again.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor

from aaplug.core.gaussians import MIN_OPACITY, Gaussians
from aaplug.core.rules import RULES_3DGS
from aaplug.core.spherical_harmonics import COLOUR_OFFSET, SH_C0
from aaplug.levels.covariances import (
    Packed,
    area,
    areas,
    blurred,
    covariances,
    outer,
    overlaps,
    packed,
    quats_of,
    unpacked,
)

MAX_OPACITY = RULES_3DGS.max_alpha  # of a merged Gaussian; no renderer shows more
# power of what an opacity exceeds its cap by, of which the area of the Gaussian grows.  1 keeps its energy when it is
# seen alone, 0 its size.  Beside others, which overlap what it gains, the half is best (examples/guides/levels.md)
WIDENING = 0.5
LARGEST = 1e6  # px: what is larger looks the same, but its squared area overflows float32
# visible share where nothing is known: its square, 0.08, lies between the means of two scenes, 0.05 and 0.19
USUAL = 0.28
LEAST_VISIBLE = 1e-3  # what is hidden still has a place and a colour
THINNEST = 0.02  # px: standard deviation to which the dilation is taken out at most


@dataclass(frozen=True)
class Clusters:
    """Clusters in one order, which their labels refer to.

    means: world units, in float64, so that far from the origin small distances count.
    covs: as training saw them.
    opacities: of the cluster alone, as training saw it.  Above 1, only a wider Gaussian has this energy: see `opaque`.
    visible: share of the cluster's light that views show, from 0 to 1.
    weights: summed opacity times projected area times visible share of the Gaussians, in squared world units.
    colours: weighted mean, without view dependence.
    rates: training's sampling rate, px per world unit.
    chunks: the chunk of each; clusters of different ones are not merged.
    labels: the cluster of each Gaussian of the scene.
    """

    means: Float[Tensor, "n 3"]
    covs: Packed
    opacities: Float[Tensor, " n"]
    visible: Float[Tensor, " n"]
    weights: Float[Tensor, " n"]
    colours: Float[Tensor, "n 3"]
    rates: Float[Tensor, " n"]
    chunks: Int[Tensor, " n"]
    labels: Int[Tensor, " m"]

    def __len__(self) -> int:
        return len(self.means)

    def __getitem__(self, index: Tensor | slice) -> "Clusters":
        """The clusters at `index`; the labels stay as they are."""
        return replace(self, **{name: column[index] for name, column in self.columns.items()})

    @property
    def columns(self) -> dict[str, Tensor]:
        """Everything but the labels, by name."""
        return {name: value for name, value in vars(self).items() if name not in ("labels", "opaque")}

    @cached_property
    def opaque(self) -> "Clusters":
        """The same energies with opacities of at most `MAX_OPACITY`: what exceeds it goes into the area."""
        excess = (self.opacities / MAX_OPACITY).clamp(min=1)
        return replace(self, covs=self.covs * excess[:, None], opacities=self.opacities / excess)


def seen(
    scene: Gaussians,
    rates: Float[Tensor, " n"],
    chunks: Int[Tensor, " n"] | None = None,
    visible: Float[Tensor, " n"] | None = None,
) -> Clusters:
    """Every Gaussian as a cluster of its own.

    chunks: see `Clusters`; None for one of all.
    visible: see `visibility`; NaN where nothing is known, None for all of each Gaussian.
    """
    largest = (LARGEST / rates).log()[:, None].to(scene.log_scales)
    raw = covariances(replace(scene, log_scales=scene.log_scales.minimum(largest)))
    covs = blurred(raw, scene.convention.kernel / rates.square())
    opacities = scene.opacities
    if scene.convention.compensated:
        opacities = opacities * area(raw) / area(covs)
    visible = torch.ones_like(opacities) if visible is None else visible.nan_to_num(USUAL).clamp(min=LEAST_VISIBLE)
    weights = opacities.clamp(min=MIN_OPACITY) * area(covs) * visible
    colours = COLOUR_OFFSET + SH_C0 * scene.sh[:, 0]
    own = torch.arange(len(scene))
    chunks = torch.zeros_like(own) if chunks is None else chunks
    return Clusters(scene.means.double(), covs, opacities, visible, weights, colours, rates, chunks, own)


def merged_pairs(a: Clusters, b: Clusters) -> Clusters:
    """Merge each cluster of `a` with the one of `b` at its place; the labels are those of `a`.

    Mean, covariance and colour are the pair's moments under its weights.  Alone, the result has the pair's energy: the
    integral of the alpha of both together, a + b - a b, over a plane across the view, as a mean over three directions.
    What views show of either counts, so that what is hidden adds nothing to what is seen.
    """
    weights, share, covs = paired(a, b)
    first, second = a.opaque, b.opaque
    offsets = (b.means - a.means).to(covs)
    visible = b.visible.lerp(a.visible, share)
    one = (first.opacities * a.visible / visible)[:, None] * areas(first.covs)
    other = (second.opacities * b.visible / visible)[:, None] * areas(second.covs)
    both = one * other * overlaps(first.covs + second.covs, offsets)
    return replace(
        a,
        means=a.means + (1 - share).double()[:, None] * (b.means - a.means),
        covs=covs,
        opacities=(one + other - both).mean(dim=1) / area(covs),
        visible=visible,
        weights=weights,
        colours=b.colours.lerp(a.colours, share[:, None]),
        rates=b.rates.lerp(a.rates, share),
    )


def paired(a: Clusters, b: Clusters) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"], Packed]:
    """Weight of each pair, the share that `a` has in it, and the covariance with the spread of both means."""
    weights = a.weights + b.weights
    share = torch.where(weights > 0, a.weights / weights, 0.5)
    one, other = share[:, None], (1 - share)[:, None]
    return weights, share, one * a.covs + other * b.covs + one * other * outer((b.means - a.means).to(a.covs))


def alone(clusters: Clusters, scene: Gaussians, weights: Float[Tensor, " m"]) -> Gaussians:
    """The scene of these clusters; one of a single Gaussian is that Gaussian, to the bit.

    weights: of the scene's Gaussians, as `seen` gives them.
    """
    counts = torch.bincount(clusters.labels, minlength=len(clusters))
    order = torch.argsort(clusters.labels, stable=True)
    first = order[counts.cumsum(0) - counts]
    many = (counts > 1).nonzero()[:, 0]
    whole = replace(scene, origin=None, pixel_sizes=None)[first]
    columns = {name: column.clone() for name, column in whole.columns.items()}
    for name, values in _shapes(clusters[many], scene).items():
        columns[name][many] = values.to(columns[name])
    columns["sh"][many] = _mean_harmonics(scene, clusters, weights)[many]
    return replace(whole, **columns)


def _shapes(clusters: Clusters, scene: Gaussians) -> dict[str, Tensor]:
    """Columns of the Gaussians that training would have seen as these clusters."""
    excess = (clusters.opacities / MAX_OPACITY).clamp(min=1).double()
    shown = clusters.covs.double() * excess.pow(WIDENING)[:, None]
    px2 = clusters.rates.double().square()
    variances, axes = torch.linalg.eigh(unpacked(blurred(shown, -scene.convention.kernel / px2)))
    variances = variances.maximum((THINNEST**2 / px2)[:, None])
    axes = axes * torch.linalg.det(axes)[:, None, None]  # a reflection becomes a rotation
    opacities = clusters.opacities / excess
    if scene.convention.compensated:
        opacities = opacities * area(shown) / area(packed((axes * variances[:, None]) @ axes.mT))
    logits = opacities.clamp(MIN_OPACITY, MAX_OPACITY).logit()
    return {
        "means": clusters.means,
        "quats": quats_of(axes),
        "log_scales": 0.5 * variances.log(),
        "logit_opacities": logits,
    }


def _mean_harmonics(scene: Gaussians, clusters: Clusters, weights: Float[Tensor, " m"]) -> Float[Tensor, "n k 3"]:
    """Weighted mean of the harmonics, one coefficient after the other, so that little memory is taken at once."""
    weights = weights.double()
    total = _summed(weights, clusters)
    found = scene.sh.new_empty(len(clusters), *scene.sh.shape[1:])
    for k in range(scene.sh.shape[1]):
        for channel in range(3):
            found[:, k, channel] = _summed(scene.sh[:, k, channel] * weights, clusters) / total
    return found


def _summed(values: Float[Tensor, " m"], clusters: Clusters) -> Float[Tensor, " n"]:
    """Sum over the Gaussians of each cluster."""
    return values.new_zeros(len(clusters)).index_add_(0, clusters.labels, values)
