"""From Gaussians and one camera to splats: EWA projection and spherical-harmonics colour.

n: Gaussians of the scene, m: those in front of the near plane.  The covariance of a splat is M Mᵀ with the 2×3 factor
M = J W R S (Zwicker et al., "EWA splatting", 2002; 3DGS, eq. 5), and its determinant |a × b|² comes from M's rows a
and b, where nothing cancels.  The camera's centre is subtracted in float64; the rest runs in the scene's precision.
"""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.cameras import NEAR, Camera
from aaplug.gaussians import Gaussians
from aaplug.splats import Splats2D

JACOBIAN_MARGIN = 0.3  # of half the image at depth 1: 3DGS linearises no farther out (1.3 tan(fov/2) when centred)
MAX_SIGMA = 1e9  # px: larger splats look the same, and their determinant would overflow float32
COLOUR_OFFSET = 0.5  # 3DGS stores colours around mid-grey

SH_C0 = 0.28209479177387814
SH_C1 = 0.4886025119029199
SH_C2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
SH_C3 = (
    0.5900435899266435,
    2.890611442640554,
    0.4570457994644658,
    0.3731763325901154,
    1.445305721320277,
)


def project(scene: Gaussians, camera: Camera) -> Splats2D:
    """Splats of every Gaussian in front of the near plane, without colour and before any screen filter."""
    rotation = camera.cam_from_world[:3, :3].to(scene.means)
    local = (scene.means.double() - camera.centre.to(scene.means.device)).to(scene.means)
    in_camera = local @ rotation.T
    sources = (in_camera[:, 2] > NEAR).nonzero().squeeze(1)
    in_camera = in_camera[sources]
    factors = _jacobian(in_camera, camera) @ rotation @ _axes(scene, sources)
    a, b = factors.clamp(-MAX_SIGMA, MAX_SIGMA).unbind(dim=1)
    covs = torch.stack([(a * a).sum(1), (a * b).sum(1), (b * b).sum(1)], dim=1)
    dets = torch.linalg.cross(a, b).square().sum(1)
    x, y, z = in_camera.unbind(dim=1)
    means = torch.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], dim=1)
    return Splats2D(means, covs, dets, z, scene.opacities[sources], sources)


def shade(splats: Splats2D, scene: Gaussians, camera: Camera) -> Splats2D:
    """Give splats their colour as seen from the camera: SH plus mid-grey, not below black (3DGS)."""
    means = scene.means[splats.sources].double() - camera.centre.to(scene.means.device)
    directions = torch.nn.functional.normalize(means, dim=1).to(scene.means)
    rgb = sh_colour(scene.sh[splats.sources], directions)
    return replace(splats, rgb=rgb.clamp(min=0.0))


def sh_colour(sh: Float[Tensor, "m k 3"], directions: Float[Tensor, "m 3"]) -> Float[Tensor, "m 3"]:
    """Colour of real spherical harmonics of degree 0 to 3 in unit directions from the camera, not clamped."""
    basis = torch.stack(_sh_basis(directions, sh.shape[1]), dim=1)
    return torch.einsum("mk,mkc->mc", basis, sh) + COLOUR_OFFSET


def rotation_matrices(quats: Float[Tensor, "n 4"]) -> Float[Tensor, "n 3 3"]:
    """Rotation matrices of unit quaternions wxyz."""
    w, x, y, z = quats.unbind(dim=-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


def _axes(scene: Gaussians, sources: Tensor) -> Float[Tensor, "m 3 3"]:
    """R S: the Gaussians' axes as columns, each as long as its standard deviation."""
    return rotation_matrices(scene.unit_quats[sources]) * scene.scales[sources][:, None, :]


def _jacobian(in_camera: Float[Tensor, "m 3"], camera: Camera) -> Float[Tensor, "m 2 3"]:
    """Derivative of the pinhole projection in px, its direction held inside the widened image (3DGS, gsplat)."""
    x, y, z = in_camera.unbind(dim=1)
    x_over_z = _held_inside(x / z, camera.cx, camera.fx, camera.width)
    y_over_z = _held_inside(y / z, camera.cy, camera.fy, camera.height)
    zero = torch.zeros_like(z)
    across = torch.stack([camera.fx / z, zero, -camera.fx / z * x_over_z], dim=1)
    down = torch.stack([zero, camera.fy / z, -camera.fy / z * y_over_z], dim=1)
    return torch.stack([across, down], dim=1)


def _held_inside(
    slope: Float[Tensor, " m"], centre: float, focal: float, side: int
) -> Float[Tensor, " m"]:
    margin = JACOBIAN_MARGIN * 0.5 * side / focal
    return slope.clamp(-centre / focal - margin, (side - centre) / focal + margin)


def _sh_basis(directions: Float[Tensor, "m 3"], coefficients: int) -> list[Float[Tensor, " m"]]:
    x, y, z = directions.unbind(dim=1)
    xx, yy, zz = x * x, y * y, z * z
    basis = [torch.full_like(x, SH_C0)]
    if coefficients > 1:
        basis += [-SH_C1 * y, SH_C1 * z, -SH_C1 * x]
    if coefficients > 4:
        basis += [SH_C2[0] * x * y, -SH_C2[0] * y * z, SH_C2[1] * (2 * zz - xx - yy)]
        basis += [-SH_C2[0] * x * z, SH_C2[2] * (xx - yy)]
    if coefficients > 9:
        basis += [
            -SH_C3[0] * y * (3 * xx - yy),
            SH_C3[1] * x * y * z,
            -SH_C3[2] * y * (4 * zz - xx - yy),
        ]
        basis += [SH_C3[3] * z * (2 * zz - 3 * xx - 3 * yy), -SH_C3[2] * x * (4 * zz - xx - yy)]
        basis += [SH_C3[4] * z * (xx - yy), -SH_C3[0] * x * (xx - 3 * yy)]
    return basis
