"""2D Gaussians of one view: discs, as planes through which rays pass (2DGS, Huang et al. 2024, arXiv 2403.17888).

n: Gaussians; m: discs that the image shows; t: tiles; P: pixels per tile; p: pixels; h, w: px.  A disc's point u, v, in
standard deviations along its two tangents, is seen at pixel x, y and depth z by M (u, v, 1)ᵀ = (x z, y z, z).  M is its
ray transform (2DGS, eqs. 7, 9).

w_i = alpha_i T_i: weight of the i-th disc of a pixel, in front of which the transmittance is T_i.  m_i: its depth.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from aaplug.core.cameras import Camera
from aaplug.core.colours import BLACK
from aaplug.core.interfaces import Limits, Pixels, Rasterizer
from aaplug.core.projection import rotation_matrices
from aaplug.core.rules import RULES_GSPLAT, Rules
from aaplug.core.splats import Splats2D
from aaplug.gsplat.arguments import Options, View
from aaplug.methods.pixel_kernels.surfel import SURFEL, Surfel
from aaplug.rasterizers.tiled.order import Order
from aaplug.rendering.passes import MAX_NUMBER

REACH = 3.33  # standard deviations: gsplat's radius of a disc
MIN_REACH = 0.01  # px: gsplat's least standard deviation of a disc's box
MIN_FACING = 1e-4  # of its squared size in px: a disc nearer to edge-on is drawn as a line this thin
BELOW_1 = 1 - 2.0**-24  # the float32 below it
MIN_SIZE = 1e-8  # px: smaller discs are drawn by their low-pass filter alone, at any size


@dataclass(frozen=True, eq=False)
class Discs:
    """The discs that an image shows.

    sources: index in the scene.  transforms: M.  normals: in the camera's frame, towards the camera.
    radii: half the sides of their bounding boxes, in px.
    """

    sources: Int[Tensor, " m"]
    transforms: Float[Tensor, "m 3 3"]
    normals: Float[Tensor, "m 3"]
    opacities: Float[Tensor, " m"]
    radii: Int[Tensor, "m 2"]

    @classmethod
    def of(cls, view: View, options: Options) -> "Discs":
        """The discs that gsplat keeps.

        It drops what lies beyond a plane, reaches the camera's plane within a standard deviation, has a radius of at
        most `radius_clip` along both axes, or a box outside of the image.
        """
        scene, camera = view.scene, view.camera
        rotation, shift = camera.cam_from_world[:3, :3], camera.cam_from_world[:3, 3]
        lens = rotation.new_tensor([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
        centres = (scene.means.double() @ rotation.T + shift).to(scene.means)
        axes = rotation.to(scene.means) @ rotation_matrices(scene.unit_quats)
        tangents = axes[:, :, :2] * scene.scales[:, None, :2]
        transforms = lens.to(centres) @ torch.cat([tangents, centres[:, :, None]], dim=2)
        normals = axes[:, :, 2]
        normals = torch.where((normals * centres).sum(dim=1, keepdim=True) < 0, normals, -normals)
        with torch.no_grad():
            middles, extents, ahead = _boxes(transforms.double())
            radii = (REACH * extents).ceil()
            depths = centres[:, 2]
            keep = (depths > options.near_plane) & (depths < options.far_plane) & ahead
            sources = (keep & options.shows(middles, radii)).nonzero().squeeze(1)
        columns = (x.index_select(0, sources) for x in (transforms, normals, view.opacities, radii.int()))
        return cls(sources, *columns)

    @property
    def depths(self) -> Float[Tensor, " m"]:
        """Depths of the centres, in world units."""
        return self.transforms[:, 2, 2]


def _boxes(transforms: Float[Tensor, "n 3 3"]) -> tuple[Tensor, Tensor, Tensor]:
    """Bounding boxes of the discs' standard deviations: middles and half sides in px, and which lie before the camera.

    A line of pixels touches the disc where its plane, a row of M, touches the unit circle: a quadratic equation.
    """
    x, y, z = transforms.unbind(dim=1)
    circle = z.new_tensor([1.0, 1.0, -1.0])
    across = (circle * z * z).sum(dim=1)
    weights = circle / across[:, None]
    middles = torch.stack([(weights * row * z).sum(dim=1) for row in (x, y)], dim=1)
    squares = torch.stack([(weights * row * row).sum(dim=1) for row in (x, y)], dim=1)
    return middles, (middles * middles - squares).clamp(min=MIN_REACH**2).sqrt(), across < 0


def splats_of(discs: Discs, transforms: Float[Tensor, "m 3 3"]) -> Splats2D:
    """The discs as splats with depth slopes, from ray transforms in the place of their own.

    J is the derivative of the pixel by u, v at the centre: the covariance is J Jᵀ.  Depth grows along u and v by the
    last row of M, so inverse depth falls by J⁻ᵀ (M₃₁, M₃₂) / M₃₃ per px, relatively.
    """
    depths = transforms[:, 2, 2]
    means = transforms[:, :2, 2] / depths[:, None]
    rising = transforms[:, 2:, :2]
    jacobian = (transforms[:, :2, :2] - means[:, :, None] * rising) / depths[:, None, None]
    (a, b), (c, d) = (row.unbind(dim=1) for row in jacobian.unbind(dim=1))
    det, least = a * d - b * c, MIN_FACING * (a * a + b * b + c * c + d * d).clamp(min=MIN_SIZE)
    det = torch.where(det.abs() < least, torch.where(det < 0, -least, least), det)
    g, h = (rising[:, 0] / depths[:, None]).unbind(dim=1)
    slopes = torch.stack([d * g - c * h, a * h - b * g], dim=1) / det[:, None]
    covs = torch.stack([a * a + b * b, a * c + b * d, c * c + d * d], dim=1)
    return Splats2D(means, covs, det * det, depths, discs.opacities, discs.sources, depth_slopes=slopes)


def normals_of_depth(depth: Float[Tensor, "h w 1"], camera: Camera) -> Float[Tensor, "h w 3"]:
    """Normals, towards the camera, of the surface that a depth image shows; 0 along the image's border.

    They are those of central differences of its points in the world.
    """
    y, x = (torch.arange(side, dtype=depth.dtype, device=depth.device) + 0.5 for side in depth.shape[:2])
    y, x = torch.meshgrid((y - camera.cy) / camera.fy, (x - camera.cx) / camera.fx, indexing="ij")
    rays = torch.stack([x, y, torch.ones_like(x)], dim=2)
    points = (rays * depth) @ torch.linalg.inv(camera.cam_from_world[:3, :3]).T.to(depth)
    down = points[2:, 1:-1] - points[:-2, 1:-1]
    right = points[1:-1, 2:] - points[1:-1, :-2]
    normals = functional.normalize(torch.linalg.cross(down, right), dim=2)
    return functional.pad(normals, (0, 0, 1, 1, 1, 1))


def distortion(splats: Splats2D, options: Options, rasterizer: Rasterizer) -> Float[Tensor, "h w 1"]:
    """Σ_i Σ_(j<i) 2 w_i w_j (m_i - m_j): 2DGS, eq. 13, with the depth of centres, as gsplat has it.

    With T the transmittance behind everything, D = Σ w_i m_i, and w_i (T_i + T_(i+1)) = T_i² - T_(i+1)², the sum is
    2 (D (1 + T) - Σ (T_i² - T_(i+1)²) m_i).  The last sum is the depth of discs that are all drawn twice, one copy
    behind the other.  The difference is small, so both are drawn in float64.
    """
    exact = splats.to(torch.float64)
    exact = replace(exact, rgb=exact.depths[:, None].expand(-1, 3))
    rules = options.convention.rules
    once = rasterizer(exact, options.hw, BLACK, SURFEL, None, rules)
    squared = replace(rules, max_alpha=BELOW_1, min_transmittance=rules.min_transmittance**2)
    twice = rasterizer(exact, options.hw, BLACK, Twice(once=rules), None, squared)
    return (2 * (once.rgb[..., :1] * (2 - once.alpha[..., None]) - twice.rgb[..., :1])).to(splats.means)


@dataclass(frozen=True)
class Twice(Surfel):
    """Two discs of the same place, one behind the other, by the rules `once` of each."""

    name: str = "surfel-twice"
    once: Rules = RULES_GSPLAT

    def alpha(self, rows: Float[Tensor, "*n t c"], pixels: Pixels, limits: Limits) -> Float[Tensor, "*n t P"]:
        """1 - (1 - alpha)² = alpha (2 - alpha)."""
        alpha = super().alpha(rows, pixels, Limits.by(self.once)).clamp(max=self.once.max_alpha)
        return alpha * (2 - alpha)

    def exact(self, splats: Splats2D, offsets: Float[Tensor, "p c 2"]) -> Float[Tensor, "p c"]:
        """The same, over the opacity."""
        alpha = (splats.opacities * super().exact(splats, offsets)).clamp(max=self.once.max_alpha)
        alpha = torch.where(alpha >= self.once.min_alpha, alpha, 0.0)
        return alpha * (2 - alpha) / splats.opacities.clamp(min=self.once.min_alpha)


def median_depth(splats: Splats2D, options: Options, rasterizer: Rasterizer) -> Float[Tensor, "h w 1"]:
    """Depth of the last disc in front of which the transmittance is above a half; 0 where there is none."""
    with torch.no_grad():
        numbered = splats if len(splats) <= MAX_NUMBER else splats.to(torch.float64)
        numbers = torch.arange(len(splats), device=splats.means.device).to(numbered.depths)
        numbered = replace(numbered, rgb=torch.stack([numbered.depths, numbers, 0 * numbers], dim=1))
        last = Order(SURFEL, ("last", "last", "last", "last"))
        found = rasterizer(numbered, options.hw, BLACK, SURFEL, last, options.convention.rules).rgb[..., :1]
    return torch.cat([splats.depths, splats.depths.new_zeros(1)])[found.long()]  # -1, the last: no disc
