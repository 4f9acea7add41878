"""The rules of compositing as values: every rasterizer and pixel kernel follows them, and wrong ones are refused."""

import math
from dataclasses import replace
from functools import cache

import pytest
import torch

from aaplug import PixelKernel, Render, UsageError
from aaplug.core.ellipses import cull
from aaplug.core.projection import project
from aaplug.core.rules import RULES_3DGS, RULES_GSPLAT, Rules
from aaplug.lab.integral import INTEGRAL
from aaplug.methods import COMPOSITORS, PIXEL_KERNELS
from aaplug.methods.pixel_kernels.point import POINT
from aaplug.rasterizers.reference import Reference
from aaplug.rasterizers.tiled import Tiled
from aaplug.rasterizers.tiled.packages import CompiledKernels
from tests.conftest import ALL_RASTERIZERS, COMPILED, each, make_camera, make_scene, make_splats, splats_of

F64 = torch.float64
BLACK, SKY = (0.0, 0.0, 0.0), (0.25, 0.5, 1.0)
RED, GREEN = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)
OTHERS = {
    "gsplat": RULES_GSPLAT,
    "low cap": Rules(max_alpha=0.6),
    "high cut-off": Rules(min_alpha=0.05),
    "low cut-off": Rules(min_alpha=1 / 400),
    "early stop": Rules(min_transmittance=0.05),
    "all": Rules(max_alpha=0.9, min_alpha=0.02, min_transmittance=0.01),
}
HW = (20, 27)


rules = each(OTHERS)


def opaque_splats():
    """Splats of which many reach every cap, cut-off and stop."""
    splats = make_splats(150, HW, 4, (0.0, 2.0)).to(F64)
    slopes = torch.zeros(150, 2, dtype=F64)
    return replace(splats, opacities=(1.1 * splats.opacities.sqrt()).clamp(max=1), depth_slopes=slopes)


@cache
def usual(pixel: PixelKernel) -> Render:
    return Reference()(opaque_splats(), HW, SKY, pixel)


@pytest.mark.parametrize("pixel", PIXEL_KERNELS.values(), ids=PIXEL_KERNELS)
def test_tiled_equals_the_reference_under_other_rules(pixel, rules):
    splats = opaque_splats()
    tiled, exact = (draw(splats, HW, SKY, pixel, None, rules) for draw in (Tiled(), Reference()))
    torch.testing.assert_close(tiled.rgb, exact.rgb, rtol=0, atol=1e-6)
    assert (exact.rgb - usual(pixel).rgb).abs().max() > 1e-5, "these rules should matter here"


@pytest.mark.parametrize("compositor", COMPOSITORS.values(), ids=COMPOSITORS)
def test_compositors_equal_their_exact_twins_under_other_rules(compositor, rules):
    splats = opaque_splats()
    tiled, exact = (draw(splats, HW, SKY, INTEGRAL, compositor, rules) for draw in (Tiled(), Reference()))
    difference = (tiled.rgb - exact.rgb).abs().amax(dim=2)
    assert (difference > 2e-5).double().mean() < 1e-3


def test_gradients_follow_the_rules(rules):
    splats = opaque_splats()
    found = []
    for rasterizer in (Tiled(), Reference()):
        means = splats.means.clone().requires_grad_()
        image = rasterizer(replace(splats, means=means), HW, BLACK, POINT, None, rules)
        found.append(torch.autograd.grad(image.rgb.square().sum(), means)[0])
    torch.testing.assert_close(*found, rtol=1e-9, atol=1e-9)


def test_any_number_of_channels_is_composited_as_three_are():
    splats, images = opaque_splats(), []
    more = torch.stack([*splats.rgb.unbind(1), splats.depths, splats.opacities], dim=1)
    for rasterizer in (Tiled(), Reference()):
        features = more.clone().requires_grad_()
        image = rasterizer(replace(splats, rgb=features), HW, SKY, POINT)
        images.append((image.rgb, image.alpha, *torch.autograd.grad(image.rgb.square().sum(), features)))
    for tiled, exact in zip(*images, strict=True):
        torch.testing.assert_close(tiled, exact, rtol=1e-9, atol=1e-9)
    assert images[0][0].shape == (*HW, 5)
    torch.testing.assert_close(images[1][0][..., :3], usual(POINT).rgb)


