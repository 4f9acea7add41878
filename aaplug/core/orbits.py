"""Views of a scene without cameras: an orbit around the part that matters.

Floaters and far surroundings are many and large, so they must not decide the frame: a Gaussian counts by its opacity,
and less the larger it is.  Training makes small Gaussians where its cameras looked from close by.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.cameras import Camera, centred, look_at, numbered
from aaplug.core.gaussians import MIN_OPACITY, Gaussians
from aaplug.core.rules import NEAR
from aaplug.core.spherical_harmonics import COLOUR_OFFSET, even_directions, sh_colour
from aaplug.system.errors import UsageError

CORE_DISTANCES = 2.0  # median distances from the centre; Gaussians farther out count as surroundings
CORE_SHARE = 0.99  # of the core, inside the frame's ball
RADIUS_MARGIN = 1.05  # of the ball's radius: room for the width of Gaussians
MIN_RADIUS_SIGMAS = 3.0  # least radius of the ball, in standard deviations of the median Gaussian
MIN_RADIUS = 1e-3 * NEAR  # world units: smaller scenes have no picture
MAX_STEPS = 100  # of an iteration
MIN_STEP = 1e-4  # of the points' median distance: Weiszfeld's iteration ends at a step this short
SHAPE_STEPS = 20  # of Tyler's iteration
THICKNESS = 0.02  # of a covariance's trace, added to each axis: a plane keeps some thickness
SOFTENING = 1e-6  # of the points' median distance: a step stays finite where the median meets a point

DOWN_IS_Y = (0.0, -1.0, 0.0)  # up where y points down, as in COLMAP's and 3DGS's cameras: the usual convention
FRONT_OF_UP = {(0.0, 0.0, 1.0): (0.0, -1.0, 0.0), (0.0, 1.0, 0.0): (0.0, 0.0, 1.0), DOWN_IS_Y: (0.0, 0.0, -1.0)}
MIN_LEAD = 0.2  # length along an axis or the horizon from which `training_side` decides
BROAD_RATIO = 1.5  # of a scene's horizontal variances; from here on it has a broad side
COLOUR_DIRECTIONS = 256  # over the sphere, in which colours are compared


@dataclass(frozen=True, eq=False)
class Frame:
    """The ball that a picture of the scene should show, in world units.

    up, front: unit vectors at right angles; an orbit begins at `front`.
    outside: share of the Gaussians outside of the ball, such as surroundings and floaters.
    """

    centre: Float[Tensor, " 3"]
    radius: float
    up: Float[Tensor, " 3"]
    front: Float[Tensor, " 3"]
    outside: float

    def distance(self, fov: float) -> float:
        """Distance at which the ball fills a field of view (radians); the ball stays beyond the near plane."""
        return max(self.radius / math.sin(fov / 2), self.radius + 2 * NEAR)

    def focal(self, distance: float) -> float:
        """Focal length with which the ball at this distance fills the side of an image, over that side."""
        return math.sqrt(distance**2 - self.radius**2) / (2 * self.radius)


@torch.no_grad()
def frame_of(scene: Gaussians, up: Sequence[float] | None = None) -> Frame:
    """The frame of a scene; with `up` given, it turns, moves and grows with the scene.

    up: the direction that points up, of any length but 0; None for `likely_up`.

    Raises:
        UsageError: there are no Gaussians, or `up` is 0.
    """
    if not len(scene):
        raise UsageError(scene.name, "has no Gaussians to look at")
    points, sizes = scene.means.double(), scene.scales.amax(dim=1).double()
    size = float(sizes.median())
    weights = scene.opacities.double().clamp(min=MIN_OPACITY) * (size / sizes).clamp(max=1.0).square()
    centre = geometric_median(points, weights, points.median(dim=0).values)
    shape = _shape(points - centre, weights)
    distances = _lengths(points - centre, shape)
    core = distances <= CORE_DISTANCES * _quantile(distances, weights, 0.5)
    core &= distances <= _quantile(distances[core], weights[core], CORE_SHARE)
    centre, reach = _enclosing_ball(points[core])
    radius = max(RADIUS_MARGIN * reach, MIN_RADIUS_SIGMAS * size, MIN_RADIUS)
    side = training_side(scene)
    axis = torch.tensor([float(x) for x in (likely_up(side) if up is None else up)], dtype=torch.float64)
    length = float(axis.norm())
    if not 0 < length < math.inf:
        raise UsageError("up", f"takes a direction, got {', '.join(f'{x:g}' for x in axis.tolist())}")
    axis = axis / length
    outside = float(((points - centre).norm(dim=1) > radius).double().mean())
    return Frame(centre, radius, axis, _front(axis, side, shape), outside)


def orbit(
    frame: Frame, count: int, size: tuple[int, int], elevation: float, fov: float, name: str = "orbit"
) -> tuple[Camera, ...]:
    """Free cameras on a circle around the frame, evenly spaced, named by their number.

    size: width and height in px.  elevation: above the horizon, fov: along the image's shorter side; in radians.
    """
    distance = frame.distance(fov)
    focal, side = frame.focal(distance) * min(size), torch.linalg.cross(frame.up, frame.front)
    views = []
    for index, named in enumerate(numbered(count, f"{name}_")):
        turn = 2 * math.pi * index / count
        level = math.cos(turn) * frame.front + math.sin(turn) * side
        eye = frame.centre + distance * (math.cos(elevation) * level + math.sin(elevation) * frame.up)
        views.append(centred(named, size, focal, look_at(eye, frame.centre, frame.up)))
    return tuple(views)


def likely_up(side: Float[Tensor, " 3"]) -> tuple[float, float, float]:
    """The axis that points up: -y as usual, or z or y if training clearly looked from there; side: `training_side`."""
    lead = {axis: float(side @ side.new_tensor(axis)) for axis in FRONT_OF_UP}
    best = max(FRONT_OF_UP, key=lambda axis: lead[axis])
    return best if lead[best] > max(lead[DOWN_IS_Y], 0.0) + MIN_LEAD else DOWN_IS_Y


def training_side(scene: Gaussians) -> Float[Tensor, " 3"]:
    """The direction that training looked from, of a length between 0 (anywhere, or unknown) and about 1.

    Harmonics are fitted where cameras looked, so colours vary most in those directions.  This is the first moment of
    their standard deviation over the sphere, aaplug's own measure.
    """
    k = scene.sh.shape[1]
    if k == 1:
        return torch.zeros(3, dtype=torch.float64)
    directions = even_directions(COLOUR_DIRECTIONS).float()
    ones = torch.eye(k).repeat(len(directions), 1)[:, :, None].expand(-1, -1, 3)
    basis = sh_colour(ones, directions.repeat_interleave(k, dim=0))[:, 0].view(-1, k) - COLOUR_OFFSET
    varied = scene.sh[:, 1:].float() * scene.opacities[:, None, None].float().sqrt()
    moments = torch.einsum("nic,njc->ij", varied, varied) / len(scene)
    spread = torch.einsum("di,ij,dj->d", basis[:, 1:], moments, basis[:, 1:]).clamp(min=0.0).sqrt()
    total = float(spread.mean())
    if not 0 < total < math.inf:
        return torch.zeros(3, dtype=torch.float64)
    return -3 * (spread[:, None] * directions).mean(dim=0).double() / total  # directions run from the camera


def _front(up: Float[Tensor, " 3"], side: Float[Tensor, " 3"], shape: Float[Tensor, "3 3"]) -> Float[Tensor, " 3"]:
    """The horizontal direction that training looked from, else that of a broad side, else the usual one."""
    level = side - (side @ up) * up
    if float(level.norm()) < MIN_LEAD:
        plane = torch.linalg.svd(up[None]).Vh[1:]  # two horizontal directions
        nearest = max(FRONT_OF_UP, key=lambda axis: float(up @ up.new_tensor(axis)))
        usual = plane.T @ (plane @ level.new_tensor(FRONT_OF_UP[nearest]))
        (narrow, broad), sides = torch.linalg.eigh(plane @ shape @ plane.T)
        clear = float(broad) > BROAD_RATIO * float(narrow) or not float(usual.norm()) > 0
        level = sides[:, 0] @ plane if clear else usual
        level = -level if float(level @ usual) < 0 else level
    return torch.nn.functional.normalize(level, dim=0)


def geometric_median(
    points: Float[Tensor, "n 3"], weights: Float[Tensor, " n"], centre: Float[Tensor, " 3"]
) -> Float[Tensor, " 3"]:
    """The place with the least weighted sum of distances to points, from a first `centre` on (Weiszfeld 1937)."""
    for _ in range(MAX_STEPS):
        distances = (points - centre).norm(dim=1)
        typical = float(distances.median())
        pull = weights / (distances + SOFTENING * typical).clamp(min=torch.finfo(torch.float64).tiny)
        step = (points - centre).T @ pull / pull.sum()
        centre = centre + step
        if float(step.norm()) <= MIN_STEP * typical:
            break
    return centre


def _shape(offsets: Float[Tensor, "n 3"], weights: Float[Tensor, " n"]) -> Float[Tensor, "3 3"]:
    """Covariance of the directions in which the points lie, of determinant 1, whatever their distances (Tyler 1987)."""
    identity = torch.eye(3, dtype=offsets.dtype)
    shape = identity
    for _ in range(SHAPE_STEPS):
        pull = weights / _lengths(offsets, shape).square().clamp(min=torch.finfo(offsets.dtype).tiny)
        moments = (offsets * pull[:, None]).T @ offsets
        moments = moments / moments.trace().clamp(min=torch.finfo(offsets.dtype).tiny) + THICKNESS * identity
        shape = moments / torch.linalg.det(moments) ** (1 / 3)
    return shape


def _lengths(offsets: Float[Tensor, "n 3"], shape: Float[Tensor, "3 3"]) -> Float[Tensor, " n"]:
    """Distances from 0, measured by a covariance (Mahalanobis)."""
    return (torch.linalg.solve(shape, offsets.T) * offsets.T).sum(dim=0).clamp(min=0.0).sqrt()


def _enclosing_ball(points: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, " 3"], float]:
    """Centre and radius of nearly the smallest ball around the points (Bădoiu and Clarkson 2003)."""
    centre = points.mean(dim=0)
    for step in range(1, MAX_STEPS):
        away = points - centre
        centre = centre + away[away.square().sum(dim=1).argmax()] / (step + 1)
    return centre, float((points - centre).norm(dim=1).max())


def _quantile(values: Float[Tensor, " n"], weights: Float[Tensor, " n"], share: float) -> float:
    """The value with this share of the weight below it."""
    order = values.argsort()
    running = weights[order].cumsum(dim=0)
    place = int(torch.searchsorted(running, share * running[-1]))
    return float(values[order][min(place, len(values) - 1)])
