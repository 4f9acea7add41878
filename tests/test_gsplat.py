"""The drop-in for gsplat's rasterization: against gsplat's own torch code, plain formulas, and aaplug's renderer."""

import inspect
import math
import re
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum
from fractions import Fraction
from itertools import product
from types import ModuleType

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn import Parameter
from torch.optim import Optimizer

from aaplug import RASTERIZERS, RECIPES, Camera, Gaussians, Render, Renderer, UsageError
from aaplug.core.conventions import CLASSIC
from aaplug.core.kernels import EAGER
from aaplug.core.projection import rotation_matrices
from aaplug.core.rules import RULES_GSPLAT
from aaplug.gsplat import patch, rasterization, rasterization_2dgs
from aaplug.gsplat.arguments import FIXED
from aaplug.gsplat.discs import normals_of_depth
from aaplug.gsplat.drawing import rasterizer_of
from aaplug.gsplat.on_cuda_alone import compute_relocation, quat_scale_to_covar_preci, spherical_harmonics
from aaplug.gsplat.patching import REPLACED
from aaplug.methods.filters.matched import Matched
from aaplug.rasterizers.tiled import Tiled
from tests.conftest import make_camera, make_scene

F64 = torch.float64
SIZE = (40, 28)  # width and height, px
INPUTS = ("means", "quats", "scales", "opacities", "colors", "viewmats")
EYES = ((0.3, -3.0, 0.4), (2.5, -1.0, -0.5))


def gaussians(n: int = 40, dtype: torch.dtype = F64, degree: int | None = None, seed: int = 0) -> dict[str, Tensor]:
    """Arguments of a random scene; three channels, or harmonics."""
    scene = make_scene(n, seed, dtype, degree or 0)
    return arguments(scene) | ({"colors": scene.sh[:, 0] + 0.7} if degree is None else {})


def arguments(scene: Gaussians) -> dict[str, Tensor]:
    return dict(zip(INPUTS, (scene.means, scene.quats, scene.scales, scene.opacities, scene.sh), strict=False))


def cameras(views: list[Camera], dtype: torch.dtype = F64) -> dict[str, object]:
    """Arguments of some cameras of one size."""
    Ks = [torch.tensor([[v.fx, 0, v.cx], [0, v.fy, v.cy], [0, 0, 1]], dtype=dtype) for v in views]
    poses = torch.stack([view.cam_from_world for view in views]).to(dtype)
    return {"viewmats": poses, "Ks": torch.stack(Ks), "width": views[0].width, "height": views[0].height}


@dataclass(frozen=True)
class Nothing:
    """A rasterizer that draws nothing, for tests of `meta`."""

    name: str = "nothing"

    def __call__(self, splats, hw, background, pixel, compositor=None, rules=RULES_GSPLAT) -> Render:
        return Render(splats.means.new_zeros(*hw, 3), splats.means.new_zeros(hw))


def two_views(dtype: torch.dtype = F64) -> dict[str, object]:
    return cameras([make_camera(eye, SIZE) for eye in EYES], dtype)


def small_views(*eyes: tuple[float, float, float]) -> dict[str, object]:
    """Cameras whose gradients are soon found by differences, with oblong pixels."""
    views = [make_camera(eye, (8, 6)) for eye in eyes]
    return cameras([replace(view, fy=1.07 * view.fx) for view in views])


def has_gradients(draw: Callable[..., object], leaves: dict[str, Tensor]) -> bool:
    """True if those in arguments that are named are finite differences."""
    inputs = [x.clone().requires_grad_() for x in leaves.values()]
    how = {"eps": 1e-7, "rtol": 1e-4, "atol": 1e-4, "fast_mode": True}
    return torch.autograd.gradcheck(lambda *args: draw(**dict(zip(leaves, args, strict=True))), inputs, **how)


def unusual_views(count: int, dtype: torch.dtype = F64) -> dict[str, object]:
    """Cameras with oblong pixels whose optical axis misses the image's middle, at random places in the scene."""
    g = torch.Generator().manual_seed(5)
    eyes = torch.randn(count, 3, generator=g) * 1.5
    views = [make_camera(tuple(eye.tolist()), WIDE, 1.1) for eye in eyes]
    return cameras([replace(v, fy=v.fx * 1.2, cx=250.0, cy=290.0) for v in views], dtype)


# ------------------------------------------------------------------------------------------- gsplat's own torch code


@pytest.fixture
def reference():
    """The module of gsplat's package with its kernels in plain torch."""
    return pytest.importorskip("gsplat.cuda._torch_impl", reason="the package gsplat is not installed")


def covariances(quats: Tensor, scales: Tensor) -> Tensor:
    factor = rotation_matrices(torch.nn.functional.normalize(quats, dim=1)) * scales[:, None]
    return factor @ factor.mT


def opaque(given: str) -> dict[str, Tensor]:
    """Opaque Gaussians whose shapes are given as scales or as `covars`."""
    values = gaussians(50) | {"opacities": torch.ones(50, dtype=F64)}
    if given == "covars":
        values |= {"covars": covariances(values["quats"], values["scales"]), "quats": None, "scales": None}
    return values


WIDE, WORLD = (640, 480), 1e6


@pytest.mark.parametrize("given", ["scales", "covars"])
@pytest.mark.parametrize("model", ["pinhole", "fisheye", "ortho"])
def test_projection_equals_gsplats_on_a_thousand_cases(reference, model, given):
    values, views = opaque(given), unusual_views(20)
    if model != "pinhole":  # a larger world, in which the 1e-7 that gsplat adds to a fisheye's lengths does not count
        for name, power in (("means", 1), ("scales", 1), ("covars", 2)):
            values |= {name: values[name] * WORLD**power} if values.get(name) is not None else {}
        views["viewmats"][:, :3, 3] *= WORLD
    if model == "ortho":
        views["Ks"][:, [0, 1], [0, 1]] /= 3 * WORLD
    sigma = values["covars"] if given == "covars" else covariances(values["quats"], values["scales"])
    words = {"calc_compensations": True, "camera_model": model}
    radii, means, depths, conics, factors = reference._fully_fused_projection(
        values["means"], sigma, *views.values(), **words
    )
    for dtype, px, relative in ((torch.float32, 1e-4, 1e-5), (F64, 1e-9, 1e-9)):
        ours = {name: x.to(dtype) if isinstance(x, Tensor) else x for name, x in (values | views).items()}
        words = {"packed": False, "rasterize_mode": "antialiased", "camera_model": model, "rasterizer": Nothing()}
        _, _, meta = rasterization(**ours, **words)
        shown, theirs = ((x > 0).all(dim=2) for x in (meta["radii"], radii))
        both = shown & theirs
        assert both.sum() > 800
        # gsplat's torch code draws every splat as far as an opaque one, so it keeps some more at the image's edge
        assert not (shown & ~theirs).any()
        assert (theirs & ~shown).sum() < 10
        reach = (2 * (255 * factors[both]).log()).sqrt() / 3.33
        assert (meta["radii"][both] - reach[:, None] * radii[both]).abs().max() < 1.5
        inside = both & ((means > 0) & (means < torch.tensor(WIDE))).all(dim=2)
        assert (meta["means2d"] - means)[inside].abs().max() < px
        pairs = {"means2d": means, "depths": depths[..., None], "conics": conics, "opacities": factors[..., None]}
        for name, expected in pairs.items():
            error = (meta[name].view_as(expected) - expected)[both].abs().amax(dim=1) / expected[both].abs().amax(dim=1)
            assert error.max() < relative, name


