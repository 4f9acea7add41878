"""Laws of every rasterizer: those of the registry, plug-ins among them, and the compiled one.

Of scenes with values that no training makes, every one leaves out such a Gaussian, or an error names it.
"""

import math
from dataclasses import replace

import pytest
import torch

from aaplug import RECIPES, Camera, Gaussians, Render, Renderer, Splats2D, TrainingViews, UsageError
from aaplug.core.splats import concatenated
from tests.conftest import ALL_RASTERIZERS, make_camera, make_scene, make_splats, shuffled, splats_of

HW = (29, 43)
SKY = (0.25, 0.5, 1.0)


@pytest.fixture
def splats() -> Splats2D:
    """Splats of distinct depths from 2 to 3."""
    splats = make_splats(150, HW, seed=1)
    order = torch.randperm(150, generator=torch.Generator().manual_seed(2))
    return replace(splats, depths=2 + order / 150)


def one(
    mean: tuple[float, float] = (20.5, 12.5),
    covariance: tuple[float, float, float] = (9.0, 0.0, 9.0),
    opacity: float = 0.5,
    det: float | None = None,
) -> Splats2D:
    splat = splats_of((mean, covariance, 1.0, opacity, (1.0, 0.5, 0.25))).to(torch.float32)
    return splat if det is None else replace(splat, dets=torch.tensor([det]))


def assert_same(image: Render, other: Render) -> None:
    torch.testing.assert_close(image, other, rtol=0, atol=1e-6)  # the order of a sum may change


def test_splats_behind_an_opaque_wall_change_nothing(rasterize, splats):
    wall = concatenated([one(covariance=(1e8, 0.0, 1e8), opacity=1.0)] * 3)
    before = rasterize(concatenated([wall, splats]), HW, SKY)
    hidden = make_splats(100, HW, seed=7)
    hidden = replace(hidden, depths=hidden.depths + 1.5, rgb=hidden.rgb * 100)
    assert_same(rasterize(shuffled(concatenated([wall, splats, hidden])), HW, SKY), before)
    assert_same(rasterize(wall, HW, SKY), before)


@pytest.mark.parametrize("name", ["means", "covs", "opacities", "rgb"])
def test_an_image_without_splats_can_be_differentiated_too(rasterize, splats, name):
    leaf = getattr(splats, name)[:0].requires_grad_()
    rgb, alpha = rasterize(replace(splats[:0], **{name: leaf}), HW, SKY)
    (rgb.sum() + alpha.sum()).backward()
    assert leaf.grad is not None


def outside(distance: float) -> Splats2D:
    """Opaque splats so many px off the image; one with sigma 0.6 px ends at 2 px."""
    middle, ways = torch.tensor([HW[1], HW[0]]) / 2, ((-1, 0), (1, 0), (0, -1), (0, 1), (1, 1), (-1, -1))
    means = (middle + torch.tensor(ways) * (middle + distance)).tolist()
    return splats_of(*[(mean, (0.36, 0.1, 0.36), 1.0, 1.0, (100.0,) * 3) for mean in means]).to(torch.float32)


def faint(opacity: float) -> Splats2D:
    ghosts = make_splats(40, HW, seed=8)
    return replace(ghosts, opacities=torch.full((40,), opacity), rgb=ghosts.rgb * 100)


UNSEEN = {f"{distance:g} px outside": outside(distance) for distance in (3.0, 100.0, 1e5, 1e9)}
UNSEEN |= {f"opacity {opacity:g}": faint(opacity) for opacity in (0.0, 1e-40, 1e-9, 0.9999 / 255)}


@pytest.mark.parametrize("unseen", UNSEEN)
def test_splats_that_cannot_be_seen_change_nothing(rasterize, splats, unseen):
    assert_same(rasterize(shuffled(concatenated([UNSEEN[unseen], splats])), HW, SKY), rasterize(splats, HW, SKY))


POISON = {
    "a denormal opacity": one(opacity=1e-40),
    "opacity 0": one(opacity=0.0),
    "opacity 1/255": one(opacity=1 / 255),
    "opacity 1": one(opacity=1.0),
    "a million px": one(covariance=(1e12, 0.0, 1e12)),
    "a million px, seen from afar": one((1e6, -1e6), (1e12, 0.0, 1e12)),
    "a needle of a million px": one(covariance=(1e12, 0.0, 0.3)),
    "a denormal covariance": one(covariance=(1e-22, 0.0, 1e-22), det=1e-44),
    "a denormal width": one(covariance=(1.0, 0.0, 1e-40), det=1e-40),
    "a denormal width, between pixels": one((20.7, 12.2), (1.0, 0.0, 1e-40), det=1e-40),
    "no area": one(covariance=(1.0, 0.0, 0.0), det=0.0),
    "a point": one(covariance=(0.0, 0.0, 0.0), det=0.0),
    "an infinite determinant": one(covariance=(1e20, 0.0, 1e20), det=math.inf),
    "far away": one(mean=(1e30, -1e30)),
}


@pytest.mark.parametrize("poison", POISON)
def test_extreme_splats_give_finite_images(rasterize, splats, poison):
    alone = rasterize(POISON[poison], HW, SKY)
    together = rasterize(concatenated([splats, POISON[poison]]), HW, SKY)
    for image in (alone, together):
        assert image.rgb.isfinite().all()
        assert image.alpha.isfinite().all()
        assert image.alpha.min() >= 0
        assert image.alpha.max() <= 1


