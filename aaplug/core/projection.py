"""From Gaussians and a camera to splats: EWA projection, by a pinhole or through another lens.

n: Gaussians of the scene, m: those beyond the near plane.  A splat's covariance is M Mᵀ with the 2×3 factor M = J W R S
(Zwicker et al., "EWA splatting", 2002; 3DGS, eq. 5).  Its determinant |a × b|² comes from the rows a and b of M, where
nothing cancels.  The camera's centre is subtracted in float64; the rest runs in the scene's precision.

Through a lens other than a pinhole, splats lie in planes of their own: see `core.sights`.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import reduce

import torch
from jaxtyping import Float, Int
from torch import Tensor

from aaplug.core.cameras import Camera
from aaplug.core.gaussians import MAX_LOG_SCALE, Gaussians
from aaplug.core.kernels import EAGER, EXAMPLE_SIZE, Kernel, Kernels, backward_of
from aaplug.core.lenses import PINHOLE
from aaplug.core.rules import NEAR, RULES_3DGS, Rules
from aaplug.core.sights import sights
from aaplug.core.splats import Splats2D, picked

JACOBIAN_MARGIN = 0.3  # of half the image: 3DGS linearises no farther out (1.3 tan(fov/2))
ANY_SLOPE = (-1e9, 1e9)  # limits that clamp nothing
PLACES = 17  # along a side, at which it is found what a distorting pinhole sees
MAX_SIGMA = 1e9  # px: larger splats look the same, but their determinant overflows float32
MIN_LENGTH = 1e-12  # of a quaternion, which one of length 0 is divided by; its gradient stays finite
MIN_FACING = 1e-6  # of depth: a disc at a flatter angle is a line, and its slope overflows


def project(
    scene: Gaussians, camera: Camera, kernels: Kernels = EAGER, rules: Rules = RULES_3DGS, clamped: bool = True
) -> Splats2D:
    """Splats of every Gaussian beyond the near plane, without colour and before any screen filter.

    clamped: slopes are, as 3DGS does; a disc that a pinhole's rays meet exactly needs the derivative at its own centre.
    """
    if camera.lens != PINHOLE:
        return _project_through(scene, camera, kernels, rules)
    shape = scene.means, scene.quats, scene.log_scales
    columns = kernels.run(PROJECT, *shape, *_camera_rows(scene.means, camera, rules, clamped))
    return _beyond(rules.near, columns, scene.opacities)


def project_covariances(
    means: Float[Tensor, "n 3"],
    covariances: Float[Tensor, "n 3 3"],
    opacities: Float[Tensor, " n"],
    camera: Camera,
    rules: Rules = RULES_3DGS,
) -> Splats2D:
    """The same for Gaussians of any covariance Σ, in squared world units, of which the upper triangle is read.

    With T = J W, whose rows have the cross product n, det(T Σ Tᵀ) = nᵀ cof(Σ) n (Cauchy-Binet), in float64.  Through
    another lens than a pinhole, J is the lens's own at each centre, and the splats are ellipses of the image, which end
    at a panorama's edge.
    """
    if camera.lens == PINHOLE:
        centres, across, down, depths = _linearised(means, *_camera_rows(means, camera, rules))
    else:
        centres, across, down, depths = _linearised_through(means, camera, rules)
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = (row.unbind(dim=1) for row in covariances.double().unbind(dim=1))
    sigma = torch.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], dim=1).unflatten(1, (3, 3))
    a, b = (torch.stack(row, dim=1).double() for row in (across, down))
    covs = [torch.einsum("ni,nij,nj->n", p, sigma, q) for p, q in ((a, a), (a, b), (b, b))]
    normal = torch.linalg.cross(a, b)
    cofactors = torch.linalg.cross(sigma.roll(-1, dims=1), sigma.roll(-2, dims=1))
    dets = torch.einsum("ni,nij,nj->n", normal, cofactors, normal).clamp(min=0.0)
    columns = torch.stack(centres, dim=1), torch.stack(covs, dim=1).to(means), dets.to(means), depths
    return _beyond(rules.near, columns, opacities)


def _beyond(near: float, columns: tuple[Tensor, ...], opacities: Float[Tensor, " n"]) -> Splats2D:
    """Splats of these means, covariances, determinants and depths, without those before the near plane."""
    means, covs, dets, depths = columns
    in_front = (depths > near).nonzero().squeeze(1)
    if len(in_front) < len(means):
        means, covs, dets, depths, opacities = (picked(column, in_front) for column in (*columns, opacities))
    return Splats2D(means, covs, dets, depths, opacities, in_front)


def with_depth_slopes(splats: Splats2D, scene: Gaussians, camera: Camera) -> Splats2D:
    """Add the depth slopes of discs: each Gaussian is taken for the disc across its thinnest axis.

    A ray meets the plane through c with normal N at the inverse depth N·ray / N·c, which is linear in the pixel.
    """
    rotation = camera.cam_from_world[:3, :3].to(scene.means)
    normals = thinnest_axes(scene, splats.sources) @ rotation.T
    offset = scene.means.index_select(0, splats.sources).double() - camera.centre.to(scene.means.device)
    facing = (normals * (offset.to(scene.means) @ rotation.T)).sum(dim=1)
    edge_on = facing.abs() < MIN_FACING * splats.depths
    facing = torch.where(edge_on, MIN_FACING * splats.depths, facing)
    focal = normals.new_tensor([camera.fx, camera.fy])
    return replace(splats, depth_slopes=-(splats.depths / facing)[:, None] * normals[:, :2] / focal)


@torch.no_grad()
def with_ray_slopes(splats: Splats2D, scene: Gaussians, camera: Camera) -> Splats2D:
    """Add the ray slopes of a pinhole's filtered splats: their tilts.

    Given a pixel d px from the splat's centre, the Gaussian's depth has the mean z + d · C⁻¹ c, with C the splat's
    covariance and c that of pixel and depth: the plane of the Gaussian's maxima along rays, of tilt C⁻¹ c
    (StopThePop, Radl et al. 2024).
    """
    means, quats, scales = (x.index_select(0, splats.sources) for x in (scene.means, scene.unit_quats, scene.scales))
    _, across, down, _ = _linearised(means, *_camera_rows(means, camera, RULES_3DGS))
    root = rotation_matrices(quats) * scales[:, None, :]
    along = root @ (camera.cam_from_world[2, :3].to(means) @ root)[:, :, None]  # covariance of place and depth
    x, y = (sum_of(p * q for p, q in zip(row, along.squeeze(2).unbind(dim=1), strict=True)) for row in (across, down))
    xx, xy, yy = splats.covs.unbind(dim=1)
    tilts = torch.stack([yy * x - xy * y, xx * y - xy * x], dim=1) / splats.dets[:, None]
    return replace(splats, ray_slopes=tilts.nan_to_num(0.0, 0.0, 0.0))


def thinnest_axes(scene: Gaussians, sources: Int[Tensor, " m"]) -> Float[Tensor, "m 3"]:
    """Direction in the world, of either sign, along which each of these Gaussians is thinnest."""
    thinnest = scene.log_scales.argmin(dim=1).index_select(0, sources)
    axes = rotation_matrices(scene.unit_quats.index_select(0, sources))
    return axes.gather(2, thinnest[:, None, None].expand(-1, 3, 1)).squeeze(2)


def _camera_rows(
    like: Tensor, camera: Camera, rules: Rules, clamped: bool = True
) -> tuple[Float[Tensor, " 3"], Float[Tensor, "3 3"], Float[Tensor, " 9"]]:
    """Centre (float64), rotation, and the lens.

    The lens: fx, fy, cx, cy, the slopes between which projection is linearised, and the near plane's depth.
    """
    x, y = slope_limits(camera) if clamped else (ANY_SLOPE, ANY_SLOPE)
    lens = like.new_tensor([camera.fx, camera.fy, camera.cx, camera.cy, *x, *y, rules.near])
    rotation = camera.cam_from_world[:3, :3].to(like)
    return camera.centre.to(like.device), rotation, lens


def slope_limits(camera: Camera) -> tuple[tuple[float, float], tuple[float, float]]:
    """Smallest and largest x/z, and y/z, at which projection is linearised; slopes beyond are clamped.

    They are those that the image sees, widened by the margin.
    """
    if camera.lens.distorts and camera.lens.projection == "pinhole":
        x, y = ((float(slopes.min()), float(slopes.max())) for slopes in _seen_slopes(camera).T)
        return x, y
    return _widened(camera)


def _widened(camera: Camera) -> tuple[tuple[float, float], tuple[float, float]]:
    """Ends of the image along x and y, widened by the margin, as places of the lens."""
    ends = []
    for centre, focal, side in ((camera.cx, camera.fx, camera.width), (camera.cy, camera.fy, camera.height)):
        margin = JACOBIAN_MARGIN * 0.5 * side / focal
        ends.append((-centre / focal - margin, (side - centre) / focal + margin))
    return ends[0], ends[1]


def _seen_slopes(camera: Camera) -> Float[Tensor, "p 2"]:
    """x/z and y/z of places all over the widened image of a pinhole that distorts; 0 where it sees nothing."""
    axes = (torch.linspace(*ends, PLACES, dtype=torch.float64) for ends in _widened(camera))
    return camera.lens.rays(torch.cartesian_prod(*axes))[:, :2]


def _project(
    means: Float[Tensor, "n 3"],
    quats: Float[Tensor, "n 4"],
    log_scales: Float[Tensor, "n 3"],
    centre: Float[Tensor, " 3"],
    rotation: Float[Tensor, "3 3"],
    lens: Float[Tensor, " 9"],
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Mean, packed covariance, determinant and depth of each Gaussian, written in columns so that the loop fuses."""
    centres, across, down, z = _linearised(means, centre, rotation, lens)
    covs, dets = _shape(across, down, quats, log_scales)
    return torch.stack(centres, dim=1), covs, dets, z


