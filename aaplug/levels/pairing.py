"""Which clusters to merge: neighbours along a space-filling curve, ranked by how much their merging changes the image.

n: clusters, p: pairs.  The image of a pair is compared with that of the merged cluster through the level's pixel, as
∫ |difference|² over the plane across the view, a mean over three directions.  For Gaussians that only add up it is a
sum of overlaps in closed form.  It is large for clusters that lie apart by more than a pixel, differ in colour or
cross, and so keeps what is large as it is.  Each cluster counts by how much of it views show.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from aaplug.levels.clusters import Clusters, paired
from aaplug.levels.covariances import DIAGONAL, Packed, blurred, overlaps

PIXEL_BLUR = 0.3  # px²: of the level's pixel, when images of pairs are compared; 0.1 to 1 give levels as good
ALPHA_WEIGHT = 0.5  # of squared differences of alpha, beside those of red, green and blue
WINDOW = 10  # neighbours along a curve that a cluster is compared with, on either side
SHIFTS = (0.0, 0.23, 0.41)  # of the curves: what one separates lies together on another
CHUNK = 1 << 16  # pairs compared at once: 10 MB
BITS = 21  # of a coordinate along the curve
SPREADS = ((32, 0x1F00000000FFFF), (16, 0x1F0000FF0000FF), (8, 0x100F00F00F00F00F), (4, 0x10C30C30C30C30C3),
           (2, 0x1249249249249249))  # fmt: skip
ROUNDING = 1e-6  # share of a pair's own energy below which float32 does not tell how much the image changes
JITTER = 0.01  # largest share by which a cost is raised, so that among equal costs many pairs choose each other
MOST_COST = 1e30  # of a pair whose cost overflows


def curve(means: Float[Tensor, "n 3"], shift: float = 0.0) -> Int[Tensor, " n"]:
    """Place of each mean along a Morton curve (Morton 1966) through space, which is squeezed far from the middle."""
    offsets = means - means.median(dim=0).values
    size = offsets.abs().median().clamp(min=torch.finfo(means.dtype).tiny)
    squeezed = offsets / (size + offsets.abs())  # between -1 and 1
    cells = ((0.25 * (squeezed + 1) + shift) * (2**BITS - 1)).long()
    for by, mask in SPREADS:
        cells = (cells | (cells << by)) & mask
    return cells[:, 0] | cells[:, 1] << 1 | cells[:, 2] << 2


@dataclass(frozen=True)
class Edges:
    """Pairs of clusters and what merging each costs, in px² of the level.  e: pairs."""

    one: Int[Tensor, " e"]
    other: Int[Tensor, " e"]
    cost: Float[Tensor, " e"]

    def __len__(self) -> int:
        return len(self.cost)

    def __getitem__(self, index: Tensor) -> "Edges":
        """The pairs at `index`."""
        return Edges(self.one[index], self.other[index], self.cost[index])

    def least(self, values: Tensor, count: int) -> Tensor:
        """Lowest value of the pairs that a cluster is in, for each of `count` clusters."""
        highest = torch.inf if values.is_floating_point() else torch.iinfo(values.dtype).max
        found = torch.full((count,), highest, dtype=values.dtype)
        for ends in (self.one, self.other):
            found.scatter_reduce_(0, ends, values, "amin")
        return found

    def lowest(self, values: Tensor, count: int) -> "Edges":
        """The pairs whose value is the lowest of all that either cluster is in."""
        least = self.least(values, count)
        return self[((values == least[self.one]) & (values == least[self.other])).nonzero()[:, 0]]


def all_of(parts: Sequence[Edges]) -> Edges:
    """The pairs of several parts, at least one."""
    return Edges(*(torch.cat([getattr(part, name) for part in parts]) for name in ("one", "other", "cost")))


def matched(edges: Edges, count: int) -> Edges:
    """Pairs out of these in which no cluster occurs twice: cheaper ones first (locally dominant edges, Preis 1999).

    count: of the clusters.
    """
    kept = []
    while len(edges):
        cheapest = edges.lowest(edges.cost, count)
        kept.append(cheapest.lowest(torch.arange(len(cheapest)), count))  # of equal costs the first
        free = torch.ones(count, dtype=torch.bool)
        free[kept[-1].one] = free[kept[-1].other] = False
        edges = edges[(free[edges.one] & free[edges.other]).nonzero()[:, 0]]
    return all_of(kept) if kept else edges


def edges_below(clusters: Clusters, rate: float, tolerance: float, smallest: float = 0.0) -> Edges:
    """Neighbours in the same chunk whose merging costs at most `tolerance`, in px² of the level at `rate`.

    smallest: px; those whose merged cluster is no larger count too.
    """
    found = [Edges(clusters.labels[:0], clusters.labels[:0], clusters.opacities[:0])]
    for shift in SHIFTS:
        order = torch.argsort(curve(clusters.means, shift), stable=True)
        along = clusters[order]
        for start in range(0, len(order), CHUNK):
            part = slice(start, start + CHUNK + WINDOW)
            found.extend(_compared(along[part], order[part], rate, tolerance, smallest))
    return all_of(found)


def _compared(
    along: Clusters, places: Int[Tensor, " c"], rate: float, tolerance: float, smallest: float
) -> Iterator[Edges]:
    """Each cluster of a part of the curve with those after it."""
    for step in range(1, min(WINDOW, len(along) - 1) + 1):
        one, other = along[:-step], along[step:]
        cost = costs(one, other, rate)
        cheap = cost <= tolerance
        if smallest > 0:
            cheap |= _sizes(one, other, rate) <= smallest
        near = (cheap & (one.chunks == other.chunks)).nonzero()[:, 0]
        a, b = places[:-step][near], places[step:][near]
        a, b = torch.minimum(a, b), torch.maximum(a, b)
        yield Edges(a, b, cost[near] * (1 + JITTER * _noise(a, b)))


def costs(a: Clusters, b: Clusters, rate: float) -> Float[Tensor, " p"]:
    """∫ |image of the pair - image of the merged cluster|², in px² of a level at this relative rate."""
    _, share, covs = paired(a, b)
    px = torch.minimum(a.rates, b.rates) * rate
    blur = PIXEL_BLUR / px.square()
    one, other, both = (blurred(c, blur) for c in (a.covs, b.covs, covs))
    offsets = (b.means - a.means).to(covs)
    first, second = a.weights * px.square(), b.weights * px.square()
    aa, bb = (w * w * _product(c.colours, c.colours) for w, c in ((first, a), (second, b)))
    ab = first * second * _product(a.colours, b.colours)
    whole = (aa + 2 * ab + bb) * _overlap(2 * both)
    cost = aa * _overlap(2 * one) + bb * _overlap(2 * other) + 2 * ab * _overlap(one + other, offsets) + whole
    cost -= 2 * (aa + ab) * _overlap(one + both, (1 - share)[:, None] * offsets)
    cost -= 2 * (ab + bb) * _overlap(other + both, share[:, None] * offsets)
    return (cost.maximum(ROUNDING * whole) / px.square()).nan_to_num(MOST_COST).clamp(max=MOST_COST)


def _sizes(a: Clusters, b: Clusters, rate: float) -> Float[Tensor, " p"]:
    """Standard deviation of each merged cluster as a flat round one of the same total variance, in px of the level."""
    total = paired(a, b)[2][:, DIAGONAL].sum(dim=1)
    return (total / 2).sqrt() * torch.minimum(a.rates, b.rates) * rate


def _overlap(covs: Packed, offsets: Float[Tensor, "p 3"] | None = None) -> Float[Tensor, " p"]:
    return overlaps(covs, offsets).mean(dim=1)


def _product(a: Float[Tensor, "p 3"], b: Float[Tensor, "p 3"]) -> Float[Tensor, " p"]:
    return (a * b).sum(dim=1) + ALPHA_WEIGHT


def _noise(a: Int[Tensor, " p"], b: Int[Tensor, " p"]) -> Float[Tensor, " p"]:
    """A number in [0, 1) that depends on the pair alone and looks random."""
    return ((a * 2654435761 + b * 2654304295) % 1048573).float() / 1048573
