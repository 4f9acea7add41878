"""Merging Gaussians until few enough are left, or until the image would change.

Rounds of pairs, in each of which a cluster is merged once at most: the cheapest first.  The result depends neither on
the scene's order nor on the number of threads.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import accumulate, pairwise

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from aaplug.core.chunks import curve, squeezed
from aaplug.core.convolution import fuse_stored
from aaplug.core.gaussians import Fusion, Gaussians, joined
from aaplug.core.pyramids import Level
from aaplug.levels.clusters import Clusters, clusters_of, gaussians_of, merge_pairs
from aaplug.levels.covariances import areas, blur, covariances
from aaplug.levels.pairing import Edges, edges_below, matching
from aaplug.methods.conversion import MERGED
from aaplug.methods.filters.matched import PIXEL_VARIANCE
from aaplug.system.cores import on_free_cores
from aaplug.system.executors import Threads, given_threads
from aaplug.system.monitor import Tell

MIN_MERGED_SHARE = 0.02  # of the clusters: after a round that merges fewer, more is allowed to change
TOLERANCE = 8e-6  # px² of the level: squared change of the image, from 0 to 1, by one pair as views show it
FIRST_SHARE = 0.01  # of the tolerance in the first rounds, so that a bad pair does not go before a better one
FIRST_OF_COUNT, LAST_OF_COUNT = 1e-7, 1e3  # px²: first and last but one tolerance, where a count is asked for
TOLERANCE_STEP = 10.0  # from one tolerance to the next
GAUSSIANS_PER_BATCH = 1 << 17  # of whole chunks, merged at once: some 300 MB

Batch = tuple[Gaussians, Int[Tensor, " m"], Int[Tensor, " n"]]  # a lighter scene, its chunks and the parents in it


@dataclass(frozen=True)
class Goal:
    """The goal of merging.

    rate: sampling rate relative to training's at which the result is shown.
    count: how many Gaussians to leave; None for as many as `tolerance` asks.
    tolerance: ∫ of the squared change of the image that merging a pair may make, in px² at that rate.
    smallest: px at that rate; a pair is merged at any cost if the result has no larger standard deviation.
    """

    rate: float
    count: int | None = None
    tolerance: float = math.inf
    smallest: float = 0.0

    @property
    def tolerances(self) -> Iterator[float]:
        """The tolerance of each round, in px²."""
        tolerance, last = FIRST_SHARE * self.tolerance, self.tolerance
        if self.count is not None:
            tolerance, last = FIRST_OF_COUNT, LAST_OF_COUNT
        while tolerance < last:
            yield tolerance
            tolerance *= TOLERANCE_STEP
        yield self.tolerance


def merge(
    scene: Gaussians,
    rates: Float[Tensor, " n"],
    goal: Goal,
    tell: Tell = lambda done, total: None,
    visible: Float[Tensor, " n"] | None = None,
    chunks: Int[Tensor, " n"] | None = None,
) -> Level:
    """A lighter scene, with a record of it; the scene itself if nothing is to be merged.

    2D Gaussians stay flat: discs across the thinnest axes of the covariances that they are merged to.

    rates: training's sampling rate of each Gaussian, px per world unit; see `rates_of`.
    visible: share of each Gaussian that views show, see `visibility`; None where nothing is known of any.
    chunks: the chunk of each, None for one of all.  No Gaussian of the lighter scene stands for those of different
        chunks; its Gaussians lie by ascending chunk.
    """
    if chunks is None:
        if len(scene) <= (goal.count or 1):
            return Level(scene, goal.rate)
        one = torch.zeros(len(scene), dtype=torch.int64)
        return merge(scene, rates, goal, tell, visible, one)._replace(chunks=None, parents=None)
    scene = fuse_stored(scene)
    if visible is None:
        visible = torch.full((len(scene),), torch.nan)
    order = _order(scene, chunks)
    along, total = chunks[order], len(scene) - (goal.count or 0)
    stops = [0]
    while stops[-1] < len(scene):
        last = along[min(stops[-1] + GAUSSIANS_PER_BATCH, len(scene)) - 1]
        stops.append(int(torch.searchsorted(along, last, right=True)))
    gone = dict.fromkeys(stops, 0)  # Gaussians that a batch is rid of, by its start

    @on_free_cores()
    def merge_batch(ends: tuple[int, int]) -> Batch:
        def tell_batch(done: int) -> None:
            gone[ends[0]] = done
            tell(min(sum(gone.values()), total), total)

        places = order[slice(*ends)]
        batch = scene[places]
        clusters = clusters_of(batch, rates[places], chunks[places], visible[places])
        result = rounds(clusters, goal, tell_batch)
        lighter, placed, parents = gaussians_of(result, batch, clusters.weights), result.chunks, result.labels
        if goal.count is None:  # without hidden ones, which are not counted
            stays = ~_hidden(lighter, result, goal.rate)
            shown = stays.nonzero()[:, 0]
            lighter, placed, parents = lighter[shown], placed[shown], (stays.cumsum(0) - 1)[parents]
        tell_batch(len(batch))
        return lighter, placed, parents

    workers = min(given_threads(), len(stops) - 1)
    batches = (Threads(workers).map if workers > 1 else map)(merge_batch, pairwise(stops))
    scenes, placed, above = zip(*batches, strict=True)
    record = Fusion(MERGED, {"rate": f"{goal.rate:.4g}", "from": str(len(scene))})
    lighter = replace(joined(scenes), origin=None, fused=(*scene.fused, record))
    starts = accumulate(map(len, scenes), initial=0)
    parents = torch.empty_like(order)
    parents[order] = torch.cat([each + start for each, start in zip(above, starts, strict=False)])
    return Level(lighter, goal.rate, torch.cat(placed), parents.clamp(0))


def rounds(clusters: Clusters, goal: Goal, tell: Callable[[int], None]) -> Clusters:
    """The clusters after all pairs are merged that the goal allows; `tell` is called with how many are gone."""
    first, least, ceiling, edges = len(clusters), goal.count or 1, -math.inf, None
    for tolerance in goal.tolerances:
        min_share = 0.0 if tolerance == math.inf else MIN_MERGED_SHARE
        if edges is None or tolerance > ceiling:  # one look at all pairs serves every tolerance of a level
            ceiling = tolerance if goal.tolerance == math.inf else goal.tolerance
            edges = edges_below(clusters, goal.rate, ceiling, goal.smallest)
        while len(clusters) > least:
            below = edges if tolerance == ceiling else edges[edges.cost <= tolerance]
            pairs = matching(below, len(clusters))
            pairs = pairs[torch.argsort(pairs.cost, stable=True)[: len(clusters) - least]]
            is_last = len(pairs) <= min_share * len(clusters)
            if len(pairs):
                clusters, places = _merge_matching(clusters, pairs)
                fresh = torch.zeros(len(clusters), dtype=torch.bool)
                fresh[places[pairs.one]] = True
                one, other = places.index_select(0, edges.one), places.index_select(0, edges.other)
                edges = Edges(one, other, edges.cost)[~(fresh.index_select(0, one) | fresh.index_select(0, other))]
                edges = Edges.joined([edges, edges_below(clusters, goal.rate, ceiling, goal.smallest, fresh)])
                tell(first - len(clusters))
            if is_last:
                break
    return clusters


def _order(scene: Gaussians, chunks: Int[Tensor, " n"]) -> Int[Tensor, " n"]:
    """Order by chunk, in each along a curve, and at one place by the other parameters: never by the scene's own."""
    shape = [scene.logit_opacities, *scene.log_scales.unbind(dim=1), *scene.sh[:, 0].unbind(dim=1)]
    order = torch.arange(len(scene))
    for key in (*shape, *scene.means.unbind(dim=1), curve(squeezed(scene.means.double())), chunks):
        order = order[torch.argsort(key[order], stable=True)]
    return order