LENSES = {
    "distorted": ("pinhole", (-0.2, 0.05, 0.01, 0.1, 0.02, -0.01), (0.01, -0.02), (0.01, -0.01, 0.02, 0.01)),
    "wide": ("pinhole", (0.0, 0.0, 0.0, 0.5, 0.0, 0.0)),  # its edges see slopes of 1.07, at places of 0.68
    "fisheye": ("fisheye", (0.05, -0.02, 0.01, 0.003)),
    "ortho": ("ortho",),
}


def lens_words(name: str, *shape: int) -> dict[str, object]:
    """Arguments of a lens for cameras of this shape."""
    model, *coefficients = LENSES[name]
    names = ("radial_coeffs", "tangential_coeffs", "thin_prism_coeffs")
    pairs = zip(names, coefficients, strict=False)
    return {"camera_model": model} | {key: torch.tensor(k, dtype=F64).expand(*shape, -1) for key, k in pairs}


@pytest.mark.parametrize("name", ["distorted", "wide", "fisheye"])
def test_distortion_is_opencvs_linearised_at_each_centre(name):
    values, views = gaussians(400) | {"opacities": torch.ones(400, dtype=F64)}, two_views()
    values["means"] *= 2
    views["Ks"][:, [0, 1], [0, 1]] = SIZE[0] / 2 / 0.68
    words = lens_words(name, 2)
    _, _, meta = rasterization(**values, **views, **words, eps2d=0.0, packed=False, with_ut=True, rasterizer=Nothing())
    radial, tangential, prism = (*LENSES[name][1:], (0.0,) * 2, (0.0,) * 4)[:3]
    order = radial if name == "fisheye" else (*radial[:2], *tangential[:2], *radial[2:], *(*prism, 0, 0)[:4])
    project = cv2.fisheye.projectPoints if name == "fisheye" else cv2.projectPoints
    zero, sigma = np.zeros((1, 3)), covariances(values["quats"], values["scales"])
    for camera in range(2):
        pose, K = views["viewmats"][camera], views["Ks"][camera].numpy()

        def seen(points: Tensor, K: np.ndarray = K) -> Tensor:
            return torch.from_numpy(project(points[:, None].numpy(), zero, zero, K, np.array(order))[0][:, 0])

        local = values["means"] @ pose[:3, :3].T + pose[:3, 3]
        steps = 1e-6 * torch.eye(3, dtype=F64)
        jacobian = torch.stack([(seen(local + step) - seen(local - step)) / 2e-6 for step in steps], dim=2)
        factor = jacobian @ pose[:3, :3]
        means, slopes = seen(local), (local[:, :2] / local[:, 2:]).norm(dim=1)
        inside = (meta["radii"][camera] > 0).all(dim=1) & ((means > 0) & (means < torch.tensor(SIZE))).all(dim=1)
        inside &= slopes < 1.2  # up to which the radial maps grow
        conics = torch.linalg.inv((factor @ sigma @ factor.mT)[inside]).flatten(1)[:, [0, 1, 3]]
        assert inside.sum() > 50
        assert name != "wide" or (local[:, 0] / local[:, 2])[inside].abs().max() > 1
        torch.testing.assert_close(meta["means2d"][camera][inside], means[inside])
        torch.testing.assert_close(meta["conics"][camera][inside], conics, rtol=1e-4, atol=1e-9)


@pytest.mark.parametrize("function", [rasterization, rasterization_2dgs])
def test_arguments_have_gsplats_names_and_defaults(function):
    gsplat = pytest.importorskip("gsplat", reason="the package gsplat is not installed")
    theirs, ours = inspect.signature(getattr(gsplat, function.__name__)), inspect.signature(function).parameters
    order = [name for name in theirs.parameters if name in ours]
    assert order == [name for name in ours if name in theirs.parameters] == list(theirs.parameters)[: len(order)]
    for name, parameter in theirs.parameters.items():
        default = ours[name].default if name in ours else FIXED[name]
        expected = getattr(parameter.default, "name", parameter.default)
        assert default == (pytest.approx(expected) if isinstance(expected, float) else expected), name


# ------------------------------------------------------------------------------------------------------------- images


def composited(
    meta: dict[str, object], features: Tensor, camera: int, cap: float = 0.999, size: tuple[int, int] = SIZE
) -> tuple[Tensor, Tensor]:
    """One image by the formula of alpha compositing from an unpacked `meta`: [h, w, d] and [h, w, 1]."""
    width, height = size
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    order = meta["depths"][camera].argsort()
    order = order[(meta["radii"][camera, order] > 0).all(dim=1)]
    image, left = torch.zeros(height, width, features.shape[1], dtype=F64), torch.ones(height, width, 1, dtype=F64)
    for i in order.tolist():
        mean, (xx, xy, yy) = meta["means2d"][camera, i], meta["conics"][camera, i]
        dx, dy = x - mean[0], y - mean[1]
        alpha = meta["opacities"][camera, i] * torch.exp(-0.5 * (xx * dx * dx + yy * dy * dy) - xy * dx * dy)
        alpha = torch.where(alpha < 1 / 255, 0.0, alpha.clamp(max=cap))[..., None]
        image, left = image + left * alpha * features[i], left * (1 - alpha)
    return image, 1 - left


@pytest.mark.parametrize(
    ("lens", "mode", "channels"),
    [(None, "classic", 1), (None, "classic", 5), (None, "antialiased", 3), *((x, "classic", 3) for x in LENSES)],
)
def test_colours_and_depth_equal_the_formula_over_a_background_and_depth_may_be_divided_by_alpha(lens, mode, channels):
    values, views = gaussians() | {"colors": torch.rand(40, channels, dtype=F64)}, two_views()
    # two opaque bright splats, each in the middle of one image
    values["means"][:2], values["opacities"][:2], values["scales"][:2] = 0.5 * torch.tensor(EYES), 1.0, 0.2
    values["colors"][:2] = 1.0
    backgrounds = None if channels == 5 else torch.rand(2, channels, dtype=F64)
    words = {"rasterize_mode": mode, "backgrounds": backgrounds, "packed": False}
    words |= views | (lens_words(lens, 2) if lens else {})
    modes = ("RGB", "D", "ED", "RGB+D", "RGB+ED")
    images = {mode: rasterization(**values, **words, render_mode=mode) for mode in modes}
    _, alpha, meta = images["D"]
    depth, expected = images["D"][0], images["ED"][0]
    for camera, background in enumerate([0.0, 0.0] if backgrounds is None else backgrounds):
        features = torch.cat([values["colors"], meta["depths"][camera][:, None]], dim=1)
        by_formula, covered = composited(meta, features, camera)
        capped = composited(meta, features, camera, 0.99)[0]
        assert mode == "antialiased" or (by_formula - capped)[..., :channels].abs().max() > 1e-4, (
            "the cap should matter here"
        )
        by_formula[..., :channels] += (1 - covered) * background
        torch.testing.assert_close(images["RGB"][0][camera], by_formula[..., :channels], rtol=0, atol=1e-6)
        torch.testing.assert_close(depth[camera], by_formula[..., channels:], rtol=1e-5, atol=1e-6)
        torch.testing.assert_close(alpha[camera], covered, rtol=0, atol=1e-6)
    torch.testing.assert_close(expected[alpha > 0.01], (depth / alpha)[alpha > 0.01])
    assert (expected[alpha == 0] == 0).all()
    for mode, last in (("RGB+D", depth), ("RGB+ED", expected)):
        torch.testing.assert_close(images[mode][0], torch.cat([images["RGB"][0], last], dim=-1))


