"""Merging Gaussians until few enough are left, or until the image would change.

Rounds of pairs, in each of which a cluster is merged once at most: the cheapest first.  The result depends neither on
the scene's order nor on the number of threads.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from aaplug.core.errors import UsageError
from aaplug.core.gaussians import Fusion, Gaussians, joined
from aaplug.core.monitor import Tell
from aaplug.levels.clusters import Clusters, alone, merged_pairs, seen
from aaplug.levels.covariances import areas, blurred, covariances
from aaplug.levels.pairing import Edges, curve, edges_below, matched
from aaplug.methods.filters import PIXEL_VARIANCE, fuse_stored
from aaplug.methods.viewers import MERGED

ENOUGH = 0.02  # of the clusters: after a round that merges fewer, more is allowed to change
TOLERANCE = 8e-6  # px² of the level: squared change of the image, from 0 to 1, by one pair as views show it
FIRST_SHARE = 0.01  # of the tolerance in the first rounds, so that a bad pair does not go before a better one
FIRST, LAST = 1e-7, 1e3  # px²: tolerances of the first rounds and of the last but one, where a count is asked for
STEP = 10.0  # from one tolerance to the next
BATCH = 1 << 17  # Gaussians merged at once where chunks are kept apart: some 300 MB


@dataclass(frozen=True)
class Goal:
    """What to merge for.

    rate: sampling rate relative to training's at which the result is shown.
    count: how many Gaussians to leave; None for as many as `tolerance` asks.
    tolerance: ∫ of the squared change of the image that merging a pair may make, in px² at that rate.
    smallest: px at that rate; pairs whose merged Gaussian has no larger standard deviation are merged whatever they
        change.
    """

    rate: float
    count: int | None = None
    tolerance: float = math.inf
    smallest: float = 0.0

    @classmethod
    def of_count(cls, count: int, scene: Gaussians) -> "Goal":
        """So many Gaussians: a quarter of them is meant for half the size, as on a surface."""
        return cls(min(1.0, math.sqrt(count / max(1, len(scene)))), count)

    @property
    def tolerances(self) -> Iterator[float]:
        """What a pair may change in the rounds, one after another."""
        now, last = (FIRST_SHARE * self.tolerance, self.tolerance) if self.count is None else (FIRST, LAST)
        while now < last:
            yield now
            now *= STEP
        yield self.tolerance

    @classmethod
    def of_level(cls, level: int, smallest: float = 0.0) -> "Goal":
        """Level k of a pyramid, for half the size of the level before."""
        return cls(0.5**level, tolerance=TOLERANCE, smallest=smallest)


class Merged(NamedTuple):
    """A lighter scene, and the chunk of each of its Gaussians, ascending."""

    scene: Gaussians
    chunks: Int[Tensor, " n"]


def merged(
    scene: Gaussians,
    rates: Float[Tensor, " n"],
    goal: Goal,
    tell: Tell = lambda done, total: None,
    visible: Float[Tensor, " n"] | None = None,
) -> Gaussians:
    """A lighter scene, with a record of it; the scene itself if nothing is to be merged.

    rates: training's sampling rate of each Gaussian, px per world unit; see `rates_of`.
    visible: how much of each Gaussian views show, see `visibility`; None where nothing is known of any.

    Raises:
        UsageError: the scene holds 2D Gaussians.
    """
    if len(scene) <= (goal.count or 1) and not scene.flat:
        return scene
    return merged_in_chunks(scene, rates, torch.zeros(len(scene), dtype=torch.int64), goal, tell, visible).scene


def merged_in_chunks(
    scene: Gaussians,
    rates: Float[Tensor, " n"],
    chunks: Int[Tensor, " n"],
    goal: Goal,
    tell: Tell = lambda done, total: None,
    visible: Float[Tensor, " n"] | None = None,
) -> Merged:
    """A lighter scene in which no Gaussian stands for those of different chunks; see `merged`."""
    if scene.flat:
        raise UsageError(scene.name, "holds 2D Gaussians, which cannot be merged")
    scene = fuse_stored(scene)
    if visible is None:
        visible = torch.full((len(scene),), torch.nan)
    order = _order(scene, chunks)
    parts: list[Merged] = []
    for start, stop in _batches(chunks[order]):
        own, said = order[start:stop], partial(_told, tell, start, len(scene) - (goal.count or 0))
        clusters = seen(scene[own], rates[own], chunks[own], visible[own])
        parts.append(_merged_batch(clusters, scene[own], goal, said))
    found = replace(joined([part.scene for part in parts]), origin=None)
    record = Fusion(MERGED, {"rate": f"{goal.rate:.4g}", "from": str(len(scene))})
    return Merged(replace(found, fused=(*scene.fused, record)), torch.cat([part.chunks for part in parts]))


def _told(tell: Tell, start: int, total: int, done: int) -> None:
    tell(min(start + done, total), total)


def _batches(chunks: Int[Tensor, " n"]) -> Iterator[tuple[int, int]]:
    """Start and end of runs of whole chunks, of about `BATCH` Gaussians."""
    start = 0
    while start < len(chunks):
        last = chunks[min(start + BATCH, len(chunks)) - 1]
        stop = int(torch.searchsorted(chunks, last, right=True))
        yield start, stop
        start = stop


def _merged_batch(own: Clusters, scene: Gaussians, goal: Goal, tell: Callable[[int], None]) -> Merged:
    clusters = rounds(own, goal, tell)
    found, places = alone(clusters, scene, own.weights), clusters.chunks
    if goal.count is None:
        shown = (~_hidden(found, clusters, goal.rate)).nonzero()[:, 0]
        found, places = found[shown], places[shown]
    tell(len(scene))
    return Merged(found, places)


def _order(scene: Gaussians, chunks: Int[Tensor, " n"]) -> Int[Tensor, " n"]:
    """By chunk, in each along a curve; Gaussians at one place by their other parameters.

    So the scene's own order plays no part.
    """
    order = torch.arange(len(scene))
    shape = [scene.logit_opacities, *scene.log_scales.unbind(dim=1), *scene.sh[:, 0].unbind(dim=1)]
    for key in (*shape, *scene.means.unbind(dim=1), curve(scene.means.double()), chunks):
        order = order[torch.argsort(key[order], stable=True)]
    return order


def rounds(clusters: Clusters, goal: Goal, tell: Callable[[int], None]) -> Clusters:
    """The clusters after all pairs are merged that the goal allows; `tell` is called with how many are gone."""
    first, least = len(clusters), goal.count or 1
    for tolerance in goal.tolerances:
        enough = 0.0 if tolerance == math.inf else ENOUGH
        while len(clusters) > least:
            smallest = goal.smallest if tolerance == goal.tolerance else 0.0
            pairs = matched(edges_below(clusters, goal.rate, tolerance, smallest), len(clusters))
            pairs = pairs[torch.argsort(pairs.cost, stable=True)[: len(clusters) - least]]
            few = len(pairs) <= enough * len(clusters)
            if len(pairs):
                clusters = _joined(clusters, pairs)
                tell(first - len(clusters))
            if few:
                break
    return clusters


def _joined(clusters: Clusters, pairs: Edges) -> Clusters:
    """The clusters after these pairs are merged, in the order of their first ones."""
    one, other = pairs.one, pairs.other
    changed = {name: column.clone() for name, column in clusters.columns.items()}
    for name, values in merged_pairs(clusters[one], clusters[other]).columns.items():
        changed[name][one] = values
    stays = torch.ones(len(clusters), dtype=torch.bool)
    stays[other] = False
    places = stays.cumsum(0) - 1
    places[other] = places[one]
    return replace(clusters, **changed, labels=places[clusters.labels])[stays.nonzero()[:, 0]]


def _hidden(scene: Gaussians, clusters: Clusters, rate: float) -> Bool[Tensor, " n"]:
    """Gaussians whose alpha no pixel of the level shows, along any of three directions: below the cut-off.

    Also those of which views show a smaller share than the cut-off.
    """
    px = clusters.rates * rate
    narrow = covariances(scene)
    trained = blurred(narrow, scene.convention.kernel / clusters.rates.square())
    shown = blurred(trained, PIXEL_VARIANCE / px.square())
    start = narrow if scene.convention.compensated else trained
    peaks = scene.opacities[:, None] * areas(start) / areas(shown)
    least = scene.convention.rules.min_alpha
    return (peaks.amax(dim=1) < least) | (clusters.visible < least)