def _shape(
    across: Sequence[Tensor], down: Sequence[Tensor], quats: Float[Tensor, "n 4"], log_scales: Float[Tensor, "n 3"]
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, " n"]]:
    """Packed covariance and determinant, from the rows of J W."""
    lengths = log_scales.clamp(-MAX_LOG_SCALE, MAX_LOG_SCALE).exp().unbind(dim=1)
    quats = quats / quats.square().sum(dim=1, keepdim=True).clamp(min=MIN_LENGTH**2).sqrt()
    axes = zip(*rotation_rows(quats), strict=True)
    a, b = [], []
    for axis, length in zip(axes, lengths, strict=True):
        for factor, row in ((a, across), (b, down)):
            along = sum_of(p * q for p, q in zip(row, axis, strict=True)) * length
            factor.append(along.clamp(-MAX_SIGMA, MAX_SIGMA))
    covs = [sum_of(p * q for p, q in zip(*pair, strict=True)) for pair in ((a, a), (a, b), (b, b))]
    normal = [a[i - 2] * b[i - 1] - a[i - 1] * b[i - 2] for i in range(3)]
    return torch.stack(covs, dim=1), sum_of(side * side for side in normal)


def _project_through(scene: Gaussians, camera: Camera, kernels: Kernels, rules: Rules) -> Splats2D:
    """Splats through a lens other than a pinhole, in their own planes."""
    places, depths, rates, planes = sights(scene.means, camera, rules.near)
    rotation = camera.cam_from_world[:3, :3].to(planes)
    if camera.lens.projection == "pinhole":
        rows = _camera_rows(scene.means, camera, rules)
        _, covs, dets, _ = kernels.run(PROJECT, scene.means, scene.quats, scene.log_scales, *rows)
    else:
        if camera.lens.projection == "ortho":
            axes = rotation[:2] * rotation.new_tensor([[camera.fx], [camera.fy]])
        else:
            axes = planes[:, :2] @ rotation / depths.clamp(min=rules.near)[:, None, None]
        across, down = (axis.unbind(dim=-1) for axis in axes.unbind(dim=-2))
        covs, dets = _shape(across, down, scene.unit_quats, scene.log_scales)
    splats = _beyond(rules.near, (places, covs, dets, depths), scene.opacities)
    own = {"planes": planes.index_select(0, splats.sources), "rates": rates.index_select(0, splats.sources)}
    return replace(splats, **own, camera=camera)


