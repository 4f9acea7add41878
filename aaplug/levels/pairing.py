"""Pairs of clusters to merge: neighbours along a space-filling curve, ranked by the change that merging makes.

n: clusters, p: pairs.  The change compares the image of a pair with that of the merged cluster through the level's
pixel.  It is ∫ |difference|² over the plane across the view, a mean over three directions.  For Gaussians that only add
up it is a sum of overlaps in closed form.  It is large for clusters that lie apart by more than a pixel, differ in
colour or cross, so large Gaussians stay as they are.  Each cluster counts by its visible share.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from aaplug.core.chunks import curve, squeezed
from aaplug.levels.clusters import Clusters, pair_moments
from aaplug.levels.covariances import DIAGONAL, PLACES, PLANES

PIXEL_BLUR = 0.3  # px²: variance of the level's pixel in comparisons; 0.1 to 1 give levels as good
ALPHA_WEIGHT = 0.5  # of squared differences of alpha, beside those of red, green and blue
NEIGHBOURS = 10  # along a curve that a cluster is compared with, on either side
CURVE_SHIFTS = (0.0, 0.23, 0.41)  # neighbours that one curve separates lie together on another
PAIRS_PER_BATCH = 1 << 16  # compared at once: some 8 MB, in loops long enough for two threads
GATHER_SHARE = 0.5  # of pairs that are too dear: where there are fewer, gathering the others costs more than it saves
MIN_COST_SHARE = 1e-6  # of a pair's own energy; float32 does not tell smaller changes of the image
MAX_JITTER = 0.01  # share by which a cost is raised, so that among equal costs many pairs choose each other
MAX_COST = 1e30  # of a pair whose cost overflows
CHANGE_SCALE = 2 * math.sqrt(2) * math.pi * len(PLANES)  # of what `_change` sums in all planes to its mean

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

    def __len__(self) -> int:
        return len(self.cost)

    def __getitem__(self, index: Tensor) -> "Edges":
        """The pairs at `index`, a mask or places."""
        index = index.nonzero()[:, 0] if index.dtype == torch.bool else index
        return Edges(*(each.index_select(0, index) for each in (self.one, self.other, self.cost)))

    def cheapest(self, values: Tensor, count: int) -> "Edges":
        """The pairs whose value is the lowest of all that either cluster is in, for `count` clusters."""
        highest = torch.inf if values.is_floating_point() else torch.iinfo(values.dtype).max
        least = torch.full((count,), highest, dtype=values.dtype)
        for ends in (self.one, self.other):
            least.scatter_reduce_(0, ends, values, "amin")
        return self[(values == least.index_select(0, self.one)) & (values == least.index_select(0, self.other))]


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
        edges = edges[free.index_select(0, edges.one) & free.index_select(0, edges.other)]
    return Edges.joined(parts) if parts else edges


def edges_below(
    clusters: Clusters, rate: float, tolerance: float, smallest: float = 0.0, fresh: Bool[Tensor, " n"] | None = None
) -> Edges:
    """Neighbours in the same chunk whose merging costs at most `tolerance`, in px² of the level at `rate`.

    smallest: px; those whose merged cluster is no larger count too.
    fresh: a pair needs one of these; None for all.
    """
    parts = [Edges(clusters.labels[:0], clusters.labels[:0], clusters.opacities[:0])]
    ends = [torch.cat(pairs).split(PAIRS_PER_BATCH) for pairs in zip(*_neighbours(clusters, fresh), strict=True)]
    for one, other in zip(*ends, strict=True):
        cost = costs(clusters, one, other, rate, math.inf if smallest > 0 else tolerance)
        cheap = cost <= tolerance
        if smallest > 0:
            a, b = clusters[one], clusters[other]
            variance = pair_moments(a, b)[2][:, DIAGONAL].sum(dim=1) / 2  # of a flat round one as wide in all
            cheap |= variance.sqrt() * torch.minimum(a.rates, b.rates) * rate <= smallest
        edges = Edges(one, other, cost)[cheap]
        noise = (edges.one * 2654435761 + edges.other * 2654304295) % 1048573 / 1048573  # of the pair alone, in [0, 1)
        parts.append(replace(edges, cost=edges.cost * (1 + MAX_JITTER * noise)))
    return Edges.joined(parts)


def _neighbours(clusters: Clusters, fresh: Bool[Tensor, " n"] | None) -> Iterator[tuple[Tensor, Tensor]]:
    """Lower and higher place of each pair to compare, for one step along a curve after another.

    Neighbours along several curves are one pair.
    """
    count, means = len(clusters), squeezed(clusters.means)
    earlier = list[Tensor]()  # place of each cluster along the curves before
    for shift in CURVE_SHIFTS:
        order = torch.argsort(curve(means, shift), stable=True)
        chunks, wanted = clusters.chunks[order], None if fresh is None else fresh[order]
        places = [each[order] for each in earlier]
        for step in range(1, min(NEIGHBOURS, count - 1) + 1):
            near = chunks[:-step] == chunks[step:]
            if wanted is not None:
                near &= wanted[:-step] | wanted[step:]
            for each in places:
                near &= (each[:-step] - each[step:]).abs_() > NEIGHBOURS
            first = near.nonzero()[:, 0]
            ends = order.index_select(0, first), order.index_select(0, first + step)
            yield torch.minimum(*ends), torch.maximum(*ends)
        earlier.append(torch.empty_like(order).index_copy_(0, order, torch.arange(count)))


def costs(
    clusters: Clusters, one: Int[Tensor, " p"], other: Int[Tensor, " p"], rate: float, most: float = math.inf
) -> Float[Tensor, " p"]:
    """∫ |image of the pair - image of the merged cluster|², in px² of a level at this relative rate.

    one, other: places of the pairs' clusters.
    most: what costs more may be infinite instead.  That is faster: most pairs are too dear in the first plane.
    """
    columns = clusters.weights, clusters.rates, clusters.colours.t(), clusters.covs.t()
    weights, rates, colours, covs = ([each.index_select(-1, ends) for ends in (one, other)] for each in columns)
    offsets = [m.index_select(0, other).sub_(m.index_select(0, one)).to(covs[0]) for m in clusters.means.unbind(dim=1)]
    share = (weights[0] / (weights[0] + weights[1])).nan_to_num_(0.5)
    px2 = torch.minimum(*rates).mul_(rate).square_()
    first, second = (each.mul_(px2) for each in weights)
    a, b = (w * w * _product(c, c) for w, c in zip((first, second), colours, strict=True))
    shares = [share, a, b, first * second * _product(*colours)]
    for place in DIAGONAL:
        for cov in covs:
            cov[place] += PIXEL_BLUR / px2
    cost, whole, unit, left = torch.zeros_like(px2), torch.zeros_like(px2), CHANGE_SCALE * px2, torch.arange(len(one))
    for i, j in PLANES:
        places = PLACES[i][i], PLACES[i][j], PLACES[j][j]
        planes = [[cov[place] for place in places] for cov in covs]
        change, energy = _change(*planes, (offsets[i], offsets[j]), *shares)
        cost += change
        whole += energy
        dear = cost > most * unit
        if dear.sum() > GATHER_SHARE * len(dear):
            near = (~dear).nonzero()[:, 0]
            *covs, offsets, shares, (cost, whole, unit, left) = (
                [each.index_select(0, near) for each in group]
                for group in (*covs, offsets, shares, (cost, whole, unit, left))
            )
    cost = (cost.maximum(MIN_COST_SHARE * whole) / unit).nan_to_num_(MAX_COST).clamp_(max=MAX_COST)
    return torch.full_like(px2, torch.inf).index_copy_(0, left, cost)


def _change(
    one: Plane, other: Plane, offset: Plane, share: Tensor, a: Tensor, b: Tensor, ab: Tensor
) -> tuple[Float[Tensor, " p"], Float[Tensor, " p"]]:
    """Changes of a plane by merging pairs, and the energy of each pair as if it lay in one place.

    Both are 2√2 π times as large.

    a, b, ab: energy of the first cluster of each pair, of the second, and between them.

    All overlaps follow from ⟨A, B⟩ of two covariances, see `_mixed`: 2 det A = ⟨A, A⟩, and for an offset d between
    means, dᵀ A⁻¹ d = ⟨A, D⟩ / det A with D = d dᵀ.  The merged cluster has M = s A + t B + s t D, for shares s + t = 1.
    """
    (x, y), rest = offset, 1 - share
    spread, both = (x * x, x * y, y * y), share * rest
    a_a, b_b, a_b = _mixed(one, one), _mixed(other, other), _mixed(one, other)
    a_d, b_d = _mixed(one, spread), _mixed(other, spread)
    m_d = b_d.lerp(a_d, share)
    a_m = (share * a_a).addcmul_(rest, a_b).addcmul_(both, a_d)
    b_m = (rest * b_b).addcmul_(share, a_b).addcmul_(both, b_d)
    m_m = (share * a_m).addcmul_(rest, b_m).addcmul_(both, m_d)
    for each in (a_a, b_b, m_m):
        each.clamp_(min=torch.finfo(each.dtype).tiny)

    def overlap(u_u: Tensor, v_v: Tensor, u_v: Tensor, u_d: Tensor, v_d: Tensor, power: Tensor | float) -> Tensor:
        """power: minus the square of the share of d that lies between the means."""
        det = (u_u + v_v).add_(u_v, alpha=2)
        return (u_d + v_d).div_(det).mul_(power).exp_().div_(det.sqrt_())

    am, bm = a + ab, b + ab
    whole = (am + bm) / m_m.sqrt()
    cost = whole.addcdiv(a, a_a.sqrt()).addcdiv_(b, b_b.sqrt())
    cost.addcmul_(ab, overlap(a_a, b_b, a_b, a_d, b_d, -1.0), value=4)
    cost.addcmul_(am, overlap(a_a, m_m, a_m, a_d, m_d, -rest * rest), value=-4)
    cost.addcmul_(bm, overlap(b_b, m_m, b_m, b_d, m_d, -share * share), value=-4)
    return cost, whole


def _mixed(one: Plane, other: Plane) -> Float[Tensor, " p"]:
    """⟨A, B⟩ = xx yy' + yy xx' - 2 xy xy', twice the mixed discriminant: det(A + B) = det A + det B + ⟨A, B⟩."""
    (a, b, c), (x, y, z) = one, other
    return (a * z).addcmul_(c, x).addcmul_(b, y, value=-2)


def _product(a: Float[Tensor, "3 p"], b: Float[Tensor, "3 p"]) -> Float[Tensor, " p"]:
    return (a[0] * b[0]).addcmul_(a[1], b[1]).addcmul_(a[2], b[2]).add_(ALPHA_WEIGHT)
