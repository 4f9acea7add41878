"""Lenses: maps between the rays that a camera sees and places in its image.

A ray is a direction in the camera's frame (x right, y down, z forward), of any length.  A place is in focal lengths
from the principal point: px = focal length × place + principal point.

A lens is a projection, distorted by Brown's model.  With the undistorted place q and ρ = |q|:

    place = q (1 + a₁ρ² + a₂ρ⁴ + …) / (1 + b₁ρ² + b₂ρ⁴ + …) + tangential(p₁, p₂) + prism(s₁, …, s₄)

which holds COLMAP's and OpenCV's models: their fisheyes distort the equidistant projection, all others the pinhole's.
Beyond the radius up to which the radial map grows, where no image reaches, it goes on at a constant slope.  So every
lens is one-to-one, and a pixel out of its range has no ray.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.system.contracts import Range, check_fields, contract
from aaplug.system.errors import UsageError, one

Projection = Literal["pinhole", "equidistant", "equisolid", "equirect", "ortho"]
Angle = Annotated[float, Range(above=0, most=180)]  # degrees
MAX_RADII = {"pinhole": 20.0, "equidistant": math.pi, "equisolid": 2.0}  # of an undistorted place that has a ray
MIN_SLOPE = 0.05  # of the radial map: where it is flatter, the lens ends
RADII = 4096  # at which the radial map is tabulated
NEWTON_STEPS = 6  # which double the digits of a tabulated start
TINY = 1e-30  # squared length below which a vector has no direction
NEWTON_TOLERANCE = 1e-9  # focal lengths, of a step after which none is needed
PLACE_TOLERANCE = 1e-5  # focal lengths between a place and that of the ray found for it


@dataclass(frozen=True)
class Lens:
    """A projection and its distortion.

    projection: "pinhole"; the fisheyes "equidistant" (ρ = θ, the angle from the axis) and "equisolid" (ρ = 2 sin θ/2);
        "equirect" (longitude and latitude, in radians); or "ortho", whose places are x and y in world units.
    radial, rational: a and b above.  tangential: p₁ and p₂.  prism: s₁ to s₄, OpenCV's thin prism.
    max_angle: degrees from the axis beyond which nothing is seen.
    """

    projection: Projection = "pinhole"
    radial: tuple[float, ...] = ()
    rational: tuple[float, ...] = ()
    tangential: tuple[float, float] = (0.0, 0.0)
    prism: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    max_angle: Angle = 180.0

    def __post_init__(self) -> None:
        check_fields(self)
        if self.distorts and self.projection not in ("pinhole", "equidistant"):
            raise UsageError("lens", f"{one(self.projection)} projection has no distortion")

    @property
    def distorts(self) -> bool:
        """True if places differ from the projection's own."""
        return any((*self.radial, *self.rational, *self.tangential, *self.prism))

    @property
    def kind(self) -> str:
        """The projection, and that it is distorted, in words."""
        return f"a distorted {self.projection}" if self.distorts else self.projection

    @property
    def flat(self) -> bool:
        """True if splats are Gaussians in the pinhole's image plane, as training's were; else across their ray."""
        return self.projection in ("pinhole", "ortho")

    @property
    def period(self) -> float:
        """Width of a full turn, after which places repeat; 0 if they do not."""
        return 2 * math.pi if self.projection == "equirect" else 0.0

    @contract
    def places(self, rays: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 2"]:
        """Where rays meet the image.  A pinhole's rays need z > 0."""
        x, y, z = rays.unbind(dim=-1)
        if self.projection == "equirect":
            return torch.stack([torch.atan2(x, z), torch.atan2(y, torch.hypot(x, z))], dim=-1)
        if self.projection == "ortho":
            return rays[..., :2]
        if self.projection == "pinhole":
            return self._distorted(rays[..., :2] / rays[..., 2:])
        across = _length(rays[..., :2])
        angle = torch.atan2(across, z)
        radius = angle if self.projection == "equidistant" else 2 * (angle / 2).sin()
        return self._distorted(rays[..., :2] * (radius / across)[..., None])

    @contract
    def rays(self, places: Float[Tensor, "*n 2"]) -> Float[Tensor, "*n 3"]:
        """The ray of each place, of length 1 (a pinhole's and ortho's: z = 1); 0 where nothing is seen."""
        if self.projection == "equirect":
            u, v = places.unbind(dim=-1)
            rays = torch.stack([u.sin() * v.cos(), v.sin(), u.cos() * v.cos()], dim=-1)
            inside = (v.abs() <= math.pi / 2) & (u.abs() <= math.pi)
            return self._within_angle(rays.where(inside[..., None], 0.0))
        if self.projection == "ortho":
            return torch.cat([places, torch.ones_like(places[..., :1])], dim=-1)
        plane, inside = self._undistorted(places)
        radius = _length(plane)[..., None]
        inside = inside & (radius[..., 0] <= MAX_RADII[self.projection])
        if self.projection == "pinhole":
            rays = torch.cat([plane, torch.ones_like(radius)], dim=-1)
        else:
            angle = radius if self.projection == "equidistant" else 2 * (radius / 2).clamp(max=1).asin()
            rays = torch.cat([plane * (angle.sin() / radius), angle.cos()], dim=-1)
        return self._within_angle(rays.where(inside[..., None], 0.0))

    def derivatives(self, rays: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 2 3"]:
        """Derivatives of `places` by the rays' x, y and z.

        A ray r at the angle θ from the axis and the distance d from it, in the direction u, has the undistorted place
        ρ(θ) u.  Its derivative by x and y is (ρ/d)(1 - u uᵀ) + ρ′ z/|r|² u uᵀ, and by z it is -ρ′ d/|r|² u.
        """
        if self.projection == "equirect":
            (x, y, z), level, length = rays.unbind(dim=-1), _length(rays[..., ::2]), _length(rays)
            u = torch.stack([z, torch.zeros_like(y), -x], dim=-1) / level[..., None] ** 2
            v = torch.stack([-x * y / level, level, -z * y / level], dim=-1) / length[..., None] ** 2
            return torch.stack([u, v], dim=-2)
        if self.projection == "ortho":
            return rays.new_tensor([[1, 0, 0], [0, 1, 0]]).expand(*rays.shape[:-1], 2, 3)
        across, z, square = _length(rays[..., :2]), rays[..., 2], rays.square().sum(dim=-1) + TINY
        angle = torch.atan2(across, z)
        if self.projection == "pinhole":
            radius, growth = across / z, square / z**2
        elif self.projection == "equidistant":
            radius, growth = angle, torch.ones_like(angle)
        else:
            radius, growth = 2 * (angle / 2).sin(), (angle / 2).cos()
        around, inwards = (radius / across)[..., None, None], (growth / square)[..., None, None]
        u = (rays[..., :2] / across[..., None])[..., None]
        rows = around * torch.eye(2).to(rays) + (inwards * z[..., None, None] - around) * u * u.mT
        rows = torch.cat([rows, -inwards * rays[..., :2, None]], dim=-1)
        if not self.distorts:
            return rows
        return torch.stack(self._brown(rays[..., :2] * around[..., 0])[1], dim=-1).unflatten(-1, (2, 2)) @ rows

    def areas(self, rays: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n"]:
        """Area of the image per solid angle (steradian) around rays, of a lens that is not flat."""
        across, ahead = _length(rays[..., :2]), rays[..., 2]
        if self.projection == "equirect":
            return _length(rays) / _length(rays[..., ::2])
        if self.projection == "equisolid":
            return torch.ones_like(ahead)
        angle = torch.atan2(across, ahead)
        area = angle / angle.sin().clamp(min=TINY)
        if not self.distorts:
            return area
        a, b, c, d = self._brown(rays[..., :2] * (angle / across)[..., None])[1]
        return area * (a * d - b * c).abs()

    def _within_angle(self, rays: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
        if self.max_angle >= 180:
            return rays
        cosine = rays[..., 2:] / _length(rays)[..., None]
        return rays.where(cosine >= math.cos(math.radians(self.max_angle)), 0.0)

    def _distorted(self, plane: Float[Tensor, "*n 2"]) -> Float[Tensor, "*n 2"]:
        return self._brown(plane, derive=False)[0] if self.distorts else plane

    def _brown(
        self, plane: Float[Tensor, "*n 2"], derive: bool = True
    ) -> tuple[Float[Tensor, "*n 2"], tuple[Tensor, ...]]:
        """Distorted places, and their derivatives if these are asked for: of x by x and y, then of y."""
        end, slope = self._end
        outside = (_length(plane) / end).clamp(min=1)[..., None]
        x, y = (plane / outside).unbind(dim=-1)
        square, (p1, p2), (s1, s2, s3, s4) = x * x + y * y, self.tangential, self.prism
        (above, d_above), (below, d_below) = (_series(c, square) for c in (self.radial, self.rational))
        scale = above / below
        u = x * scale + 2 * p1 * x * y + p2 * (square + 2 * x * x) + s1 * square + s2 * square * square
        v = y * scale + p1 * (square + 2 * y * y) + 2 * p2 * x * y + s3 * square + s4 * square * square
        places = torch.stack([u, v], dim=-1) + slope * (plane - plane / outside)
        if not derive:
            return places, ()
        d_scale = (d_above * below - above * d_below) / below**2
        by_square = 2 * (s1 + 2 * s2 * square), 2 * (s3 + 2 * s4 * square)
        both = 2 * (x * y * d_scale + p1 * x + p2 * y)
        derivatives = (
            scale + 2 * x * x * d_scale + 2 * p1 * y + 6 * p2 * x + x * by_square[0],
            both + y * by_square[0],
            both + x * by_square[1],
            scale + 2 * y * y * d_scale + 6 * p1 * y + 2 * p2 * x + y * by_square[1],
        )
        return places, derivatives

    def _undistorted(self, places: Float[Tensor, "*n 2"]) -> tuple[Float[Tensor, "*n 2"], Tensor]:
        """Undistorted places, and where there are any; by Newton's method from the inverse of the radial map."""
        if not self.distorts:
            return places, torch.ones_like(places[..., 0], dtype=torch.bool)
        end, _ = self._end
        radii = torch.linspace(0, end, RADII, dtype=torch.float64, device=places.device)
        mapped = self._mapped(radii)
        wanted, distance = places.double(), _length(places.double())
        upper = torch.searchsorted(mapped, distance.contiguous()).clamp(1, RADII - 1)
        below, above = mapped[upper - 1], mapped[upper]
        radius = radii[upper - 1] + (distance - below) / (above - below) * (end / (RADII - 1))
        plane = wanted * (radius / distance)[..., None]
        for _ in range(NEWTON_STEPS):
            mapped_to, (a, b, c, d) = self._brown(plane)
            u, v = (mapped_to - wanted).unbind(dim=-1)
            step = torch.stack([d * u - b * v, a * v - c * u], dim=-1) / (a * d - b * c)[..., None]
            plane = plane - step
            if (step.abs() <= NEWTON_TOLERANCE).all():  # the next step would be its square
                break
        error = _length(self._distorted(plane) - wanted)
        inside = (error <= PLACE_TOLERANCE) & (_length(plane) <= end)
        return plane.to(places), inside

    def _mapped(self, radii: Float[Tensor, " r"]) -> Float[Tensor, " r"]:
        """The radial map."""
        return radii * _series(self.radial, radii**2)[0] / _series(self.rational, radii**2)[0]

    @cached_property
    def _end(self) -> tuple[float, float]:
        """Undistorted radius at which the lens ends, and the slope at which its radial map goes on."""
        most = MAX_RADII[self.projection]
        radii = torch.linspace(0, most, RADII, dtype=torch.float64)
        slopes = torch.diff(self._mapped(radii)) / (most / (RADII - 1))
        flat = (~(slopes >= MIN_SLOPE)).nonzero()
        last = int(flat[0]) if len(flat) else RADII - 1
        if not last:
            raise UsageError("lens", f"its distortion {self.radial} leaves no image")
        return float(radii[last]), float(slopes[last - 1])


def _length(vector: Float[Tensor, "*n d"]) -> Float[Tensor, "*n"]:
    """Its length, above 0, so that it divides and has a derivative everywhere."""
    return (vector.square().sum(dim=-1) + TINY).sqrt()


def _series(coefficients: tuple[float, ...], square: Tensor) -> tuple[Tensor, Tensor]:
    """1 + c₁ρ² + c₂ρ⁴ + …, of ρ², and its derivative by ρ²."""
    value, slope = torch.zeros_like(square), torch.zeros_like(square)
    for power in range(len(coefficients), 0, -1):
        value = (value + coefficients[power - 1]) * square
        slope = slope * square + power * coefficients[power - 1]
    return 1 + value, slope


def opencv_lens(coefficients: tuple[float, ...], fisheye: bool = False) -> Lens:
    """The lens of OpenCV's coefficients: k1, k2, p1, p2, k3, … s4; of a fisheye k1 to k4."""
    if fisheye:
        return Lens("equidistant", radial=tuple(coefficients))
    k1, k2, p1, p2, k3, k4, k5, k6, *prism = (*coefficients, *[0.0] * (12 - len(coefficients)))
    s1, s2, s3, s4 = prism[:4]
    return Lens("pinhole", (k1, k2, k3), (k4, k5, k6), (p1, p2), (s1, s2, s3, s4))


PINHOLE, EQUIRECT, ORTHO = Lens(), Lens("equirect"), Lens("ortho")
EQUIDISTANT, EQUISOLID = Lens("equidistant"), Lens("equisolid")