def _linearised(
    means: Float[Tensor, "n 3"], centre: Float[Tensor, " 3"], rotation: Float[Tensor, "3 3"], lens: Float[Tensor, " 9"]
) -> tuple[list[Tensor], list[Tensor], list[Tensor], Tensor]:
    """x and y of the mean in px; the two rows of J W, in px per world unit along the world's axes; depth."""
    local = (means.double() - centre).to(means).unbind(dim=1)
    fx, fy, cx, cy, left, right, top, bottom, near = lens.unbind()
    world = [row.unbind() for row in rotation.unbind()]
    x, y, z = (sum_of(r * p for r, p in zip(row, local, strict=True)) for row in world)
    ahead = torch.maximum(z, near)  # nearer Gaussians are dropped later; here they must not overflow into gradients
    slope_x, slope_y = x / ahead, y / ahead
    # The rows of the projection's derivative lie along the world's axes; its direction is clamped to the widened image.
    clamped_x = torch.minimum(torch.maximum(slope_x, left), right)
    clamped_y = torch.minimum(torch.maximum(slope_y, top), bottom)
    across = [fx / ahead * (i - clamped_x * k) for i, k in zip(world[0], world[2], strict=True)]
    down = [fy / ahead * (j - clamped_y * k) for j, k in zip(world[1], world[2], strict=True)]
    return [fx * slope_x + cx, fy * slope_y + cy], across, down, z