def test_nothing_is_drawn_of_what_is_out_of_sight():
    values, views, backgrounds = gaussians(), two_views(), torch.rand(2, 3, dtype=F64)
    values["means"][:, 1] -= 100
    image, alpha, meta = rasterization(**values, **views, backgrounds=backgrounds)
    assert (image == backgrounds[:, None, None]).all()
    assert (alpha == 0).all()
    assert len(meta["means2d"]) == 0


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_harmonics_and_rules_are_those_of_the_renderer(degree):
    scene, views = make_scene(200, degree=3, dtype=F64), [make_camera(eye, SIZE) for eye in EYES]
    scene = replace(scene, convention=replace(CLASSIC, rules=RULES_GSPLAT))
    images, alphas, _ = rasterization(**arguments(scene), **cameras(views), sh_degree=degree)
    shown = replace(scene, sh=scene.sh[:, : (degree + 1) ** 2])
    renderer = Renderer.of(shown, views, "classic", rasterizer="eager")
    for view, image, alpha in zip(views, images, alphas, strict=True):
        expected = renderer(view)
        torch.testing.assert_close(image, expected.rgb, rtol=0, atol=1e-9)
        torch.testing.assert_close(alpha[..., 0], expected.alpha, rtol=0, atol=1e-9)


@pytest.mark.parametrize("trained_mode", ["classic", "antialiased"])
@pytest.mark.parametrize("rate", [0.25, 1.0, 2.0])
def test_matched_draws_as_the_recipe_at_the_given_rate(trained_mode, rate):
    scene, view = make_scene(200, degree=1, dtype=F64), make_camera(EYES[0], SIZE)
    convention = replace(CLASSIC, compensated=trained_mode == "antialiased", rules=RULES_GSPLAT)
    scene, small = replace(scene, convention=convention), view.scaled(rate)
    recipe = replace(RECIPES["matched"], screen=Matched("global"))
    expected = Renderer.of(scene, [view], recipe, rasterizer="eager")(small).rgb
    values = arguments(scene)
    words = {"sh_degree": 1, "rasterize_mode": "matched", "trained_mode": trained_mode}
    image, _, _ = rasterization(**values, **cameras([small]), **words, relative_rate=rate)
    torch.testing.assert_close(image[0], expected, rtol=0, atol=1e-9)
    if rate == 1:
        trained, _, _ = rasterization(**values, **cameras([view]), sh_degree=1, rasterize_mode=trained_mode)
        torch.testing.assert_close(image, trained, rtol=0, atol=1e-6)


# -------------------------------------------------------------------------------------------------------------- discs


def discs(n: int = 30) -> dict[str, Tensor]:
    """Arguments of random discs, some of them opaque, some smaller than a pixel, and many faint."""
    values = gaussians(n)
    values["opacities"][10:] *= 0.15
    values["opacities"][:3], values["scales"][:3], values["scales"][3:6] = 1.0, 0.3, 0.01
    return values


def drawn_by_rays(values: dict[str, Tensor], views: dict[str, object], camera: int) -> tuple[Tensor, ...]:
    """Colour, alpha, normal, distortion, depth and median depth of each pixel by the geometry of rays and planes."""
    pose, lens = views["viewmats"][camera], views["Ks"][camera]
    y, x = torch.meshgrid(*(torch.arange(side, dtype=F64) + 0.5 for side in SIZE[::-1]), indexing="ij")
    rays = torch.stack([x, y, torch.ones_like(x)], dim=2) @ torch.linalg.inv(lens).T
    centres = values["means"] @ pose[:3, :3].T + pose[:3, 3]
    axes = pose[:3, :3] @ rotation_matrices(torch.nn.functional.normalize(values["quats"], dim=1))
    left, distort, median, depth = torch.ones_like(x), torch.zeros_like(x), torch.zeros_like(x), torch.zeros_like(x)
    colour, normals, going = torch.zeros(*x.shape, 3, dtype=F64), torch.zeros(*x.shape, 3, dtype=F64), left > 0
    for i in centres[:, 2].argsort().tolist():
        centre, (right, up, normal) = centres[i], axes[i].T
        if centre[2] <= 0.01:
            continue
        at = (normal @ centre) / (rays @ normal)  # depth of the plane
        offset = at[..., None] * rays - centre
        s, t = (offset @ axis / scale for axis, scale in zip((right, up), values["scales"][i], strict=False))
        px = lens[:2] @ centre / centre[2]
        squared = (x - px[0]) ** 2 + (y - px[1]) ** 2
        alpha = values["opacities"][i] * torch.exp(-0.5 * torch.minimum(s * s + t * t, 2 * squared))
        alpha = torch.where(alpha < 1 / 255, 0.0, alpha.clamp(max=RULES_GSPLAT.max_alpha))
        going = going & (left * (1 - alpha) > 1e-4)
        alpha = torch.where(going, alpha, 0.0)
        weight = left * alpha
        distort = distort + 2 * weight * (centre[2] * (1 - left) - depth)
        median = torch.where((alpha > 0) & (left > 0.5), centre[2], median)
        depth, left = depth + weight * centre[2], left * (1 - alpha)
        colour = colour + weight[..., None] * values["colors"][i]
        normals = normals + weight[..., None] * (-normal if normal @ centre > 0 else normal)
    return colour, 1 - left, normals @ pose[:3, :3], distort, depth, median


