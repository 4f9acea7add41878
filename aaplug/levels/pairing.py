"""Pairs of clusters to merge: neighbours along a space-filling curve, ranked by the change that merging makes.

n: clusters, p: pairs.  The change compares the image of a pair with that of the merged cluster through the level's
pixel.  It is ∫ |difference|² over the plane across the view, a mean over three directions.  For Gaussians that only add
up it is a sum of overlaps in closed form.  It is large for clusters that lie apart by more than a pixel, differ in
colour or cross, so large Gaussians stay as they are.  Each cluster counts by its visible share.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from aaplug.core.chunks import curve
from aaplug.levels.clusters import Clusters, pair_moments
from aaplug.levels.covariances import DIAGONAL, Packed, blur, overlaps

PIXEL_BLUR = 0.3  # px²: variance of the level's pixel in comparisons; 0.1 to 1 give levels as good
ALPHA_WEIGHT = 0.5  # of squared differences of alpha, beside those of red, green and blue
NEIGHBOURS = 10  # along a curve that a cluster is compared with, on either side
CURVE_SHIFTS = (0.0, 0.23, 0.41)  # neighbours that one curve separates lie together on another
PAIRS_PER_BATCH = 1 << 16  # compared at once: 10 MB
MIN_COST_SHARE = 1e-6  # of a pair's own energy; float32 does not tell smaller changes of the image
MAX_JITTER = 0.01  # share by which a cost is raised, so that among equal costs many pairs choose each other
MAX_COST = 1e30  # of a pair whose cost overflows


@dataclass(frozen=True, eq=False)
class Edges:
    """Pairs of clusters and what merging each costs, in px² of the level.  e: pairs."""

    one: Int[Tensor, " e"]
    other: Int[Tensor, " e"]
    cost: Float[Tensor, " e"]

    @classmethod
    def joined(cls, parts: Sequence["Edges"]) -> "Edges":
        """The pairs of several parts, at least one."""
        return cls(*(torch.cat([getattr(part, name) for part in parts]) for name in ("one", "other", "cost")))

    def __len__(self) -> int:
        return len(self.cost)

    def __getitem__(self, index: Tensor) -> "Edges":
        """The pairs at `index`."""
        return Edges(self.one[index], self.other[index], self.cost[index])

    def cheapest(self, values: Tensor, count: int) -> "Edges":
        """The pairs whose value is the lowest of all that either cluster is in, for `count` clusters."""
        highest = torch.inf if values.is_floating_point() else torch.iinfo(values.dtype).max
        least = torch.full((count,), highest, dtype=values.dtype)
        for ends in (self.one, self.other):
            least.scatter_reduce_(0, ends, values, "amin")
        return self[((values == least[self.one]) & (values == least[self.other])).nonzero()[:, 0]]


def matching(edges: Edges, count: int) -> Edges:
    """Pairs out of these in which no cluster occurs twice: cheaper ones first (locally dominant edges, Preis 1999).

    count: of the clusters.
    """
    parts = []
    while len(edges):
        equals = edges.cheapest(edges.cost, count)
        pairs = equals.cheapest(torch.arange(len(equals)), count)  # of equal costs the first
        parts.append(pairs)
        free = torch.ones(count, dtype=torch.bool)
        free[pairs.one] = free[pairs.other] = False
        edges = edges[(free[edges.one] & free[edges.other]).nonzero()[:, 0]]
    return Edges.joined(parts) if parts else edges


def edges_below(clusters: Clusters, rate: float, tolerance: float, smallest: float = 0.0) -> Edges:
    """Neighbours in the same chunk whose merging costs at most `tolerance`, in px² of the level at `rate`.

    smallest: px; those whose merged cluster is no larger count too.
    """
    parts = [Edges(clusters.labels[:0], clusters.labels[:0], clusters.opacities[:0])]
    for shift in CURVE_SHIFTS:
        order = torch.argsort(curve(clusters.means, shift), stable=True)
        along = clusters[order]
        for start in range(0, len(order), PAIRS_PER_BATCH):
            part = slice(start, start + PAIRS_PER_BATCH + NEIGHBOURS)
            parts.extend(_neighbours(along[part], order[part], rate, tolerance, smallest))
    return Edges.joined(parts)


def _neighbours(
    along: Clusters, places: Int[Tensor, " c"], rate: float, tolerance: float, smallest: float
) -> Iterator[Edges]:
    """Cheap pairs of a cluster on a part of the curve and one after it."""
    for step in range(1, min(NEIGHBOURS, len(along) - 1) + 1):
        one, other = along[:-step], along[step:]
        cost = costs(one, other, rate)
        cheap = cost <= tolerance
        if smallest > 0:
            variance = pair_moments(one, other)[2][:, DIAGONAL].sum(dim=1) / 2  # of a flat round one as wide in all
            cheap |= variance.sqrt() * torch.minimum(one.rates, other.rates) * rate <= smallest
        near = (cheap & (one.chunks == other.chunks)).nonzero()[:, 0]
        a, b = places[:-step][near], places[step:][near]
        a, b = torch.minimum(a, b), torch.maximum(a, b)
        noise = ((a * 2654435761 + b * 2654304295) % 1048573).float() / 1048573  # of the pair alone, in [0, 1)
        yield Edges(a, b, cost[near] * (1 + MAX_JITTER * noise))


def costs(a: Clusters, b: Clusters, rate: float) -> Float[Tensor, " p"]:
    """∫ |image of the pair - image of the merged cluster|², in px² of a level at this relative rate."""
    _, share, covs = pair_moments(a, b)
    px = torch.minimum(a.rates, b.rates) * rate
    variance = PIXEL_BLUR / px.square()
    one, other, both = (blur(c, variance) for c in (a.covs, b.covs, covs))
    offsets = (b.means - a.means).to(covs)
    first, second = a.weights * px.square(), b.weights * px.square()
    aa, bb = (w * w * _product(c.colours, c.colours) for w, c in ((first, a), (second, b)))
    ab = first * second * _product(a.colours, b.colours)
    whole = (aa + 2 * ab + bb) * _overlap(2 * both)
    cost = aa * _overlap(2 * one) + bb * _overlap(2 * other) + 2 * ab * _overlap(one + other, offsets) + whole
    cost -= 2 * (aa + ab) * _overlap(one + both, (1 - share)[:, None] * offsets)
    cost -= 2 * (ab + bb) * _overlap(other + both, share[:, None] * offsets)
    return (cost.maximum(MIN_COST_SHARE * whole) / px.square()).nan_to_num(MAX_COST).clamp(max=MAX_COST)


def _overlap(covs: Packed, offsets: Float[Tensor, "p 3"] | None = None) -> Float[Tensor, " p"]:
    return overlaps(covs, offsets).mean(dim=1)


def _product(a: Float[Tensor, "p 3"], b: Float[Tensor, "p 3"]) -> Float[Tensor, " p"]:
    return (a * b).sum(dim=1) + ALPHA_WEIGHT
