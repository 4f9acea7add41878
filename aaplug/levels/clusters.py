"""Clusters: groups of Gaussians, each as the one Gaussian that has the group's moments.

n: clusters.  A cluster is kept as training saw it, with training's dilation in its covariance, because many Gaussians
are thinner than the pixel that they were trained with.  `gaussians_of` takes the dilation out again.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor

from aaplug.core.cameras import Camera
from aaplug.core.gaussians import MAX_LOG_SCALE, MIN_OPACITY, Gaussians
from aaplug.core.projection import quats_of
from aaplug.core.rules import RULES_3DGS
from aaplug.core.runs import starts_of
from aaplug.core.sampling import median_rates
from aaplug.levels.covariances import Packed, area, areas, blur, covariances, outer, overlaps, pack, unpack
from aaplug.system.errors import FrameError, counted

MAX_OPACITY = RULES_3DGS.max_alpha  # of a merged Gaussian; no renderer shows more
# An opacity above MAX_OPACITY is divided by its excess, and the Gaussian's area grows by this power of the excess.  The
# power 1 keeps the energy of a Gaussian alone, 0 keeps its size.  Others overlap what it gains, so that one half is
# best beside them (examples/guides/levels.md)
WIDENING_POWER = 0.5
MAX_SIGMA = 1e6  # px: what is larger looks the same, but its squared area overflows float32
# The visible share of a Gaussian of which nothing is known.  Its square, 0.08, lies between the means of two scenes,
# 0.05 and 0.19
USUAL_VISIBLE = 0.28
MIN_VISIBLE = 1e-3  # a hidden Gaussian still has a place and a colour
MIN_SIGMA = 0.02  # px: no standard deviation is less once the dilation is taken out


@dataclass(frozen=True, eq=False)
class Clusters:
    """Clusters in one order, which their labels refer to.

    means: world units, in float64, so that far from the origin small distances count.
    covs: as training saw them.
    opacities: of the cluster alone, as training saw it.  Above 1, only a wider Gaussian has this energy: see `opaque`.
    visible: share of the cluster's light that views show, from 0 to 1.
    weights: sums of the Gaussians' opacity times projected area times visible share, in squared world units.
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

    def __getitem__(self, index: Int[Tensor, " k"]) -> "Clusters":
        """The clusters at these places; the labels stay as they are."""
        # several times faster than [index], with each component apart in memory, where arithmetic on it is fastest
        return replace(self, **{name: each.t().index_select(-1, index).t() for name, each in self.columns.items()})

    @property
    def columns(self) -> dict[str, Tensor]:
        """Everything but the labels, by name."""
        return {name: value for name, value in vars(self).items() if name not in ("labels", "opaque")}

    @cached_property
    def opaque(self) -> "Clusters":
        """The same energies with opacities of at most `MAX_OPACITY`; the excess goes into the area."""
        excess = (self.opacities / MAX_OPACITY).clamp(min=1)
        return replace(self, covs=self.covs * excess[:, None], opacities=self.opacities / excess)


def rates_of(scene: Gaussians, cameras: Sequence[Camera]) -> Float[Tensor, " n"]:
    """Median rate over the cameras that see a Gaussian, px per world unit; the lowest of these for one that none sees.

    Raises:
        FrameError: no camera sees any.
    """
    rates = median_rates(scene.means, cameras)
    positive = rates[rates > 0]
    if not len(positive):
        raise FrameError(scene.name, f"none of its Gaussians is seen by any of {counted(len(cameras), 'camera')}")
    return torch.where(rates > 0, rates, positive.min())


def clusters_of(
    scene: Gaussians,
    rates: Float[Tensor, " n"],
    chunks: Int[Tensor, " n"] | None = None,
    visible: Float[Tensor, " n"] | None = None,
) -> Clusters:
    """Every Gaussian as a cluster of its own.

    chunks: see `Clusters`; None for one of all.
    visible: see `visibility`; NaN where nothing is known, None for all of each Gaussian.
    """
    rates = rates.to(scene.means)
    max_log_scales = (MAX_SIGMA / rates).log()[:, None].to(scene.log_scales)
    raw = covariances(replace(scene, log_scales=scene.log_scales.minimum(max_log_scales)))
    covs = blur(raw, scene.convention.kernel / rates.square())
    opacities = scene.opacities
    if scene.convention.compensated:
        opacities = opacities * area(raw) / area(covs)
    share = torch.ones_like(opacities) if visible is None else visible.to(opacities)
    visible = share.nan_to_num(USUAL_VISIBLE).clamp(min=MIN_VISIBLE)
    weights = opacities.clamp(min=MIN_OPACITY) * area(covs) * visible
    colours = scene.base_colours
    labels = torch.arange(len(scene))
    chunks = torch.zeros_like(labels) if chunks is None else chunks
    each = Clusters(scene.means.double(), covs, opacities, visible, weights, colours, rates, chunks, labels)
    return each[labels]  # with each component apart in memory