@pytest.mark.parametrize(("packed", "rasterizer"), [(False, "eager"), (True, "reference")])
def test_discs_are_where_rays_meet_them(packed, rasterizer):
    values, views = discs(70), two_views()
    words = {"packed": packed, "rasterizer": rasterizer, "render_mode": "RGB+D", "distloss": True}
    image, alpha, normals, surface, distort, median, meta = rasterization_2dgs(**values, **views, **words)
    of_median = rasterization_2dgs(**values, **views, **words, depth_mode="median")[3]
    for camera, eye in enumerate(EYES):
        assert surface[camera].equal(normals_of_depth(image[camera, ..., 3:], make_camera(eye, SIZE)))
        assert of_median[camera].equal(normals_of_depth(median[camera], make_camera(eye, SIZE)))
        results = image[camera, ..., :3], alpha[camera], normals[camera], distort[camera], image[camera, ..., 3:]
        for ours, twin in zip((*results, median[camera]), drawn_by_rays(values, views, camera), strict=True):
            torch.testing.assert_close(ours, twin.view(ours.shape), rtol=0, atol=1e-9)
    assert meta["render_distort"] is distort
    assert (distort.amax(dim=(1, 2)) > 0.03).all()
    plain = rasterization_2dgs(**values, **views, packed=packed, rasterizer=rasterizer)
    assert plain[3] is None
    assert (plain[4] == 0).all()
    assert plain[0].equal(image[..., :3])


def test_the_median_may_lie_behind_many_faint_discs():
    values, view = gaussians(40), cameras([make_camera((0.0, -3.0, 0.0), (7, 7))])
    values |= {"opacities": torch.full((40,), 0.03, dtype=F64), "scales": torch.ones(40, 3, dtype=F64)}
    values["means"] = torch.stack([torch.zeros(40), torch.linspace(-1, 1, 40), torch.zeros(40)], dim=1).to(F64)
    values["quats"][:] = torch.tensor([1.0, 1.0, 0.0, 0.0])  # across the line of sight
    median = rasterization_2dgs(**values, **view, rasterizer="eager")[5]
    behind_half = next(n for n in range(40) if 0.97**n <= 0.5)
    torch.testing.assert_close(median[0, 3, 3, 0], values["means"][behind_half - 1, 1] + 3)


def test_ray_transforms_and_normals_equal_gsplats():
    theirs = pytest.importorskip("gsplat.cuda._torch_impl_2dgs", reason="the package gsplat is not installed")
    values, views = discs(200), unusual_views(5)
    meta = rasterization_2dgs(**values, **views, rasterizer=Nothing())[-1]
    tensors = [values[name] for name in INPUTS[:3]]
    projected = theirs._fully_fused_projection_2dgs(*tensors, views["viewmats"], views["Ks"], *WIDE)
    shown = (meta["radii"] > 0).all(dim=2)
    assert shown.sum() > 200
    names = ("radii", "depths", "ray_transforms", "normals")
    for name, expected in zip(names, (projected[0], *projected[2:]), strict=True):
        if name == "normals":
            expected = torch.nn.functional.normalize(expected, dim=-1)
        torch.testing.assert_close(meta[name][shown].to(expected.dtype), expected[shown], msg=name)
    in_front = (projected[3][..., 2, :2].norm(dim=2) < projected[2]) & (projected[0] > 0).all(dim=2)
    assert (shown == in_front).all()


def test_normals_of_a_depth_image_are_those_of_its_plane():
    view = replace(make_camera(EYES[1], SIZE), fy=70.0)
    normal = torch.tensor([0.2, -0.3, -0.9], dtype=F64)
    normal = normal / normal.norm()
    y, x = torch.meshgrid(*(torch.arange(side, dtype=F64) + 0.5 for side in SIZE[::-1]), indexing="ij")
    slopes = (x - view.cx) / view.fx * normal[0] + (y - view.cy) / view.fy * normal[1] + normal[2]
    normals = normals_of_depth((-3 / slopes)[..., None], view)
    expected = (normal @ view.cam_from_world[:3, :3].to(F64)).expand(SIZE[1] - 2, SIZE[0] - 2, 3)
    torch.testing.assert_close(normals[1:-1, 1:-1], expected)
    assert (normals[0] == 0).all()


@pytest.mark.parametrize("depth_mode", ["expected", "median"])
def test_gradients_of_discs_equal_finite_differences(depth_mode):
    values, views = discs(8) | {"backgrounds": torch.rand(1, 3, dtype=F64)}, small_views(EYES[0])
    leaves = values | {"viewmats": views.pop("viewmats")}

    def draw(**given: Tensor) -> Tensor:
        words = {"render_mode": "RGB+ED", "distloss": True, "depth_mode": depth_mode}
        *results, _ = rasterization_2dgs(**given, **views, **words)
        assert results[3].shape == (6, 8, 3), "gsplat leaves out the dimension of one camera"
        return torch.cat([x.view(6, 8, -1) for x in results], dim=2)

    assert has_gradients(draw, leaves)


@pytest.mark.parametrize("packed", [False, True])
def test_gradient_of_a_disc_is_that_of_its_move_across_the_image(packed):
    values, views = discs(), two_views()
    values["means"].requires_grad_()
    image, *_, meta = rasterization_2dgs(**values, **views, packed=packed)
    loss = (image * torch.rand_like(image)).sum()
    moves, transforms = torch.autograd.grad(loss, [meta["gradient_2dgs"], meta["ray_transforms"]], retain_graph=True)
    torch.testing.assert_close(moves, transforms[..., :2, 2] * meta["depths"][..., None])
    assert moves.abs().max() > 0
    assert torch.autograd.grad(loss, meta["means2d"])[0].abs().max() > 0


@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_odd_discs_have_finite_images_and_gradients(dtype, caplog):
    """Their distortion is drawn in float64, but only what the caller chose is told to be slow."""
    rasterizer_of.cache_clear()
    values, view = discs(), cameras([make_camera((0.0, -3.0, 0.0), SIZE)])
    values["means"][:4] = torch.tensor([[0.0, 0.0, 0.0], [0.4, 0.0, 0.0], [0.0, -2.9, 0.0], [0.0, 9.0, 0.0]])
    values["quats"][:4], values["opacities"][4] = torch.tensor([1.0, 0.0, 0.0, 0.0]), 0.0  # flat before the camera
    values["scales"][5:8], values["scales"][8, 0], values["scales"][9, 0] = 0.0, 0.0, 1e4
    values, view = ({n: x.to(dtype) if isinstance(x, Tensor) else x for n, x in d.items()} for d in (values, view))
    leaves = [x.requires_grad_() for x in values.values()]
    *results, meta = rasterization_2dgs(**values, **view, render_mode="RGB+ED", distloss=True)
    assert meta["radii"][0, 0].min() == 1, "this disc should be seen from its edge"
    assert ("float64 is drawn eagerly" in caplog.text) == (dtype is F64)
    for gradient in torch.autograd.grad(sum(x.square().sum() for x in results), leaves):
        assert gradient.isfinite().all()
    values["means"] = values["means"] - 100  # out of sight
    *results, meta = rasterization_2dgs(**values, **view, render_mode="RGB+ED", distloss=True)
    assert all((x == 0).all() for x in results)


# ------------------------------------------------------------------------------------------------ layouts and batches


