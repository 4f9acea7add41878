"""Pairs of clusters to merge: neighbours along a space-filling curve, ranked by the change that merging makes.

n: clusters, p: pairs.  The change compares the image of a pair with that of the merged cluster through the level's
pixel.  It is ∫ |difference|² over the plane across the view, a mean over three directions.  For Gaussians that only add
up it is a sum of overlaps in closed form.  It is large for clusters that lie apart by more than a pixel, differ in
colour or cross, so large Gaussians stay as they are.  Each cluster counts by its visible share.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from aaplug.core.chunks import curve
from aaplug.levels.clusters import Clusters, pair_moments
from aaplug.levels.covariances import DIAGONAL, PLACES, PLANES, overlap

PIXEL_BLUR = 0.3  # px²: variance of the level's pixel in comparisons; 0.1 to 1 give levels as good
ALPHA_WEIGHT = 0.5  # of squared differences of alpha, beside those of red, green and blue
NEIGHBOURS = 10  # along a curve that a cluster is compared with, on either side
CURVE_SHIFTS = (0.0, 0.23, 0.41)  # neighbours that one curve separates lie together on another
PAIRS_PER_BATCH = 1 << 14  # compared at once: 2 MB, which stay in a core's cache
GATHER_SHARE = 0.25  # of pairs that are too dear: where there are fewer, gathering the others costs more than it saves
MIN_COST_SHARE = 1e-6  # of a pair's own energy; float32 does not tell smaller changes of the image
MAX_JITTER = 0.01  # share by which a cost is raised, so that among equal costs many pairs choose each other
MAX_COST = 1e30  # of a pair whose cost overflows

Index = Tensor | slice
Plane = Sequence[Tensor]  # xx, xy and yy of covariances in a plane, or x and y of offsets


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

    @classmethod
    def none(cls, clusters: Clusters) -> "Edges":
        """No pairs of these clusters."""
        return cls(clusters.labels[:0], clusters.labels[:0], clusters.opacities[:0])

    def __len__(self) -> int:
        return len(self.cost)

    def __getitem__(self, index: Tensor) -> "Edges":
        """The pairs at `index`, a mask or places."""
        index = index.nonzero()[:, 0] if index.dtype == torch.bool else index
        return Edges(self.one[index], self.other[index], self.cost[index])

    def cheapest(self, values: Tensor, count: int) -> "Edges":
        """The pairs whose value is the lowest of all that either cluster is in, for `count` clusters."""
        highest = torch.inf if values.is_floating_point() else torch.iinfo(values.dtype).max
        least = torch.full((count,), highest, dtype=values.dtype)
        for ends in (self.one, self.other):
            least.scatter_reduce_(0, ends, values, "amin")
        return self[(values == least[self.one]) & (values == least[self.other])]


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
        edges = edges[free[edges.one] & free[edges.other]]
    return Edges.joined(parts) if parts else edges


def edges_below(
    clusters: Clusters, rate: float, tolerance: float, smallest: float = 0.0, fresh: Bool[Tensor, " n"] | None = None
) -> Edges:
    """Neighbours in the same chunk whose merging costs at most `tolerance`, in px² of the level at `rate`.

    smallest: px; those whose merged cluster is no larger count too.
    fresh: a pair needs one of these; None for all.
    """
    parts = [Edges.none(clusters)]
    for shift in CURVE_SHIFTS:
        order = torch.argsort(curve(clusters.means, shift), stable=True)
        along = clusters[order]
        for one, other in _neighbours(along.chunks, None if fresh is None else fresh[order]):
            parts.append(_cheap(along[one], along[other], (order[one], order[other]), rate, tolerance, smallest))
    return Edges.joined(parts)


def _neighbours(chunks: Int[Tensor, " n"], fresh: Bool[Tensor, " n"] | None) -> Iterator[tuple[Index, Index]]:
    """Places along a curve of the pairs to compare, a batch at a time; some may be of different chunks."""
    count = len(chunks)
    steps = range(1, min(NEIGHBOURS, count - 1) + 1)
    if fresh is None and count > PAIRS_PER_BATCH:  # whole stretches of the curve need no indices
        for step in steps:
            for i, j in pairwise([*range(0, count - step, PAIRS_PER_BATCH), count - step]):
                yield slice(i, j), slice(i + step, j + step)
    elif steps:  # calls cost more than their work, so all steps share batches
        fresh = torch.ones(count, dtype=torch.bool) if fresh is None else fresh
        near = [((fresh[:-step] | fresh[step:]) & (chunks[:-step] == chunks[step:])).nonzero()[:, 0] for step in steps]
        ends = torch.cat(near), torch.cat([places + step for places, step in zip(near, steps, strict=True)])
        yield from zip(*(each.split(PAIRS_PER_BATCH) for each in ends), strict=True)


def _cheap(
    one: Clusters, other: Clusters, places: tuple[Tensor, Tensor], rate: float, tolerance: float, smallest: float
) -> Edges:
    """Those of these pairs that lie in one chunk and cost at most the tolerance, or stay small."""
    cost = costs(one, other, rate, math.inf if smallest > 0 else tolerance)
    cheap = cost <= tolerance
    if smallest > 0:
        variance = pair_moments(one, other)[2][:, DIAGONAL].sum(dim=1) / 2  # of a flat round one as wide in all
        cheap |= variance.sqrt() * torch.minimum(one.rates, other.rates) * rate <= smallest
    near = (cheap & (one.chunks == other.chunks)).nonzero()[:, 0]
    first, second, cost = places[0][near], places[1][near], cost[near]
    a, b = torch.minimum(first, second), torch.maximum(first, second)
    noise = ((a * 2654435761 + b * 2654304295) % 1048573).float() / 1048573  # of the pair alone, in [0, 1)
    return Edges(a, b, cost * (1 + MAX_JITTER * noise))


def costs(a: Clusters, b: Clusters, rate: float, most: float = math.inf) -> Float[Tensor, " p"]:
    """∫ |image of the pair - image of the merged cluster|², in px² of a level at this relative rate.

    most: what costs more may be infinite instead.  That is faster: most pairs are too dear in the first plane.
    """
    share = torch.where((weights := a.weights + b.weights) > 0, a.weights / weights, 0.5)
    px2 = (torch.minimum(a.rates, b.rates) * rate).square()
    first, second = a.weights * px2, b.weights * px2
    aa, bb = (w * w * _product(c.colours, c.colours) for w, c in ((first, a), (second, b)))
    ab = first * second * _product(a.colours, b.colours)
    variance = PIXEL_BLUR / px2
    cost, whole, left = torch.zeros_like(px2), torch.zeros_like(px2), slice(None)
    for i, j in PLANES:
        x, y = ((b.means[left, k] - a.means[left, k]).to(px2) for k in (i, j))
        places = PLACES[i][i], PLACES[i][j], PLACES[j][j]
        one, other = ([c.covs[left, place] for place in places] for c in (a, b))
        part = share[left]
        spread = part * (1 - part)
        both = [v + part * (u - v) + spread * d for u, v, d in zip(one, other, (x * x, x * y, y * y), strict=True)]
        change, energy = _change(one, other, both, (x, y), part, variance[left], (aa[left], bb[left], ab[left]))
        cost[left] += change / len(PLANES)
        whole[left] += energy / len(PLANES)
        if most < math.inf:
            dear = cost > most * px2
            cost[dear] = torch.inf
            if dear.sum() > GATHER_SHARE * len(dear):
                left = (~dear).nonzero()[:, 0]
    return (cost.maximum(MIN_COST_SHARE * whole) / px2).nan_to_num(MAX_COST).clamp(max=MAX_COST)


def _change(
    one: Plane,
    other: Plane,
    both: Plane,
    offset: tuple[Tensor, Tensor],
    share: Tensor,
    variance: Tensor,
    energies: Plane,
) -> tuple[Float[Tensor, " p"], Float[Tensor, " p"]]:
    """Changes of a plane by merging pairs, and the energy of each pair as if it lay in one place.

    variance: of the pixel, which every covariance takes on.  energies: of the first, of the second, and between them.
    """
    aa, bb, ab = energies

    def through(u: Plane, v: Plane, offset: Plane | None = None) -> Tensor:
        xx, xy, yy = (s + t for s, t in zip(u, v, strict=True))
        return overlap((xx + 2 * variance, xy, yy + 2 * variance), offset)

    x, y = offset
    whole = (aa + 2 * ab + bb) * through(both, both)
    cost = aa * through(one, one) + bb * through(other, other) + 2 * ab * through(one, other, offset) + whole
    cost -= 2 * (aa + ab) * through(one, both, ((1 - share) * x, (1 - share) * y))
    cost -= 2 * (ab + bb) * through(other, both, (share * x, share * y))
    return cost, whole


def _product(a: Float[Tensor, "p 3"], b: Float[Tensor, "p 3"]) -> Float[Tensor, " p"]:
    return a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2] + ALPHA_WEIGHT