@pytest.mark.parametrize("rasterizer", ALL_RASTERIZERS.values(), ids=ALL_RASTERIZERS)
def test_rules_worked_by_hand(rasterizer):
    def centre(*opacities: float, rules: Rules) -> float:
        layers = [((4.5, 4.5), (4.0, 0.0, 4.0), 1.0 + i, o, RED) for i, o in enumerate(opacities)]
        splats = splats_of(*layers).to(torch.float32)
        return rasterizer(splats, (16, 16), BLACK, POINT, None, rules).alpha[4, 4].item()

    assert centre(1.0, rules=RULES_GSPLAT) == pytest.approx(0.999, abs=1e-6)
    assert centre(1.0, rules=RULES_3DGS) == pytest.approx(0.99, abs=1e-6)
    assert centre(0.04, rules=Rules(min_alpha=0.05)) == 0
    assert centre(0.06, rules=Rules(min_alpha=0.05)) == pytest.approx(0.06, abs=1e-6)
    assert centre(0.003, rules=Rules(min_alpha=1 / 400)) == pytest.approx(0.003, abs=1e-6)
    stop = Rules(min_transmittance=0.05)
    assert centre(0.9, 0.6, 0.4, rules=stop) == pytest.approx(0.9, abs=1e-6)  # not down to 0.04
    assert centre(0.9, 0.4, 0.4, rules=stop) == pytest.approx(0.94, abs=1e-6)


def test_a_lower_cutoff_keeps_splats_and_pixels_that_a_higher_one_drops():
    # 0.5 exp(-d²/8) falls to 1/255 at 6.2 px and to 1/400 at 6.5 px
    for x, opacity in ((4.5, 0.003), (-6.35, 0.5)):
        splats = splats_of(((x, 4.5), (4.0, 0.0, 4.0), 1.0, opacity, RED))
        assert [len(cull(splats, (9, 9), rules=rules)) for rules in (RULES_3DGS, Rules(min_alpha=1 / 400))] == [0, 1]


@pytest.mark.skipif(COMPILED is None, reason="the kernels are not compiled here (aaplug warmup)")
def test_compiled_kernels_follow_the_rules_without_being_built_anew(rules, monkeypatch):
    """One kernel serves all rules: nothing falls back to eager code, and the image is the reference's."""
    splats, eager = opaque_splats().to(torch.float32), []
    run = CompiledKernels.runner

    def watched(kernels, kernel, args):
        runner = run(kernels, kernel, args)
        eager.extend([kernel.name] if runner is kernel.function else [])
        return runner

    monkeypatch.setattr(CompiledKernels, "runner", watched)
    fast, exact = (draw(splats, HW, SKY, POINT, None, rules) for draw in (Tiled(COMPILED), Reference()))
    assert not eager
    torch.testing.assert_close(fast.rgb.double(), exact.rgb, rtol=0, atol=2e-5)
    seen = cull(project(make_scene(200), make_camera(), COMPILED, rules), (64, 64), kernels=COMPILED, rules=rules)
    assert seen.sources.equal(cull(project(make_scene(200), make_camera(), rules=rules), (64, 64), rules=rules).sources)
    assert not eager


WRONG = {"max_alpha": (1.0, math.nan), "min_alpha": (0.0, 1 / 600, 0.995), "min_transmittance": (0.0, 1.0)}


@pytest.mark.parametrize("name", [*WRONG, "near"])
def test_wrong_rules_are_refused(name):
    for value in WRONG.get(name, (0.0, -1.0)):
        with pytest.raises(UsageError, match=": expected"):
            Rules(**{name: value})