def test_packed_and_unpacked_tables_hold_the_same():
    values, views = gaussians(), two_views()
    values["means"][0] += 100  # out of sight
    image, alpha, packed = rasterization(**values, **views)
    others = rasterization(**values, **views, packed=False)
    torch.testing.assert_close((image, alpha), others[:2])
    meta, at = others[2], (packed["camera_ids"], packed["gaussian_ids"])
    assert meta.keys() == packed.keys()
    for name in ("radii", "means2d", "depths", "conics", "opacities"):
        torch.testing.assert_close(packed[name], meta[name][at])
    assert meta["means2d"].shape == (2, 40, 2)
    assert (meta["radii"][:, 0] == 0).all()
    assert [meta[name] for name in ("batch_ids", "camera_ids", "gaussian_ids")] == [None] * 3
    assert (meta["n_batches"], meta["n_cameras"], meta["width"], meta["height"]) == (1, 2, *SIZE)
    assert packed["radii"].dtype == torch.int32


def test_cameras_may_have_colours_of_their_own():
    values, views = gaussians(), two_views()
    colors = torch.rand(2, 40, 3, dtype=F64)
    image, _, _ = rasterization(**values | {"colors": colors}, **views)
    for camera in range(2):
        other, _, _ = rasterization(**values | {"colors": colors[camera]}, **views)
        torch.testing.assert_close(image[camera], other[camera])


@pytest.mark.parametrize(
    ("packed", "lens"), [*product((True, False), [None]), *zip((True, False) * 2, LENSES, strict=True)]
)
def test_batches_of_scenes_are_drawn_one_by_one(packed, lens):
    scenes, views = [gaussians(seed=seed) for seed in (1, 2)], two_views()
    together = {name: torch.stack([scene[name] for scene in scenes]) for name in scenes[0]}
    poses = {name: views[name].expand(2, *views[name].shape) for name in ("viewmats", "Ks")}
    words = lens_words(lens, 2, 2) if lens else {}
    own_words = [dict(words), dict(words)]
    for key, x in words.items():
        if isinstance(x, Tensor):  # each image has a lens of its own
            words[key] = x * torch.tensor([[1, 0.5], [0, -0.2]], dtype=F64)[..., None]
            for own, part in zip(own_words, words[key], strict=True):
                own[key] = part
    image, alpha, meta = rasterization(**together, **views | poses | words, packed=packed)
    assert alpha.shape == (2, 2, SIZE[1], SIZE[0], 1)
    assert meta["n_batches"] == 2
    for i, scene in enumerate(scenes):
        alone, _, own = rasterization(**scene, **views, **own_words[i], packed=packed)
        torch.testing.assert_close(image[i], alone)
        part = meta["means2d"][meta["batch_ids"] == i] if packed else meta["means2d"][i]
        torch.testing.assert_close(part, own["means2d"])


def test_planes_and_radii_leave_splats_out():
    values, views = gaussians(), two_views()
    depths, radii = (rasterization(**values, **views, packed=False)[2][name] for name in ("depths", "radii"))
    for words, kept in (
        ({"near_plane": 3.0}, depths > 3),
        ({"far_plane": 3.0}, (depths > 0) & (depths < 3)),
        ({"radius_clip": 4.0}, (radii > 4).any(dim=2)),
    ):
        meta = rasterization(**values, **views, packed=False, **words)[2]
        assert ((meta["radii"] > 0).all(dim=2) == kept).all(), words
        assert 0 < kept.sum() < kept.numel()


def test_order_and_depth_may_be_by_distance():
    values, views = gaussians(), two_views()
    by_z, by_distance = (rasterization(**values, **views, global_z_order=z, render_mode="RGB+D") for z in (True, False))
    meta = by_distance[2]
    offsets = values["means"][meta["gaussian_ids"]] - torch.tensor(EYES, dtype=F64)[meta["camera_ids"]]
    torch.testing.assert_close(meta["depths"], offsets.norm(dim=1))
    assert (by_z[2]["depths"] < meta["depths"]).all()
    assert (by_z[0][..., 3] <= by_distance[0][..., 3]).all()
    assert (by_z[0][..., :3] != by_distance[0][..., :3]).any(), "the order should matter here"


def test_masked_pixels_are_black():
    values, views, masks = gaussians(), two_views(), torch.rand(2, *SIZE[::-1]) < 0.5
    values["means"].requires_grad_()
    words = {"render_mode": "RGB+D", "backgrounds": torch.ones(2, 3, dtype=F64)}
    image, alpha, _ = rasterization(**values, **views, **words, masks=masks)
    expected, expected_alpha, _ = rasterization(**values, **views, **words)
    expected[~masks] = 0  # as gsplat's trainer does
    assert image.equal(expected)
    assert alpha.equal(expected_alpha)
    by_ours, by_trainer = (torch.autograd.grad(x.sum(), values["means"])[0] for x in (image, expected))
    torch.testing.assert_close(by_ours, by_trainer)


LIKE_DEFAULTS = {  # values that ask for what gsplat does by default
    "distributed": None, "sparse_grad": None, "tile_size": None, "with_ut": None, "with_eval3d": False,
    "radial_coeffs": torch.zeros(2, 6), "tangential_coeffs": torch.zeros(2, 2), "thin_prism_coeffs": torch.zeros(2, 4),
    "macro_tile": True,
    "rolling_shutter": Enum("RollingShutterType", ["GLOBAL"]).GLOBAL, "extra_signals": None, "renderer_config": None,
}  # fmt: skip


def test_arguments_that_ask_for_the_default_are_taken_and_depth_needs_no_colours():
    values, views = gaussians(), two_views()
    expected, _, _ = rasterization(**values, **views)
    assert rasterization(**values, **views, **LIKE_DEFAULTS)[0].equal(expected)
    depth, _, _ = rasterization(**values, **views, render_mode="ED")  # needs no colours
    assert rasterization(**values | {"colors": None}, **views, sh_degree=1, render_mode="ED")[0].equal(depth)


@pytest.mark.parametrize("function", [rasterization, rasterization_2dgs])
def test_autocast_changes_nothing(function):
    values, views = gaussians(dtype=torch.float32, degree=1), two_views(torch.float32)
    expected, *_ = function(**values, **views, sh_degree=1, render_mode="RGB+ED")
    with torch.autocast("cpu"):
        assert function(**values, **views, sh_degree=1, render_mode="RGB+ED")[0].equal(expected)


# ---------------------------------------------------------------------------------------------------------- gradients


GIVEN = [("scales", True), ("covars", False), ("matched", True), *((lens, False) for lens in LENSES)]


@pytest.mark.parametrize(("given", "packed"), GIVEN)
def test_gradients_equal_finite_differences(given, packed):
    values, views = gaussians(8, degree=1) | {"backgrounds": torch.rand(2, 3, dtype=F64)}, small_views(*EYES)
    fixed = {"packed": packed, "render_mode": "RGB+ED", "rasterize_mode": "antialiased", "sh_degree": 1}
    if given == "matched":
        fixed |= {"rasterize_mode": "matched", "relative_rate": 0.5}
    fixed |= lens_words(given, 2) if given in LENSES else {}
    if given == "covars":
        values |= {"covars": covariances(values.pop("quats"), values.pop("scales"))}
        fixed |= {"quats": None, "scales": None}
    leaves = values | {"viewmats": views.pop("viewmats")}
    assert has_gradients(lambda **given: rasterization(**given, **views, **fixed)[:2], leaves)


