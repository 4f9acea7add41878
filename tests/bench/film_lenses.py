"""Lenses against pinholes and against rays: panoramas, fisheyes and distorted views, in dB."""

import math
from dataclasses import replace
from statistics import median

import cv2
import torch
from jaxtyping import Float
from torch import Tensor

from aaplug import RULES_3DGS, Camera, CameraSet, Gaussians, Renderer, Splats2D, find_recipe, read_cameras, read_scene
from aaplug.core.imaging import box_average
from aaplug.core.lenses import EQUIDISTANT, EQUIRECT, opencv_lens
from aaplug.core.projection import rotation_matrices
from aaplug.core.shading import shade
from aaplug.methods.filters.matched import BY_GLOBAL_RATE
from tests.bench import heading, row
from tests.bench.room import inside, matrices, room, turned
from tests.conftest import SAMPLE

WIDTH = 4096  # px, of the panorama
SMALLER = 4  # times: both images are averaged before they are compared
OPENCV = opencv_lens((-0.12, 0.03, 0.001, -0.002))
PIXELS_AT_ONCE = 1024  # of the reference by rays


def panorama(pose: Float[Tensor, "4 4"], width: int = WIDTH) -> Camera:
    """All around a pose."""
    focal = width / (2 * math.pi)
    return Camera("panorama", width, width // 2, focal, focal, width / 2, width / 4, pose, lens=EQUIRECT)


def face(pose: Float[Tensor, "4 4"], width: int = WIDTH) -> Camera:
    """A square view of 90° with the panorama's focal length."""
    side = SMALLER * round(width / math.pi / SMALLER)
    return Camera("face", side, side, side / 2, side / 2, side / 2, side / 2, pose)


def seen_by(image: Float[Tensor, "h w 3"], source: Camera, camera: Camera) -> Float[Tensor, "H W 3"]:
    """What a camera in the same place would see of an image, by bicubic interpolation."""
    turn = source.cam_from_world[:3, :3] @ camera.cam_from_world[:3, :3].T
    places = source.pixels(source.lens.places(camera.rays(pixel_centres(camera)) @ turn.T)) - 0.5
    border = 8
    wide = cv2.copyMakeBorder(image.numpy(), 0, 0, border, border, cv2.BORDER_WRAP)
    high = cv2.copyMakeBorder(wide, border, border, 0, 0, cv2.BORDER_REFLECT)
    across, down = ((places[..., i] + border).float().numpy() for i in (0, 1))
    return torch.from_numpy(cv2.remap(high, across, down, cv2.INTER_CUBIC))


def cube_faces(renderer: Renderer, pose: Float[Tensor, "4 4"], width: int) -> dict[str, float]:
    """PSNR of cube faces cut from a panorama against pinholes': near the centre, of the face, at seam and poles.

    A pinhole draws splats in the order of their depth, a panorama in that of their distance.  Figures that end in
    "order" are against pinholes that draw in the panorama's order, so that the lens alone decides.  "turned" is a
    pinhole's view against one that is turned by 30°: what their orders alone cost.
    """
    camera = panorama(pose, width)
    image = renderer(camera).rgb
    errors: dict[str, list[float]] = {}
    for number, each in enumerate(matrices(pose)):
        view = face(each, width)
        small = view.scaled(1 / SMALLER)
        rays = small.rays(pixel_centres(small))
        angle = torch.atan(rays[..., :2].norm(dim=-1))
        near = angle < math.radians(30)
        splats = renderer.splats(view)
        away = (renderer.scene.means[splats.sources].double() - view.centre).norm(dim=1)
        by_distance = renderer.paint(replace(splats, depths=away.float()), view.hw).rgb
        cut, by_depth = seen_by(image, camera, view), renderer(view).rgb
        for name, drawn in (("", by_depth), (", in its order", by_distance)):
            error = (box_average(cut, SMALLER) - box_average(drawn, SMALLER)).double().square().mean(dim=-1)
            parts = {"within 30°": near, "whole face": near | True}
            if number > 3:
                parts["poles, 5°"] = angle < math.radians(5)
            if number == 2:  # behind: the panorama's edge is its middle column
                parts["seam, 2°"] = (rays[..., 0].abs() < math.tan(math.radians(2))) & near
            for part, mask in parts.items():
                errors.setdefault(part + name, []).append(float(error[mask].mean()))
        if number == 0:
            side = turned(each, 30.0)
            other = seen_by(renderer(replace(view, cam_from_world=side)).rgb, replace(view, cam_from_world=side), view)
            error = (box_average(other, SMALLER) - box_average(by_depth, SMALLER)).double().square().mean(dim=-1)
            common = (rays[..., 0] > math.tan(math.radians(-10))) & near
            errors["a pinhole turned by 30°"] = [float(error[common].mean())]
    return {name: -10 * math.log10(max(sum(each) / len(each), 1e-12)) for name, each in errors.items()}


def pixel_centres(camera: Camera) -> Float[Tensor, "h w 2"]:
    """x and y of the centres, in px."""
    y, x = torch.meshgrid(*(torch.arange(side, dtype=torch.float64) + 0.5 for side in camera.hw), indexing="ij")
    return torch.stack([x, y], dim=-1)


def by_rays(scene: Gaussians, camera: Camera, dilation: float) -> Float[Tensor, "h w 3"]:
    """Float64 reference: each Gaussian integrated along each pixel's ray, on black.

    A Gaussian of covariance Σ and mean μ integrates along the unit ray d to exp(-½ (μᵀPμ - (dᵀPμ)²/dᵀPd)) / √(dᵀPd),
    P = Σ⁻¹, which is divided by its value on the ray to its centre.
    dilation: added across that ray, in squared radians.
    """
    rotation = camera.cam_from_world[:3, :3]
    means = (scene.means.double() - camera.centre) @ rotation.T
    order = means.norm(dim=1).argsort()
    order = order[means[order].norm(dim=1) > RULES_3DGS.near]
    means, opacity, one = means[order], scene.opacities[order].double(), torch.ones(len(order))
    distance = means.norm(dim=1, keepdim=True)
    sight = means / distance
    axes = rotation @ rotation_matrices(scene.unit_quats[order].double()) * scene.scales[order].double()[:, None]
    across = torch.eye(3, dtype=torch.float64) - sight[:, :, None] * sight[:, None]
    precision = torch.linalg.inv(axes @ axes.mT + dilation * distance[..., None].square() * across)
    splats = Splats2D(torch.zeros(len(order), 2), torch.ones(len(order), 3), one, one, scene.opacities[order], order)
    colours = shade(splats, scene, camera).rgb
    assert colours is not None
    at_mean = torch.einsum("nij,nj->ni", precision, means)
    whole, central = (at_mean * means).sum(dim=1), torch.einsum("ni,nij,nj->n", sight, precision, sight)
    peak = -0.5 * (whole - (at_mean * sight).sum(dim=1).square() / central)
    parts = []
    for rays in camera.rays(pixel_centres(camera).reshape(-1, 2)).split(PIXELS_AT_ONCE):
        square = torch.einsum("pi,nij,pj->pn", rays, precision, rays).clamp(min=1e-300)
        along = rays @ at_mean.T
        exponent = -0.5 * (whole - along.square() / square) - peak
        alpha = (opacity * exponent.exp() * (central / square).sqrt()).clamp(max=RULES_3DGS.max_alpha)
        seen = (alpha >= RULES_3DGS.min_alpha) & (along > 0) & (rays.square().sum(dim=1, keepdim=True) > 0)
        alpha = torch.where(seen, alpha, 0.0)
        through = (1 - alpha).cumprod(dim=1)
        before = torch.cat([torch.ones_like(through[:, :1]), through[:, :-1]], dim=1)
        parts.append((alpha * before) @ colours.double())
    return torch.cat(parts).view(*camera.hw, 3)


def fisheye(scene: Gaussians, cameras: CameraSet, pose: Float[Tensor, "4 4"], side: int = 160) -> float:
    """PSNR of a fisheye of 180° against `by_rays`, with training's dilation as an angle."""
    recipe = find_recipe("matched")
    recipe = replace(recipe, screen=replace(BY_GLOBAL_RATE, pixel_variance=0.0))  # what training's own filter is
    renderer = Renderer.of(scene, cameras, recipe, background="black", min_seen=0)
    lens, focal = replace(EQUIDISTANT, max_angle=90.0), side / math.pi
    camera = Camera("fisheye", side, side, focal, focal, side / 2, side / 2, pose, lens=lens)
    trained = median(view.focal for view in cameras.train)
    truth = by_rays(scene, camera, scene.convention.kernel / trained**2)
    return decibels(renderer(camera).rgb, truth)


def decibels(image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"]) -> float:
    """PSNR of the colours that can be shown."""
    error = (image.double().clamp(0, 1) - truth.double().clamp(0, 1)).square().mean()
    return -10 * math.log10(float(error))


def distorted(renderer: Renderer, view: Camera) -> float:
    """PSNR of a view through an OPENCV lens against the undistorted view of 4x size, resampled."""
    bent, large = replace(view, lens=OPENCV), view.scaled(SMALLER)
    width, height = (round(1.3 * side) for side in (large.width, large.height))  # as much as the lens shows
    centre = {"cx": large.cx + (width - large.width) / 2, "cy": large.cy + (height - large.height) / 2}
    straight = replace(large, width=width, height=height, **centre)
    fine = bent.resized(SMALLER * bent.width, SMALLER * bent.height)
    truth = box_average(seen_by(renderer(straight).rgb, straight, fine), SMALLER)
    return decibels(renderer(bent).rgb, truth)


def sideways(n: int = 400) -> Gaussians:
    """Gaussians 80 to 100° off the axis of a camera in the origin that looks along z, at 1 to 4 world units."""
    g = torch.Generator().manual_seed(0)
    around, off = 2 * math.pi * torch.rand(n, generator=g), torch.deg2rad(80 + 20 * torch.rand(n, generator=g))
    distance = 1 + 3 * torch.rand(n, generator=g)
    rays = torch.stack([off.sin() * around.cos(), off.sin() * around.sin(), off.cos()], dim=1)
    return Gaussians(
        means=distance[:, None] * rays,
        quats=torch.randn(n, 4, generator=g),
        log_scales=-3.5 + 1.5 * torch.rand(n, 3, generator=g),
        logit_opacities=torch.randn(n, generator=g) + 1,
        sh=torch.randn(n, 1, 3, generator=g),
    )


def main(width: int = WIDTH) -> None:
    """Print the table of the room and of the bundled chair."""
    heading("lenses", "what", "figure", "asked")
    walls, inner = room(width * 300 // WIDTH), inside(focal=width / (2 * math.pi))
    chair, views = read_scene(SAMPLE / "chair.ply").gaussians(), read_cameras(SAMPLE)
    exact, pose = Renderer.of(walls, inner, "matched"), inner.train[0].cam_from_world
    for name, figure in cube_faces(exact, pose, width).items():
        asked = 45.0 if "within" in name else 38.0 if "whole" in name else ""
        row(f"room: faces of a panorama against pinholes, {name}, dB", figure, asked)
    for recipe, asked in (("auto", 38.0), ("classic", "")):
        small = Renderer.of(walls, inner, recipe)(panorama(pose, width // SMALLER)).rgb
        truth = box_average(exact(panorama(pose, width)).rgb, SMALLER)
        row(f"room, {recipe}: panorama at 1/4 against the mean of 4x4, dB", decibels(small, truth), asked)
    row("chair: fisheye of 180° against rays, dB", fisheye(chair, views, views.test[0].cam_from_world), 42.0)
    row("80 to 100° off the axis, dB", fisheye(sideways(), inner, torch.eye(4, dtype=torch.float64)), 42.0)
    for view in views.test[:2]:
        bent = distorted(Renderer.of(chair, views, "matched"), view)
        row(f"chair {view.name}: OPENCV lens against the straight view, dB", bent, 45.0)
