"""Laws of every rasterizer: those of the registry, plug-ins among them, and the compiled one."""

import math
from dataclasses import replace

import pytest
import torch

from aaplug.core.splats import Render, Splats2D
from tests.conftest import make_splats, splats_of

HW = (29, 43)
SKY = (0.25, 0.5, 1.0)
NAMES = ("means", "covs", "dets", "depths", "opacities", "sources", "rgb")
SAME = 1e-6  # the order of a sum may change


@pytest.fixture
def splats() -> Splats2D:
    """Splats of distinct depths from 2 to 3."""
    splats = make_splats(150, HW, seed=1)
    order = torch.randperm(150, generator=torch.Generator().manual_seed(2))
    return replace(splats, depths=2 + order / 150)


def joined(*parts: Splats2D) -> Splats2D:
    return Splats2D(*(torch.cat([getattr(part, name) for part in parts]) for name in NAMES))


def shuffled(splats: Splats2D, seed: int = 0) -> Splats2D:
    return splats[torch.randperm(len(splats), generator=torch.Generator().manual_seed(seed))]


def one(
    mean: tuple[float, float] = (20.5, 12.5),
    covariance: tuple[float, float, float] = (9.0, 0.0, 9.0),
    opacity: float = 0.5,
    det: float | None = None,
) -> Splats2D:
    splat = splats_of((mean, covariance, 1.0, opacity, (1.0, 0.5, 0.25))).to(torch.float32)
    return splat if det is None else replace(splat, dets=torch.tensor([det]))


def assert_same(image: Render, other: Render, atol: float = SAME) -> None:
    torch.testing.assert_close(image.rgb, other.rgb, rtol=0, atol=atol)
    torch.testing.assert_close(image.alpha, other.alpha, rtol=0, atol=atol)


def test_splats_behind_an_opaque_wall_change_nothing(rasterize, splats):
    wall = joined(*[one(covariance=(1e8, 0.0, 1e8), opacity=1.0)] * 3)
    before = rasterize(joined(wall, splats), HW, SKY)
    hidden = make_splats(100, HW, seed=7)
    hidden = replace(hidden, depths=hidden.depths + 1.5, rgb=hidden.rgb * 100)
    assert_same(rasterize(shuffled(joined(wall, splats, hidden)), HW, SKY), before)
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
    assert_same(rasterize(shuffled(joined(UNSEEN[unseen], splats)), HW, SKY), rasterize(splats, HW, SKY))


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
    together = rasterize(joined(splats, POISON[poison]), HW, SKY)
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