@pytest.mark.parametrize("lens", [None, "fisheye"])
def test_opaque_transparent_flat_and_unturned_gaussians_have_finite_gradients(lens):
    values, views = gaussians(), two_views() | (lens_words(lens, 2) if lens else {})
    values["opacities"][0], values["opacities"][1] = 0.0, 1.0
    values["scales"][2] = 0.0
    values["scales"][3, 0] = 0.0
    values["quats"][4] = 0.0
    leaves = [x.requires_grad_() for x in (*values.values(), views["viewmats"])]
    image, _, _ = rasterization(**values, **views, rasterize_mode="antialiased")
    for gradient in torch.autograd.grad(image.square().sum(), leaves):
        assert gradient.isfinite().all()


@pytest.mark.parametrize(("function", "dtype"), [(rasterization, torch.float32), (rasterization_2dgs, F64)])
def test_gradients_have_no_gradients_and_say_so(function, dtype):
    values, views = gaussians(12, dtype), two_views(dtype)
    means = values["means"].requires_grad_()
    image, *_ = function(**values, **views)
    (gradient,) = torch.autograd.grad(image.square().sum(), means, create_graph=True)
    penalty = gradient.square().sum() + means.square().sum()  # the second of which has a gradient of its own
    for differentiate in (lambda: torch.autograd.grad(penalty, means, retain_graph=True), lambda: penalty.backward()):
        with pytest.raises(UsageError, match="gradient of a render is not known: kernels are differentiated once"):
            differentiate()


@pytest.mark.parametrize(
    ("packed", "lens", "mode"), [(True, None, "RGB"), (False, "fisheye", "RGB"), (False, None, "RGB+ED")]
)
def test_absolute_gradients_are_summed_over_pixels(monkeypatch, packed, lens, mode):
    values, views = gaussians(12), cameras([make_camera(eye, (4, 2)) for eye in EYES])
    views |= {"packed": packed, "render_mode": mode, "absgrad": True} | (lens_words(lens, 2) if lens else {})
    with monkeypatch.context() as plain:  # as compiled kernels draw it
        plain.setattr("aaplug.gsplat.drop_in.AbsolutePoint", None)
        image, alpha, meta = rasterization(**values, **views)
    assert not image.requires_grad
    values["means"].requires_grad_()
    image, alpha, meta = rasterization(**values, **views)
    means2d = meta["means2d"]
    weights = torch.rand(image.shape[-1] + 1, dtype=F64) - 0.5
    parts = (torch.cat([image, alpha], dim=-1) * weights).sum(dim=-1).flatten()
    expected = sum(torch.autograd.grad(part, means2d, retain_graph=True)[0].abs() for part in parts)
    means2d.absgrad.zero_()
    parts.sum().backward()
    torch.testing.assert_close(means2d.absgrad, expected)


# ----------------------------------------------------------------------------------------------------------- training


def training() -> tuple[dict[str, Parameter], dict[str, Optimizer], Callable[..., tuple[Tensor, dict[str, object]]]]:
    """Parameters as gsplat's trainer holds them, their optimizers, and what gives one view's loss and `meta`."""
    torch.manual_seed(0)  # gsplat's densification draws numbers
    truth, start = (make_scene(60, seed=seed) for seed in (1, 2))
    splats = {"means": start.means, "quats": start.quats, "scales": start.log_scales}
    splats |= {"opacities": start.logit_opacities, "sh0": start.sh[:, :1], "shN": start.sh[:, 1:]}
    params = {name: Parameter(value) for name, value in splats.items()}
    view = cameras([make_camera((0.0, -3.0, 0.5), (24, 20))], torch.float32)
    shapes = truth.means, truth.quats, truth.scales, truth.opacities
    photograph, *_ = rasterization(*shapes, truth.sh, **view, sh_degree=1)

    def draw(**words: object) -> tuple[Tensor, dict[str, object]]:
        activated = params["means"], params["quats"], params["scales"].exp(), params["opacities"].sigmoid()
        colours = torch.cat([params["sh0"], params["shN"]], dim=1)
        image, _, info = rasterization(*activated, colours, **view, sh_degree=1, **words)
        return (image - photograph).abs().mean(), info

    return params, {name: torch.optim.Adam([value], lr=1e-2) for name, value in params.items()}, draw


def trained(name: str, steps: int, drawing: dict[str, object], **settings: object) -> dict[str, Parameter]:
    """Parameters after some steps by a strategy of gsplat's own, which lower the loss."""
    strategies = pytest.importorskip("gsplat.strategy", reason="the package gsplat is not installed")
    strategy = getattr(strategies, name)(refine_start_iter=2, refine_every=2, **settings)
    params, optimizers, draw = training()
    strategy.check_sanity(params, optimizers)
    after = {"lr": 1e-6} if name == "MCMCStrategy" else {"packed": drawing["packed"]}
    with torch.no_grad():
        params["opacities"][:5] = -5.0  # dead, and so relocated or pruned
    state, losses = strategy.initialize_state(), []
    with patch():
        for step in range(steps):
            loss, info = draw(**drawing)
            if name == "DefaultStrategy":
                strategy.step_pre_backward(params, optimizers, state, step, info)
            loss.backward()
            for optimizer in optimizers.values():
                optimizer.step()
                optimizer.zero_grad()
            strategy.step_post_backward(params, optimizers, state, step, info, **after)
            losses.append(loss.item())
    assert losses[-1] < losses[0]
    return params


@pytest.mark.parametrize(("packed", "absgrad"), [(True, False), (False, True)])
def test_gsplats_own_densification_reads_meta(packed, absgrad):
    settings = {"grow_grad2d": 1e-6, "absgrad": absgrad, "refine_scale2d_stop_iter": 9}
    assert len(trained("DefaultStrategy", 6, {"packed": packed, "absgrad": absgrad}, **settings)["means"]) > 60


def test_gsplats_own_markov_chain_runs():
    params = trained("MCMCStrategy", 8, {}, cap_max=64, min_opacity=0.2)
    assert len(params["means"]) == 64
    assert (params["opacities"].sigmoid() > 0.19).all()


def test_gsplats_own_selective_adam_moves_visible_gaussians_alone():
    optimizers = pytest.importorskip("gsplat.optimizers", reason="the package gsplat is not installed")
    values, visible = torch.randn(3, 5, 2, dtype=F64), torch.tensor([True, False, True, True, False])
    param = torch.nn.Parameter(values[0].clone())
    optimizer = optimizers.SelectiveAdam([{"params": [param], "lr": 0.1}], eps=1e-3, betas=(0.8, 0.9))
    first = second = torch.zeros(5, 2, dtype=F64)
    expected = values[0]
    with patch():
        for gradient in values[1:]:
            param.grad = gradient
            optimizer.step(visible)
            first, second = 0.8 * first + 0.2 * gradient, 0.9 * second + 0.1 * gradient**2
            expected = torch.where(visible[:, None], expected - 0.1 * first / (second.sqrt() + 1e-3), values[0])
    torch.testing.assert_close(param.detach(), expected)


