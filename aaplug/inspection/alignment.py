"""Whether two scenes lie in one frame; if not, how the one is turned, mirrored, scaled or moved against the other.

Programs disagree about axes and units, so the candidates are all turns and mirrorings that permute the axes, about the
origin and about the scene's middle, and those that carry principal axes onto each other.  A candidate is judged by
how near the other scene's Gaussians come to those of the reference: a median, which stray Gaussians do not move.
Where both scenes list the same Gaussians in the same order, the transform follows from the pairs (Umeyama 1991).

n: Gaussians, p: points.  Places are float64, in world units.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import permutations, product

import torch
from jaxtyping import Float
from scipy.spatial import KDTree
from torch import Tensor

from aaplug.core.gaussians import Gaussians

LOOKED_UP = 1024  # places of the other scene that are judged
KNOWN = 1 << 18  # places of the reference among which they are looked up
CORE = 2.0  # median distances from the middle: what lies farther does not count for principal axes
STEPS = 20  # of the iteration that finds the middle
SURE = 0.5  # of the reference's spacing: nearer, no transform can tell more
FITS = 5.0  # of the reference's spacing: farther, Gaussians are not of the same surfaces
CLEARLY = 1 / 3  # of the distance as the scenes are: what a transform must reach to be believed
PAIRED = 0.01  # of the scene's size: the median distance within which pairs are the same Gaussians
ELSEWHERE = 1.0  # of the scene's size: the median distance from which scenes do not overlap
AS_SIMPLE = 1.5  # times the least distance: a simpler transform that reaches this is preferred
SAME = 0.01  # relative change of scale, and of the place over the scene's size, that is not named
TINY = 1e-30  # world units: what lengths are divided by at least
STRAIGHT = 0.999  # cosine of the angle within which a direction is named as an axis


@dataclass(frozen=True)
class Similarity:
    """x ↦ scale · R x + shift; R is orthogonal and mirrors if its determinant is −1."""

    rotation: Float[Tensor, "3 3"]
    scale: float
    shift: Float[Tensor, " 3"]

    def undone(self, points: Float[Tensor, "p 3"]) -> Float[Tensor, "p 3"]:
        """The points before the transform."""
        return (points - self.shift) @ self.rotation / self.scale

    def described(self, size: float) -> str:
        """In words, without what is small; size: of the scene, in world units."""
        rotation, parts = self.rotation, list[str]()
        if torch.linalg.det(rotation) < 0:
            mirrors = [torch.eye(3, dtype=torch.float64).index_fill(0, torch.tensor([i]), 0) * 2 for i in range(3)]
            mirrors = [m - torch.eye(3, dtype=torch.float64) for m in mirrors]  # diagonal, one −1
            axis = max(range(3), key=lambda i: float((rotation @ mirrors[i]).trace()))
            rotation = rotation @ mirrors[axis]
            parts.append(f"mirrored along {'xyz'[axis]}")
        if turn := _turn(rotation):
            parts.append(turn)
        if abs(self.scale - 1) > SAME:
            parts.append(f"scaled by {self.scale:.3g}")
        if float(self.shift.norm()) > SAME * size:
            moved = [x if abs(x) > SAME * size else 0.0 for x in self.shift.tolist()]
            parts.append(f"moved by ({', '.join(f'{x:.3g}' for x in moved)})")
        return ", ".join(parts)


@dataclass(frozen=True)
class Cloud:
    """Places of a scene's Gaussians."""

    points: Float[Tensor, "p 3"]

    @classmethod
    def of(cls, scene: Gaussians, most: int) -> "Cloud":
        """At most so many of the scene's, evenly spaced in its order."""
        return cls(scene.means[:: max(1, -(-len(scene) // most))].detach().double())

    @cached_property
    def middle(self) -> Float[Tensor, " 3"]:
        """Nearly the place with the least sum of distances (Weiszfeld 1937); it turns and grows with the points."""
        middle = self.points.mean(dim=0)
        for _ in range(STEPS):
            offsets = self.points - middle
            distances = offsets.norm(dim=1)
            pull = 1 / distances.clamp(min=SAME * max(float(distances.median()), TINY))
            middle = middle + (offsets * pull[:, None]).sum(dim=0) / pull.sum()
        return middle

    @cached_property
    def size(self) -> float:
        """Median distance from the middle, above 0."""
        distances = (self.points - self.middle).norm(dim=1)
        return max(float(distances.median()), TINY)

    @cached_property
    def axes(self) -> Float[Tensor, "3 3"]:
        """Principal axes of what is not far out, as columns, the longest last."""
        offsets = self.points - self.middle
        core = offsets[offsets.norm(dim=1) <= CORE * self.size]
        return torch.linalg.eigh(core.T @ core).eigenvectors

    @cached_property
    def tree(self) -> KDTree:
        """For finding neighbours."""
        return KDTree(self.points.numpy())

    @cached_property
    def spacing(self) -> float:
        """Median distance of a place to the nearest other one."""
        if len(self.points) < 2:
            return 0.0
        some = self.points[:: max(1, len(self.points) // LOOKED_UP)]
        return float(torch.from_numpy(self.tree.query(some.numpy(), k=2)[0])[:, 1].median())

    def apart(self, points: Float[Tensor, "p 3"], most: float = math.inf) -> float:
        """Median distance of points to the nearest place; infinite above `most`, which is found sooner."""
        return float(torch.from_numpy(self.tree.query(points.numpy(), distance_upper_bound=most)[0]).median())


def mismatch(reference: Gaussians, other: Gaussians) -> str | None:
    """What the other's frame is against the reference's, in words; None where they are the same or it cannot be told.

    "turned by 180 degrees about x, scaled by 2" says how the other follows from the reference.
    """
    if not len(reference) or not len(other):
        return None
    known, looked_up = Cloud.of(reference, KNOWN), Cloud.of(other, LOOKED_UP)
    if len(reference) == len(other) and (pairs := _paired(reference, other)) is not None:
        return pairs.described(known.size) or None
    apart = known.apart(looked_up.points)
    if apart <= SURE * known.spacing:
        return None
    candidates = list(_candidates(known, Cloud.of(other, KNOWN)))
    most = min(CLEARLY * apart, FITS * known.spacing)
    distances = [known.apart(t.undone(looked_up.points), most) for t in candidates]
    if (least := min(distances)) < math.inf:
        simplest = next(place for place, distance in enumerate(distances) if distance <= AS_SIMPLE * least)
        return candidates[simplest].described(known.size) or None
    if apart > ELSEWHERE * known.size:
        return f"elsewhere: half of its Gaussians lie {apart / known.size:.2g} times the scene's size or more away"
    return None


def _candidates(known: Cloud, other: Cloud) -> Iterator[Similarity]:
    """Transforms that could carry the one to the other, simple ones first."""
    ratio, still = other.size / known.size, torch.zeros(3, dtype=torch.float64)
    signs = [torch.tensor(s, dtype=torch.float64).diag() for s in product((1.0, -1.0), repeat=3)]
    turns = [s @ torch.eye(3, dtype=torch.float64)[list(p)] for p in permutations(range(3)) for s in signs]
    turns.sort(key=lambda turn: -float(torch.linalg.det(turn)))  # what mirrors comes last
    yield from (Similarity(turn, 1.0, still) for turn in turns)
    yield from (Similarity(turn, ratio, still) for turn in turns)
    carried = [other.axes @ s @ known.axes.T for s in signs]
    for turn in (*turns, *sorted(carried, key=lambda turn: -float(torch.linalg.det(turn)))):
        for scale in (1.0, ratio):
            yield Similarity(turn, scale, other.middle - scale * turn @ known.middle)


def _paired(reference: Gaussians, other: Gaussians) -> Similarity | None:
    """The transform that carries each of the reference's Gaussians to the one in the same row; None if none does.

    Least squares over what is not far out (Umeyama 1991, eqs. 39 to 43, mirroring included).
    """
    a, b = Cloud.of(reference, KNOWN), Cloud.of(other, KNOWN)
    core = (a.points - a.middle).norm(dim=1) <= CORE * a.size
    x, y = a.points[core], b.points[core]
    x_mean, y_mean = x.mean(dim=0), y.mean(dim=0)
    u, values, vh = torch.linalg.svd((y - y_mean).T @ (x - x_mean))
    spread = float((x - x_mean).square().sum())
    scale = float(values.sum()) / spread if spread > 0 else 0.0
    if not (scale > 0 and math.isfinite(scale)):
        return None
    rotation = u @ vh
    found = Similarity(rotation, scale, y_mean - scale * rotation @ x_mean)
    apart = float((found.undone(y) - x).norm(dim=1).median())
    return found if apart <= PAIRED * a.size else None


def _turn(rotation: Float[Tensor, "3 3"]) -> str:
    """A rotation in words; "" for none."""
    angle = math.degrees(math.acos(min(1.0, max(-1.0, (float(rotation.trace()) - 1) / 2))))
    if angle < math.degrees(SAME):
        return ""
    values, vectors = torch.linalg.eig(rotation)
    axis = vectors[:, int((values - 1).abs().argmin())].real
    skew = torch.stack(
        [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]
    )
    if float(skew @ axis) < 0:
        axis = -axis
    longest = int(axis.abs().argmax())
    if float(axis[longest]) < 0:
        axis, angle = -axis, -angle if angle < 180 - math.degrees(SAME) else angle
    about = "xyz"[longest] if float(axis[longest]) > STRAIGHT else f"({', '.join(f'{x:.2f}' for x in axis.tolist())})"
    return f"turned by {angle:.3g} degrees about {about}"
