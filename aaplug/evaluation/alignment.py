"""Frames of two scenes: how the one is turned, mirrored, scaled or moved against the other, if at all.

Programs disagree about axes and units, so the candidates are all turns and mirrorings that permute the axes, about the
origin and about the scene's middle, and those that carry principal axes onto each other.  A candidate is judged by
how near the other scene's Gaussians come to those of the reference: a median, which stray Gaussians do not move.
Where both scenes list the same Gaussians in the same order, the transform follows from the pairs (Umeyama 1991).

n: Gaussians, p: points.  Places are float64, in world units.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import permutations, product

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation
from torch import Tensor

from aaplug.core.gaussians import Gaussians
from aaplug.core.orbits import geometric_median

MAX_QUERIES = 1024  # places of the other scene that are judged
MAX_PLACES = 1 << 18  # places of a scene among which they are looked up
CORE_RADIUS = 2.0  # median distances from the middle; principal axes are of what lies nearer
CERTAIN_DISTANCE = 0.5  # of the reference's spacing: nearer, no transform can tell more
SURFACE_DISTANCE = 5.0  # of the reference's spacing: farther, Gaussians are not of the same surfaces
BELIEVED_SHARE = 1 / 3  # of the distance as the scenes are: a transform that reaches this is believed
PAIR_DISTANCE = 0.01  # of the scene's size: the median distance within which pairs are the same Gaussians
ELSEWHERE_DISTANCE = 1.0  # of the scene's size: the median distance from which scenes do not overlap
SIMPLER_FACTOR = 1.5  # times the least distance: a simpler transform that reaches this is preferred
UNNAMED_CHANGE = 0.01  # of scale, of an angle in radians, and of the place over the scene's size
MIN_LENGTH = 1e-30  # world units: lengths are divided by no less
AXIS_COSINE = 0.999  # of the angle within which a direction is named as an axis


@dataclass(frozen=True, eq=False)
class Similarity:
    """x ↦ scale · R x + shift; R is orthogonal and mirrors if its determinant is −1."""

    rotation: Float[Tensor, "3 3"]
    scale: float
    shift: Float[Tensor, " 3"]

    def done(self, points: Float[Tensor, "*p 3"]) -> Float[Tensor, "*p 3"]:
        """The points after the transform."""
        return self.scale * points @ self.rotation.T + self.shift

    def undone(self, points: Float[Tensor, "p 3"]) -> Float[Tensor, "p 3"]:
        """The points before the transform."""
        return (points - self.shift) @ self.rotation / self.scale

    def described(self, scene: "Cloud") -> str:
        """In words, without what is small.

        What is left is told as a shift of the scene's middle: an unnamed turn moves what lies far from the origin.
        """
        rotation, parts = self.rotation.clone(), list[str]()
        named = Similarity(torch.eye(3).to(rotation), 1.0, torch.zeros_like(self.shift))
        if torch.linalg.det(rotation) < 0:
            axis = min(range(3), key=lambda i: float(rotation[i, i]))  # the axis that leaves the smallest turn
            rotation[:, axis] *= -1
            named.rotation[axis, axis] = -1
            parts.append(f"mirrored along {'xyz'[axis]}")
        if turn := _turn(rotation):
            named = replace(named, rotation=self.rotation)
            parts.append(turn)
        if abs(self.scale - 1) > UNNAMED_CHANGE:
            named = replace(named, scale=self.scale)
            parts.append(f"scaled by {self.scale:.3g}")
        shift, least = self.done(scene.middle) - named.done(scene.middle), UNNAMED_CHANGE * scene.size
        if float(shift.norm()) > least:
            shift = [x if abs(x) > least else 0.0 for x in shift.tolist()]
            parts.append(f"moved by ({', '.join(f'{x:.3g}' for x in shift)})")
        return ", ".join(parts)


@dataclass(frozen=True, eq=False)
class Cloud:
    """Places of a scene's Gaussians."""

    points: Float[Tensor, "p 3"]

    @classmethod
    def of(cls, scene: Gaussians, most: int = MAX_PLACES) -> "Cloud":
        """At most so many of the scene's places, evenly spaced in its order."""
        return cls(scene.means[:: max(1, -(-len(scene) // most))].detach().double())

    @cached_property
    def middle(self) -> Float[Tensor, " 3"]:
        """Nearly the place with the least sum of distances; it turns and grows with the points."""
        return geometric_median(self.points, torch.ones_like(self.points[:, 0]), self.points.mean(dim=0))

    @cached_property
    def size(self) -> float:
        """Median distance from the middle, above 0."""
        distances = (self.points - self.middle).norm(dim=1)
        return max(float(distances.median()), MIN_LENGTH)

    @cached_property
    def axes(self) -> Float[Tensor, "3 3"]:
        """Principal axes of the core, as columns, the longest last."""
        offsets = self.points - self.middle
        core = offsets[offsets.norm(dim=1) <= CORE_RADIUS * self.size]
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
        some = self.points[:: max(1, len(self.points) // MAX_QUERIES)]
        return float(torch.from_numpy(self.tree.query(some.numpy(), k=2)[0])[:, 1].median())

    def apart(self, points: Float[Tensor, "p 3"], most: float = math.inf) -> float:
        """Median distance of points to the nearest place; infinite above `most`, which takes less time."""
        return float(torch.from_numpy(self.tree.query(points.numpy(), distance_upper_bound=most)[0]).median())


def mismatch(reference: Gaussians, other: Gaussians) -> str | None:
    """The other's frame against the reference's, in words; None where they are the same or it cannot be told.

    "turned by 180 degrees about x, scaled by 2" says how the other follows from the reference.
    """
    if not len(reference) or not len(other):
        return None
    places, others, queries = Cloud.of(reference), Cloud.of(other), Cloud.of(other, MAX_QUERIES)
    if len(reference) == len(other) and (pairs := _from_pairs(places, others)) is not None:
        return pairs.described(places) or None
    apart = places.apart(queries.points)
    if apart <= CERTAIN_DISTANCE * places.spacing:
        return None
    candidates = list(_candidates(places, others))
    most = min(BELIEVED_SHARE * apart, SURFACE_DISTANCE * places.spacing)
    distances = [places.apart(t.undone(queries.points), most) for t in candidates]
    if (least := min(distances)) < math.inf:
        simplest = next(place for place, distance in enumerate(distances) if distance <= SIMPLER_FACTOR * least)
        return candidates[simplest].described(places) or None
    if apart > ELSEWHERE_DISTANCE * places.size:
        return f"elsewhere: half of its Gaussians lie {apart / places.size:.2g} times the scene's size or more away"
    return None


def _candidates(reference: Cloud, other: Cloud) -> Iterator[Similarity]:
    """Transforms that could carry the one to the other, simple ones first."""
    ratio, unmoved = other.size / reference.size, torch.zeros(3, dtype=torch.float64)
    signs = [torch.tensor(s, dtype=torch.float64).diag() for s in product((1.0, -1.0), repeat=3)]
    turns = [s @ torch.eye(3, dtype=torch.float64)[list(p)] for p in permutations(range(3)) for s in signs]
    turns, between_axes = (
        sorted(group, key=lambda turn: -float(torch.linalg.det(turn)))  # mirrorings come last
        for group in (turns, [other.axes @ s @ reference.axes.T for s in signs])
    )
    yield from (Similarity(turn, scale, unmoved) for scale in (1.0, ratio) for turn in turns)
    for turn, scale in product((*turns, *between_axes), (1.0, ratio)):
        yield Similarity(turn, scale, other.middle - scale * turn @ reference.middle)


def _from_pairs(a: Cloud, b: Cloud) -> Similarity | None:
    """The transform that carries each place of the first to the one in the same row; None if none does.

    Least squares over the core (Umeyama 1991, eqs. 39 to 43, mirroring included).
    """
    core = (a.points - a.middle).norm(dim=1) <= CORE_RADIUS * a.size
    x, y = a.points[core], b.points[core]
    x_mean, y_mean = x.mean(dim=0), y.mean(dim=0)
    u, values, vh = torch.linalg.svd((y - y_mean).T @ (x - x_mean))
    spread = float((x - x_mean).square().sum())
    scale = float(values.sum()) / spread if spread > 0 else 0.0
    if not (scale > 0 and math.isfinite(scale)):
        return None
    transform = Similarity(u @ vh, scale, y_mean - scale * (u @ vh) @ x_mean)
    apart = float((transform.undone(y) - x).norm(dim=1).median())
    return transform if apart <= PAIR_DISTANCE * a.size else None


def _turn(rotation: Float[Tensor, "3 3"]) -> str:
    """A rotation in words; "" for none."""
    vector = Rotation.from_matrix(rotation.numpy()).as_rotvec(degrees=True)
    angle = float(np.linalg.norm(vector))
    if angle < math.degrees(UNNAMED_CHANGE):
        return ""
    axis, longest = (vector / angle).tolist(), int(np.abs(vector).argmax())
    if axis[longest] < 0:
        axis, angle = [-x for x in axis], -angle if angle < 180 - math.degrees(UNNAMED_CHANGE) else angle
    about = "xyz"[longest] if axis[longest] > AXIS_COSINE else f"({', '.join(f'{x:.2f}' for x in axis)})"
    return f"turned by {angle:.3g} degrees about {about}"