@pytest.mark.parametrize("copies", [1, 2, 7, 51])
def test_relocated_copies_look_like_one(copies):
    opacities, scales = torch.tensor([0.01, 0.5, 0.99, 1.0]), torch.rand(4, 3)
    counts = torch.tensor([copies, copies, copies, copies + 100 * (copies == 51)])
    new, wide = compute_relocation(opacities, scales, counts, torch.zeros(51, 51))
    column, same = compute_relocation(opacities[:, None], scales, counts, torch.zeros(51, 51))  # as of nerfstudio
    assert (column.equal(new[:, None]), same.equal(wide)) == (True, True)
    for old, o, factor in zip(opacities.tolist(), new.tolist(), (wide / scales).mean(dim=1).tolist(), strict=True):
        assert 1 - (1 - o) ** copies == pytest.approx(old, rel=1e-5)
        o = 1 - (1 - min(old, 1 - 2**-23)) ** (1 / copies)
        double_sum = sum(  # eq. 9
            Fraction(math.comb(i - 1, k) * (-1) ** k) * Fraction(o) ** (k + 1) / Fraction(math.sqrt(k + 1))
            for i in range(1, copies + 1)
            for k in range(i)
        )
        assert factor == pytest.approx(old / float(double_sum), rel=1e-5)


def test_covariances_and_their_inverses():
    quats, scales = torch.randn(5, 2, 4, dtype=F64), 0.5 + torch.rand(5, 2, 3, dtype=F64)
    sigma, inverse = quat_scale_to_covar_preci(quats, scales)
    torch.testing.assert_close(sigma[:, 1], covariances(quats[:, 1], scales[:, 1]))
    torch.testing.assert_close(inverse, torch.linalg.inv(sigma))
    triangle, nothing = quat_scale_to_covar_preci(quats, scales, compute_preci=False, triu=True)
    xx, xy, xz, yy, yz, zz = triangle.unbind(dim=-1)
    torch.testing.assert_close(torch.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], dim=-1).unflatten(-1, (3, 3)), sigma)
    assert nothing is None


@pytest.mark.parametrize("degree", range(5))
def test_harmonics_equal_gsplats(reference, degree):
    dirs, coefficients = (torch.randn(2, 7, *shape, dtype=F64, requires_grad=True) for shape in ((3,), (25, 3)))
    ours, theirs = (f(degree, dirs, coefficients) for f in (spherical_harmonics, reference._spherical_harmonics))
    torch.testing.assert_close(ours, theirs)
    weights = torch.randn(2, 7, 3, dtype=F64)
    words = {"allow_unused": True, "materialize_grads": True}
    gradients = [torch.autograd.grad((x * weights).sum(), [dirs, coefficients], **words) for x in (ours, theirs)]
    torch.testing.assert_close(*gradients)
    masks = torch.rand(2, 7) < 0.5
    holes = coefficients.where(masks[..., None, None], math.nan)
    assert spherical_harmonics(degree, dirs, holes, masks=masks).equal(ours * masks[..., None])
    with pytest.raises(UsageError, match=rf"^degrees_to_use: {degree} needs {(degree + 1) ** 2} coefficients"):
        spherical_harmonics(degree, dirs, coefficients[..., : (degree + 1) ** 2 - 1, :])


# ------------------------------------------------------------------------------------------------ programs of gsplat's


@pytest.fixture
def homes(stand_in) -> dict[str, ModuleType]:
    """Modules of gsplat's names, as if it were installed, whose functions do nothing."""
    stand_in("gsplat", __path__=[], __version__="1.10.0")
    return {
        home: stand_in(home, **{ours.__name__: lambda: None for ours in functions})
        for home, functions in REPLACED.items()
    }


def test_patch_replaces_functions_wherever_they_are_held_until_it_is_closed(stand_in, homes):
    theirs = homes["gsplat.rendering"].rasterization
    trainer = stand_in("trainer", draw=theirs, rasterization=rasterization)
    with patch():
        patch().close()  # which changed nothing, and so puts nothing back
        for home, functions in REPLACED.items():
            for ours in functions:
                assert getattr(homes[home], ours.__name__) is ours
        assert trainer.draw is rasterization
    assert homes["gsplat.rendering"].rasterization is trainer.draw is theirs
    assert trainer.rasterization is rasterization


@pytest.mark.parametrize(
    ("missing", "said"), [("module", "gsplat.rendering"), ("function", "rasterization"), ("version", "this is 1.4.0")]
)
def test_patch_says_what_it_needs(monkeypatch, homes, missing, said):
    if missing == "module":
        monkeypatch.setitem(sys.modules, "gsplat.rendering", None)
    elif missing == "function":
        del homes["gsplat.rendering"].rasterization
    else:  # whose strategies read one radius for each splat, and would fail in training
        monkeypatch.setattr(sys.modules["gsplat"], "__version__", "1.4.0")
    with pytest.raises(UsageError, match=rf"^patch: expected gsplat 1.5 or newer \(`pip install [^`]*1.5.*{said}"):
        patch()


# ----------------------------------------------------------------------------------------------------------- mistakes