@pytest.mark.parametrize(
    ("poison", "alpha"),
    [
        ("opacity 1/255", 1 / 255),
        ("opacity 1", 0.99),
        ("a million px", 0.5),
        ("a million px, seen from afar", 0.5 * math.exp(-1)),
        ("a needle of a million px", 0.5),
        ("a denormal covariance", 0.5),
    ],
)
def test_extreme_splats_have_their_alpha_at_the_centre(rasterize, poison, alpha):
    centre = rasterize(POISON[poison], HW, SKY).alpha[12, 20].item()
    assert centre == pytest.approx(alpha, rel=1e-4)


CAMERA = make_camera(size=(40, 30))
SCENE = make_scene(50, seed=3)
VICTIM = 20
TRAINING = TrainingViews.of(SCENE, [CAMERA])
CENTRE = CAMERA.centre.float()
BACK = CAMERA.cam_from_world[2, :3].float()  # the camera's z axis in the world

DRAWN_WITHOUT = {
    "NaN mean": ("means", torch.tensor([math.nan, 0.0, 0.0])),
    "infinite mean": ("means", torch.tensor([math.inf, 0.0, 0.0])),
    "NaN scale": ("log_scales", torch.tensor([math.nan, -2.0, -2.0])),
    "NaN rotation": ("quats", torch.full((4,), math.nan)),
    "NaN opacity": ("logit_opacities", torch.tensor(math.nan)),
    "at the camera's centre": ("means", CENTRE),
    "behind the camera": ("means", CENTRE - BACK),
    "just before the near plane": ("means", CENTRE + 0.1999 * BACK),
    "transparent": ("logit_opacities", torch.tensor(-math.inf)),
}
DRAWN_SOMEHOW = {
    "opaque": ("logit_opacities", torch.tensor(math.inf)),
    "a million px": ("log_scales", torch.full((3,), 12.0)),
    "infinitely large": ("log_scales", torch.full((3,), math.inf)),
    "a point": ("log_scales", torch.full((3,), -math.inf)),
    "denormal rotation": ("quats", torch.tensor([1e-30, 0.0, 0.0, 0.0])),
}


def poisoned(field: str, value: torch.Tensor) -> Gaussians:
    column = getattr(SCENE, field).clone()
    column[VICTIM] = value
    return replace(SCENE, **{field: column})


def draw(scene: Gaussians, name: str, training: TrainingViews = TRAINING) -> torch.Tensor:
    renderer = Renderer(scene, training, RECIPES["matched"], ALL_RASTERIZERS[name])
    with torch.no_grad():
        rgb, alpha = renderer(CAMERA)
    return torch.cat([rgb, alpha[..., None]], dim=2)


@pytest.mark.parametrize("name", ALL_RASTERIZERS)
def test_what_cannot_be_seen_is_left_out(name):
    kept = torch.arange(len(SCENE)) != VICTIM
    training = replace(TRAINING, bounds=TrainingViews.of(SCENE[kept], [CAMERA]).bounds)
    without = draw(SCENE[kept], name, training)[..., :3]
    assert (draw(SCENE, name)[..., :3] - without).abs().max() > 1e-3, "the victim is not in view"
    for poison, (field, value) in DRAWN_WITHOUT.items():
        image = draw(poisoned(field, value), name)[..., :3]
        torch.testing.assert_close(image, without, rtol=0, atol=1e-6, msg=poison)


@pytest.mark.parametrize("name", ALL_RASTERIZERS)
def test_extremes_draw_finite_images(name):
    for poison, (field, value) in DRAWN_SOMEHOW.items():
        image = draw(poisoned(field, value), name)
        assert image.isfinite().all(), poison
        assert image[..., 3].min() >= 0, poison
        assert image[..., 3].max() <= 1, poison


@pytest.mark.parametrize("recipe", ["analytic", "eaa", "gaussian-blending", "aa-2dgs", "2dgs", "2dgs-matched"])
def test_points_and_discs_on_edge_are_drawn(recipe):
    """Their determinants underflow, or the squares of their whitenings overflow."""
    camera = Camera("front", 16, 16, 5.0, 5.0, 8.0, 8.0, torch.eye(4))
    for scales in ((-30.0, -30.0, -30.0), (-math.inf, -math.inf, -1.0), (-30.0, -1.0, -1.0)):
        scene = replace(
            make_scene(1),
            means=torch.tensor([[0.0, 0.0, 4.0]]),
            quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
            log_scales=torch.tensor([scales]),
        )
        for scale in (1.0, 8.0):
            rgb, alpha = Renderer.of(scene, [camera], recipe, rasterizer="eager")(camera.scaled(scale))
            assert rgb.isfinite().all(), scales
            assert 0 <= alpha.min() <= alpha.max() <= 1, scales


@pytest.mark.parametrize("name", ALL_RASTERIZERS)
def test_a_colour_that_is_not_finite_is_refused_by_its_index(name):
    problem = rf"Gaussian {VICTIM}: has no finite colour \(the first of 1\)"
    for value in (math.nan, math.inf):
        with pytest.raises(UsageError, match=problem):
            draw(poisoned("sh", torch.full((4, 3), value)), name)
