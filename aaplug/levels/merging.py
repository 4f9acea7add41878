"""Merging Gaussians until few enough are left, or until the image would change.

Rounds of pairs, in each of which a cluster is merged once at most: the cheapest first.  The result depends neither on
the scene's order nor on the number of threads.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from aaplug.core.errors import UsageError
from aaplug.core.gaussians import Fusion, Gaussians
from aaplug.core.monitor import Tell
from aaplug.levels.clusters import Clusters, alone, merged_pairs, seen
from aaplug.levels.covariances import areas, blurred, covariances
from aaplug.levels.pairing import curve, mutual_pairs
from aaplug.methods.filters import PIXEL_VARIANCE, fuse_stored
from aaplug.methods.viewers import MERGED

AT_ONCE = 0.08  # of the clusters merged in a round at most, so that a bad pair does not go before a better one
ENOUGH = 0.002  # of the clusters: a round that would merge fewer is the last
TOLERANCE = 1e-4  # px² of the level: squared change of the image, from 0 to 1, by one pair


@dataclass(frozen=True)
class Goal:
    """What to merge for.

    rate: sampling rate relative to training's at which the result is shown.
    count: how many Gaussians to leave; None for as many as `tolerance` asks.
    tolerance: ∫ of the squared change of the image that merging a pair may make, in px² at that rate.
    """

    rate: float
    count: int | None = None
    tolerance: float = math.inf

    @classmethod
    def of_count(cls, count: int, scene: Gaussians) -> "Goal":
        """So many Gaussians: a quarter of them is meant for half the size, as on a surface."""
        return cls(min(1.0, math.sqrt(count / max(1, len(scene)))), count)

    @classmethod
    def of_level(cls, level: int) -> "Goal":
        """Level k of a pyramid, for half the size of the level before."""
        return cls(0.5**level, tolerance=TOLERANCE)


def merged(
    scene: Gaussians, rates: Float[Tensor, " n"], goal: Goal, tell: Tell = lambda done, total: None
) -> Gaussians:
    """A lighter scene, with a record of it; the scene itself if nothing is to be merged.

    rates: training's sampling rate of each Gaussian, px per world unit; see `rates_of`.

    Raises:
        UsageError: the scene holds 2D Gaussians.
    """
    if scene.flat:
        raise UsageError(scene.name, "holds 2D Gaussians, which cannot be merged")
    if len(scene) <= (goal.count or 1):
        return scene
    scene = fuse_stored(scene)
    order = _order(scene)
    scene, rates = scene[order], rates[order]
    own = seen(scene, rates)
    clusters = _rounds(own, goal, tell)
    found = alone(clusters, scene, own.weights)
    if goal.count is None:
        found = found[~_hidden(found, clusters, goal.rate)]
    settings = {"rate": f"{goal.rate:.4g}", "from": str(len(scene))}
    return replace(found, fused=(*scene.fused, Fusion(MERGED, settings)))


def _order(scene: Gaussians) -> Int[Tensor, " n"]:
    """Along a curve; Gaussians at one place by their other parameters, so that the scene's own order plays no part."""
    order = torch.arange(len(scene))
    shape = [scene.logit_opacities, *scene.log_scales.unbind(dim=1), *scene.sh[:, 0].unbind(dim=1)]
    for key in (*shape, *scene.means.unbind(dim=1), curve(scene.means.double())):
        order = order[torch.argsort(key[order], stable=True)]
    return order


def _rounds(clusters: Clusters, goal: Goal, tell: Tell) -> Clusters:
    first, least = len(clusters), goal.count or 1
    while len(clusters) > least:
        pairs, cost = mutual_pairs(clusters, goal.rate)
        most = min(len(clusters) - least, max(1, int(AT_ONCE * len(clusters))))
        cheapest = torch.argsort(cost, stable=True)[:most]
        pairs = pairs[cheapest[cost[cheapest] <= goal.tolerance]]
        if not len(pairs) or (goal.count is None and len(pairs) < ENOUGH * len(clusters)):
            break
        clusters = _joined(clusters, pairs)
        tell(first - len(clusters), first - least)
    tell(first - least, first - least)
    return clusters


def _joined(clusters: Clusters, pairs: Int[Tensor, "p 2"]) -> Clusters:
    """The clusters after these pairs are merged, in the order of their first ones."""
    one, other = pairs.unbind(dim=1)
    changed = {name: column.clone() for name, column in clusters.columns.items()}
    for name, values in merged_pairs(clusters[one], clusters[other]).columns.items():
        changed[name][one] = values
    stays = torch.ones(len(clusters), dtype=torch.bool)
    stays[other] = False
    places = stays.cumsum(0) - 1
    places[other] = places[one]
    return replace(clusters, **changed, labels=places[clusters.labels])[stays.nonzero()[:, 0]]


def _hidden(scene: Gaussians, clusters: Clusters, rate: float) -> Bool[Tensor, " n"]:
    """Gaussians whose alpha no pixel of the level shows, along any of three directions: below the cut-off."""
    px = clusters.rates * rate
    narrow = covariances(scene)
    trained = blurred(narrow, scene.convention.kernel / clusters.rates.square())
    shown = blurred(trained, PIXEL_VARIANCE / px.square())
    start = narrow if scene.convention.compensated else trained
    peaks = scene.opacities[:, None] * areas(start) / areas(shown)
    return peaks.amax(dim=1) < scene.convention.rules.min_alpha