def _linearised_through(
    means: Float[Tensor, "n 3"], camera: Camera, rules: Rules
) -> tuple[list[Tensor], list[Tensor], list[Tensor], Tensor]:
    """The same through any lens, in float64 until the means are in px."""
    lens, rotation = camera.lens, camera.cam_from_world[:3, :3].to(means.device)
    x, y, z = ((means.double() - camera.centre.to(means.device)) @ rotation.T).unbind(dim=1)
    ahead = z.clamp(min=rules.near)
    rays = torch.stack([x, y, ahead], dim=1)
    centres = camera.pixels(lens.places(rays)).to(means)
    if lens.projection == "pinhole":  # Brown's polynomials are steep beyond what the image sees, also in its corners
        (left, right), (top, bottom) = slope_limits(camera)
        slopes = torch.stack([(x / ahead).clamp(left, right), (y / ahead).clamp(top, bottom)], dim=1)
        farthest = _seen_slopes(camera).norm(dim=1).max().to(slopes)
        slopes = slopes * (farthest / slopes.norm(dim=1, keepdim=True).clamp(min=farthest))
        rays = torch.cat([slopes, torch.ones_like(slopes[:, :1])], dim=1) * ahead[:, None]
    rows = lens.derivatives(rays) * rays.new_tensor([camera.fx, camera.fy])[:, None] @ rotation
    across, down = (list(row.unbind(dim=1)) for row in rows.unbind(dim=1))
    return list(centres.unbind(dim=1)), across, down, z.to(means)


def sum_of(terms: Iterable[Tensor]) -> Tensor:
    """Sum from left to right."""
    return reduce(torch.add, terms)


def rotation_rows(quats: Float[Tensor, "n 4"]) -> list[list[Tensor]]:
    """Rows of the rotation matrices of unit quaternions wxyz."""
    w, x, y, z = quats.unbind(dim=-1)
    return [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]


def rotation_matrices(quats: Float[Tensor, "n 4"]) -> Float[Tensor, "n 3 3"]:
    """Rotation matrices of unit quaternions wxyz."""
    return torch.stack([torch.stack(row, dim=-1) for row in rotation_rows(quats)], dim=-2)


def quats_of(rotations: Float[Tensor, "n 3 3"]) -> Float[Tensor, "n 4"]:
    """Unit quaternions wxyz of rotation matrices, from each one's largest component (Shepperd 1978)."""
    m = [[rotations[:, i, j] for j in range(3)] for i in range(3)]
    x, y, z = m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1]
    xy, xz, yz = m[1][0] + m[0][1], m[2][0] + m[0][2], m[2][1] + m[1][2]
    squares = [1 + s * m[0][0] + t * m[1][1] + s * t * m[2][2] for s, t in ((1, 1), (1, -1), (-1, 1), (-1, -1))]
    w, xx, yy, zz = squares
    rows = [(w, x, y, z), (x, xx, xy, xz), (y, xy, yy, yz), (z, xz, yz, zz)]
    products = torch.stack([torch.stack(row, dim=1) for row in rows], dim=1)  # 4 q qᵀ
    largest = torch.stack(squares, dim=1).argmax(dim=1)
    return torch.nn.functional.normalize(products[torch.arange(len(largest)), largest], dim=1)


def _project_example() -> tuple[Tensor, ...]:
    generator = torch.Generator().manual_seed(0)
    means, log_scales = torch.rand(2, EXAMPLE_SIZE, 3, generator=generator).unbind()
    quats = torch.randn(EXAMPLE_SIZE, 4, generator=generator)
    centre = torch.tensor([0.5, 0.5, -2.0], dtype=torch.float64)
    lens = torch.tensor([90.0, 90.0, 40.0, 40.0, -0.5, 0.5, -0.5, 0.5, NEAR])
    return means, quats, log_scales - 4, centre, torch.eye(3), lens


PROJECT = Kernel("project", _project, _project_example, ("n", "n", "n", None, None, None), gathers=True)
PROJECT_BACKWARD = backward_of(PROJECT, ("n", "n", "n", "n"), chained=True)