ORTHO, FISHEYE = ({"camera_model": model} for model in ("ortho", "fisheye"))
WRONG = {  # "[*b" stands for a tensor of floats
    "scales: expected torch.float64, as means have, got torch.float32": {"scales": torch.ones(40, 3)},
    "means: expected [*b, n, 3], got float32 [40, 2]": {"means": torch.zeros(40, 2)},
    "quats: expected [*b, n, 4] or None, got float32 [3, 4], n = 40": {"quats": torch.ones(3, 4)},
    "scales: expected [*b, n, 3] or None, got float32 [40], n = 40": {"scales": torch.ones(40)},
    "quats: expected [*b, n, 4] or None, got float64 [40, 4], *b = [2], n = 40": {"means": torch.zeros(2, 40, 3)},
    "opacities: expected [*b, n], got float32 [40, 1], n = 40": {"opacities": torch.ones(40, 1)},
    "colors: expected shape [40, 3], got [39, 3]": {"colors": torch.ones(39, 3)},
    "colors: expected shape [2, 40, 3], got [3, 40, 3]": {"colors": torch.ones(3, 40, 3)},
    "colors: expected shape [40, 9, 3], got [40, 9, 4]": {"colors": torch.ones(40, 9, 4), "sh_degree": 2},
    "sh_degree: 3 needs 16 coefficients, colors has 9": {"colors": torch.ones(40, 9, 3), "sh_degree": 3},
    "colors: expected a tensor [*b, n, d], got float64 [40]": {"colors": torch.ones(40, dtype=F64)},
    "colors: expected a tensor [*b, n, k, 3] for sh_degree 0, got float64 [40, 3]": {"sh_degree": 0},
    "viewmats: expected [*b, c, 4, 4], got float32 [2, 3, 4]": {"viewmats": torch.zeros(2, 3, 4)},
    "Ks: expected [*b, c, 3, 3], got float32 [1, 3, 3], c = 2": {"Ks": torch.eye(3)[None]},
    "viewmats: expected a tensor": {"viewmats": torch.eye(4)},
    "viewmats: expected cameras": {"viewmats": torch.zeros(0, 4, 4), "Ks": torch.zeros(0, 3, 3)},
    "viewmats: expected matrices that can be inverted": {"viewmats": torch.zeros(2, 4, 4)},
    "Ks: expected finite numbers": {"Ks": torch.full((2, 3, 3), math.nan)},
    "width: expected an integer": {"width": 4.5},
    "opacities: expected [*b, n], got float16 [40]": {"opacities": torch.ones(40).half()},
    "means: expected [*b, n, 3], got sparse_coo float32 [40, 3]": {"means": torch.ones(40, 3).to_sparse()},
    "Ks: expected fx, 0, cx; 0, fy, cy; 0, 0, 1": {"Ks": torch.ones(2, 3, 3)},
    "backgrounds: expected [*b, c, d] or None, got float32 [3], c = 2": {"backgrounds": torch.ones(3)},
    "covars: expected quats and scales, or covars": {"quats": None},
    "covars: expected [*b, n, 3, 3] or None, got float32 [40, 6], n = 40": {"covars": torch.ones(40, 6)},
    "render_mode: 'RGBD' is not one of RGB, D, ED, RGB+D, RGB+ED": {"render_mode": "RGBD"},
    "rasterize_mode: 'mip' is not one of classic, antialiased, matched": {"rasterize_mode": "mip"},
    "near_plane: expected a number above 0, got 0.0": {"near_plane": 0.0},
    "width: expected an integer from 1 to 2.14748e+09, got 0": {"width": 0},
    "width: 200000x200000 would take 1280.0 GB, more than": {"width": 200_000, "height": 200_000},
    "eps2d: expected a number from 0 to 1e+06, got -0.1": {"eps2d": -0.1},
    "eps2d: expected a number from 0 to 1e+06, got inf": {"eps2d": math.inf},
    "max_alpha: expected a number above 0.00392157 to 0.999999, got 1.0": {"max_alpha": 1.0},
    "max_alpha: expected a number above 0.00392157 to 0.999999, got -1": {"max_alpha": -1},
    'relative_rate: belongs to rasterize_mode="matched", which needs it': {"rasterize_mode": "matched"},
    "relative_rate: expected shape [2], got [3]": {"rasterize_mode": "matched", "relative_rate": torch.ones(3)},
    "relative_rate: expected finite numbers above 0, got -1.0": {"rasterize_mode": "matched", "relative_rate": -1.0},
    "relative_rate: expected finite numbers above 0, got inf": {"rasterize_mode": "matched", "relative_rate": math.inf},
    "camera_model: 'ftheta' is not one of pinhole, ortho, fisheye": {"camera_model": "ftheta"},
    "distributed: only False is supported": {"distributed": True},
    "sparse_grad: only False is supported": {"sparse_grad": True},
    "with_eval3d: only False is supported": {"with_eval3d": True},
    "ftheta_coeffs: only None is supported on the CPU, got float32 [3]": {"ftheta_coeffs": torch.ones(3)},
    "radial_coeffs: expected shape [2, 6], got [2, 4]": {"radial_coeffs": torch.ones(2, 4)},
    "radial_coeffs: expected shape [2, 4], got [2, 6]": FISHEYE | {"radial_coeffs": torch.ones(2, 6)},
    "radial_coeffs: expected finite numbers, got NaN": {"radial_coeffs": torch.full((2, 6), math.nan)},
    "radial_coeffs: camera_model ortho has none, got float32 [2, 6]": ORTHO | {"radial_coeffs": torch.ones(2, 6)},
    "tangential_coeffs: expected [*b, c, 2] or None": {"tangential_coeffs": torch.ones(2)},
    "thin_prism_coeffs: camera_model fisheye has none, got float32 [2, 4]": FISHEYE
    | {"thin_prism_coeffs": torch.ones(2, 4)},
    "rolling_shutter: only GLOBAL is supported on the CPU, got 'TOP'": {"rolling_shutter": Enum("Rows", ["TOP"]).TOP},
    "viewmats_rs: only None is supported": {"viewmats_rs": torch.zeros(2, 4, 4)},
    "colors: expected colours for render_mode RGB, got None": {"colors": None},
    "masks: expected shape [2, 28, 40], got [2, 4, 5]": {"masks": torch.ones(2, 4, 5, dtype=torch.bool)},
    "heliocentric: is not an argument of this function of gsplat's": {"heliocentric": 1},
    "rasterizer: 'cuda' is not one of auto, compiled, eager, reference": {"rasterizer": "cuda"},
    "absgrad: rasterizer reference sums no absolute gradients": {"absgrad": True, "rasterizer": "reference"},
}


WRONG_FOR_DISCS = {
    "width: 200000x200000 would take 1280.0 GB, more than": {"width": 200_000, "height": 200_000},
    "depth_mode: 'mean' is not one of expected, median": {"depth_mode": "mean"},
    "absgrad: only False is supported": {"absgrad": True},
    "quats: expected a tensor": {"quats": None},
    "covars: is not an argument": {"covars": torch.zeros(40, 3, 3)},
    "rasterizer: 'cuda' is not one of auto, compiled, eager, reference": {"rasterizer": "cuda"},
}
WRONG_CALLS = [(rasterization, *item) for item in WRONG.items()]
WRONG_CALLS += [(rasterization_2dgs, *item) for item in WRONG_FOR_DISCS.items()]


@pytest.mark.parametrize(("function", "message", "wrong"), WRONG_CALLS)
def test_what_is_wrong_or_not_supported_is_said(function, message, wrong):
    with pytest.raises(UsageError) as error:
        function(**gaussians() | two_views() | wrong)
    message = re.sub(r"expected \[(\*b[^]]*)\]", r"expected a tensor [\1] of float32 or float64", message)
    assert str(error.value).startswith(message)


@pytest.mark.parametrize(("dtype", "device"), [(F64, "cpu"), (torch.float32, "cuda")])
def test_nothing_is_compiled_for_tensors_that_no_kernel_takes(dtype, device, caplog):
    assert rasterizer_of.__wrapped__("auto", dtype, device) is RASTERIZERS["eager"]
    assert "drawn eagerly" in caplog.text


@pytest.mark.parametrize(("dtype", "later"), [(F64, ""), (torch.float32, ", and compiles it meanwhile")])
def test_compiled_is_never_eager_without_a_word(monkeypatch, dtype, later):
    monkeypatch.setattr("aaplug.gsplat.drawing.find_rasterizer", lambda name, frames, gradients: Tiled(EAGER))
    monkeypatch.setattr("aaplug.gsplat.drop_in.rasterizer_of", rasterizer_of.__wrapped__)
    call, problem = gaussians(dtype=dtype) | two_views(dtype), f"is compiled for {str(dtype)[6:]} "
    with pytest.raises(UsageError, match=rf"^rasterizer: no kernel 'composite-point' {problem}.*\beagerly{later}$"):
        rasterization(**call, rasterizer="compiled")
    rasterization(**call, rasterizer="auto")