def _merge_matching(clusters: Clusters, pairs: Edges) -> tuple[Clusters, Int[Tensor, " n"]]:
    """The clusters after these pairs are merged, in the order of their first ones, and the new place of each."""
    one, other = pairs.one, pairs.other
    columns = {name: column.clone() for name, column in clusters.columns.items()}
    for name, values in merge_pairs(clusters[one], clusters[other]).columns.items():
        columns[name][one] = values
    stays = torch.ones(len(clusters), dtype=torch.bool)
    stays[other] = False
    places = stays.cumsum(0) - 1
    places[other] = places[one]
    return replace(clusters, **columns, labels=places[clusters.labels])[stays.nonzero()[:, 0]], places


def _hidden(scene: Gaussians, clusters: Clusters, rate: float) -> Bool[Tensor, " n"]:
    """True where alpha in every pixel of the level, along each axis, or the visible share lies below the cut-off."""
    px = clusters.rates * rate
    raw = covariances(scene)
    trained = blur(raw, scene.convention.kernel / clusters.rates.square())
    at_level = blur(trained, PIXEL_VARIANCE / px.square())
    unblurred = raw if scene.convention.compensated else trained
    peaks = scene.opacities[:, None] * areas(unblurred) / areas(at_level)
    least = scene.convention.rules.min_alpha
    return (peaks.amax(dim=1) < least) | (clusters.visible < least)