def merge_pairs(a: Clusters, b: Clusters) -> Clusters:
    """Merge each cluster of `a` with the one of `b` at its place; the labels are those of `a`.

    Mean, covariance and colour are the pair's moments under its weights.  Alone, the result has the pair's energy: the
    integral of the alpha of both together, a + b - a b, over a plane across the view, as a mean over three directions.
    Each cluster counts by its visible share, so that a hidden one adds nothing to a visible one.
    """
    weights, share, covs = pair_moments(a, b)
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


def pair_moments(a: Clusters, b: Clusters) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"], Packed]:
    """Weight of each pair, the share that `a` has in it, and the covariance with the spread of both means."""
    weights = a.weights + b.weights
    share = torch.where(weights > 0, a.weights / weights, 0.5)
    one, other = share[:, None], (1 - share)[:, None]
    return weights, share, one * a.covs + other * b.covs + one * other * outer((b.means - a.means).to(a.covs))


def gaussians_of(clusters: Clusters, scene: Gaussians, weights: Float[Tensor, " m"]) -> Gaussians:
    """The scene of these clusters; one of a single Gaussian is that Gaussian, to the bit.

    weights: of the scene's Gaussians, as `clusters_of` gives them.
    """
    counts = torch.bincount(clusters.labels, minlength=len(clusters))
    order = torch.argsort(clusters.labels, stable=True)
    first = order[starts_of(counts)]
    many = (counts > 1).nonzero()[:, 0]
    columns = {name: column[first] for name, column in scene.columns.items()}
    for name, values in _shapes(clusters[many], scene).items():
        columns[name][many] = values.to(columns[name])
    columns["sh"][many] = _mean_harmonics(scene, clusters, weights)[many]
    return replace(scene, **columns, origin=None, extras={})


def _shapes(clusters: Clusters, scene: Gaussians) -> dict[str, Tensor]:
    """Columns of the Gaussians that training would have seen as these clusters."""
    excess = (clusters.opacities / MAX_OPACITY).clamp(min=1).double()
    covs = clusters.covs.double() * excess.pow(WIDENING_POWER)[:, None]
    px2 = clusters.rates.double().square()
    variances, axes = torch.linalg.eigh(unpack(blur(covs, -scene.convention.kernel / px2)))
    variances = variances.maximum((MIN_SIGMA**2 / px2)[:, None])
    if scene.flat:  # the disc across the thinnest axis
        variances, axes = variances.flip(1), axes.flip(2)
    axes = axes * torch.linalg.det(axes)[:, None, None]  # a reflection becomes a rotation
    opacities = clusters.opacities / excess
    if scene.convention.compensated:
        opacities = opacities * area(covs) / area(pack((axes * variances[:, None]) @ axes.mT))
    logits = opacities.clamp(MIN_OPACITY, MAX_OPACITY).logit()
    log_scales = 0.5 * variances.log()
    if scene.flat:
        log_scales[:, 2] = -MAX_LOG_SCALE
    return {"means": clusters.means, "quats": quats_of(axes), "log_scales": log_scales, "logit_opacities": logits}


def _mean_harmonics(scene: Gaussians, clusters: Clusters, weights: Float[Tensor, " m"]) -> Float[Tensor, "n k 3"]:
    """Weighted mean of the harmonics, one coefficient after the other, so that little memory is taken at once."""

    def sums(values: Float[Tensor, " m"]) -> Float[Tensor, " n"]:
        return values.new_zeros(len(clusters)).index_add_(0, clusters.labels, values)

    weights = weights.double()
    total = sums(weights)
    means = scene.sh.new_empty(len(clusters), *scene.sh.shape[1:])
    for k in range(scene.sh.shape[1]):
        for channel in range(3):
            means[:, k, channel] = sums(scene.sh[:, k, channel] * weights) / total
    return means
