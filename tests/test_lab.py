"""The folder for comparisons: nothing needs it, and deleting it deletes its entries alone; methods that papers name.

laws/test_filter_laws.py has its filters, test_finetuning.py its fine-tuning.
"""

import math
import re
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from aaplug import RECIPES, CameraSet, Gaussians, Limits, Monitor, Renderer, Splats2D, UsageError, finetune, lod, merge
from aaplug.core.conventions import MIP
from aaplug.core.rules import RULES_3DGS, Rules
from aaplug.core.training import TrainingViews
from aaplug.evaluation.laws.base import make_camera, make_scene, make_splats
from aaplug.evaluation.metrics import psnr
from aaplug.io.images import image_size
from aaplug.io.scenes import read_scene, write_scene
from aaplug.lab.elliptical import MOST_NODES, Elliptical
from aaplug.lab.gaussian_blending import (
    MAX_POINT_SPAN,
    MIN_WINDOW_VARIANCE,
    GaussianBlending,
    behind,
    light_of,
    moments,
)
from aaplug.lab.integral import INTEGRAL
from aaplug.lab.learned import NAMES
from aaplug.lab.multi_scale import in_one_scene, pixel_sizes
from aaplug.lab.obbl import BoundedBandLimit, Renormalized
from aaplug.methods.filters.smoothing import Smoothing3D
from aaplug.methods.pixel_kernels.point import POINT
from aaplug.rasterizers import RASTERIZERS
from aaplug.rasterizers.reference import Reference
from aaplug.rasterizers.tiled import Tiled
from tests.conftest import ALL_RASTERIZERS, ROOT, SAMPLE, run_python, sized, splats_of

PROGRAM = """
import os, sys
os.chdir(sys.argv[1])
sys.path.remove("")  # the checkout
# An editable installation would find the folder where it was installed from.
sys.meta_path[:] = [finder for finder in sys.meta_path if "editable" not in getattr(finder, "__module__", "")]
import aaplug
from aaplug.methods import COMPOSITORS, RECIPES
from aaplug_cli.main import main
assert aaplug.__file__.startswith(sys.argv[1]), aaplug.__file__
assert {"auto", "2dgs"} <= set(RECIPES) and "analytic" not in RECIPES and not COMPOSITORS
main(["render", f"{sys.argv[2]}/chair.ply", *f"--cameras {sys.argv[2]} -o images --scale 0.1 --views r_8".split()])
"""


def test_nothing_but_the_lab_names_it():
    files = [p for folder in ("aaplug", "cli") for p in (ROOT / folder).rglob("*.py*") if p.suffix in (".py", ".pyi")]
    others = [path for path in files if path.parent.name != "lab"]
    assert len(files) > len(others) > 100
    assert not [path for path in others if re.search(r"\blab[./]|import lab\b", path.read_text())]


def test_without_its_folder_auto_renders_and_nothing_is_said_of_it(tmp_path):
    hidden = shutil.ignore_patterns("lab")
    shutil.copytree(ROOT / "aaplug", tmp_path / "aaplug", ignore=hidden)
    shutil.copytree(ROOT / "cli", tmp_path / "aaplug_cli", ignore=hidden)
    done = run_python(PROGRAM, tmp_path, SAMPLE, PYTHONPATH=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "lab" not in done.stderr
    images = [*(tmp_path / "images").rglob("*.png")]
    assert [image_size(path) for path in images] == [(80, 80)]


F64 = torch.float64
SKY = (0.1, 0.5, 0.9)
OFFSETS = torch.tensor([[0.0, 0.0], [0.4, -0.3], [1.2, 0.7]], dtype=F64)[:, None]


def elongated(kappas: list[float], shorter: float = 0.3):
    """Splats with these ratios of variances, along x."""
    splats = make_splats(len(kappas), (8, 8)).to(F64)
    thin = torch.full((len(kappas),), shorter, dtype=F64)
    wide = thin * torch.tensor(kappas, dtype=F64)
    return replace(splats, covs=torch.stack([wide, 0 * thin, thin], dim=1), dets=wide * thin)


def test_longer_ellipses_have_more_nodes():
    nodes, kappa = Elliptical().nodes(elongated([1.0, 20.0, 1e6]))
    assert nodes.tolist() == [4, 7, MOST_NODES]  # 3 + ⌈ln 2⌉ and 3 + ⌈ln 21⌉
    assert kappa.tolist() == pytest.approx([1.0, 20.0, 1e6])


def test_nodes_alike_sum_to_the_integral_and_gamma_counts_only_where_the_sum_is_not_normalized():
    splats = elongated([1.0, 3.0, 40.0])
    offsets = OFFSETS.expand(-1, 3, -1)
    alike = Elliptical(beta=0.0).exact(splats, offsets)
    torch.testing.assert_close(alike, INTEGRAL.exact(splats, offsets), rtol=0.02, atol=1e-3)
    plain, heavy = (Elliptical(gamma=gamma).exact(splats, offsets) for gamma in (0.5, 2.0))
    assert torch.equal(plain, heavy)
    assert not torch.allclose(plain, alike, rtol=0.01)
    plain, heavy = (Elliptical(gamma=gamma, normalized=False).exact(splats, offsets) for gamma in (0.0, 1.0))
    ratios = 1 + torch.tensor([1.0, 3.0, 40.0], dtype=F64).log()
    torch.testing.assert_close(heavy, plain * ratios)


def test_the_band_limit_widens_as_smoothing_does_and_bounds_opacities():
    scene, views = make_scene(30), [make_camera()]
    training = TrainingViews.of(scene, views)
    bounded = BoundedBandLimit(0.5)(scene, training)
    assert torch.equal(bounded.log_scales, Smoothing3D(opacity="kept")(scene, training).log_scales)
    torch.testing.assert_close(bounded.opacities, scene.opacities.clamp(max=0.5))
    assert (scene.opacities > 0.5).any()


def test_covered_pixels_become_opaque_in_their_own_colour():
    splats, hw = make_splats(200, (24, 32)), (24, 32)
    plain, filled = (RASTERIZERS["eager"](splats, hw, SKY, POINT, c) for c in (None, Renormalized()))
    covered = plain.alpha > 0.5
    assert covered.any()
    assert not covered.all()
    assert (filled.alpha[covered] - 1).abs().max() < 1e-5
    colours = (plain.rgb - (1 - plain.alpha[..., None]) * torch.tensor(SKY)) / plain.alpha[..., None]
    torch.testing.assert_close(filled.rgb[covered], colours[covered], rtol=0, atol=1e-5)
    torch.testing.assert_close(filled.rgb[~covered], plain.rgb[~covered], rtol=0, atol=1e-5)


VIEW = make_camera(size=(48, 36))
SCENE = sized(make_scene(40, seed=3))
AT = {2.0: {}, 1.0: {}, 0.5: {1: 1.0}, 2**-1.5: {1: 0.5, 2: 0.5}, 1 / 8: {3: 1.0}, 1 / 12: {3: 0.415, 4: 0.585}}
TUNING = {"steps": 6, "truth": "self", "rasterizer": "eager"}


def image(scene, recipe, scale):
    return Renderer.of(scene, [VIEW], recipe, rasterizer="eager")(VIEW.scaled(scale)).rgb


@pytest.mark.parametrize("scale", AT)
def test_a_learned_filter_is_matched_on_gaussians_changed_by_their_columns(scale):
    size, logit = (
        sum((weight * SCENE.extras[f"filter_{what}_{k}"] for k, weight in AT[scale].items()), torch.zeros(40))
        for what in ("scale", "opacity")
    )
    changed = replace(SCENE, log_scales=SCENE.log_scales + size[:, None], logit_opacities=SCENE.logit_opacities + logit)
    torch.testing.assert_close(image(SCENE, "learned", scale), image(changed, "matched", scale), rtol=0, atol=1e-4)
    if scale >= 1:
        assert torch.equal(image(SCENE, "learned", scale), image(SCENE, "matched", scale))
    else:
        assert not torch.allclose(image(SCENE, "learned", scale), image(SCENE, "matched", scale), atol=1e-2)


def test_learning_moves_the_columns_alone_which_a_ply_keeps(tmp_path: Path, caplog):
    cameras, plain = CameraSet((VIEW,), (VIEW,)), make_scene(40, seed=3)
    found = finetune(plain, cameras, tmp_path / "a.ply", learn_filters=True, scale=(0.5,), **TUNING)
    assert [*found.settings.weights] == [0.5, 0.25, 0.125, 0.0625]
    rows = {m.recipe: m.values["PSNR"] for m in found.report.measurements if m.scale == 1}
    assert rows["before"] == rows["after"]
    kept = read_scene(tmp_path / "a.ply")
    scene = kept.gaussians()
    assert "learned filters, for the recipe learned" in kept.notes
    assert all(torch.equal(column, plain.columns[name]) for name, column in scene.columns.items())
    assert all(torch.equal(scene.extras[name], found.scene.extras[name]) for name in NAMES)
    assert all(scene.extras[name].abs().max() > 0 for name in NAMES)
    more = finetune(tmp_path / "a.ply", cameras, tmp_path / "b.ply", learn_filters=True, **TUNING).scene.extras
    again = read_scene(tmp_path / "b.ply").gaussians().extras
    assert all(
        torch.equal(again[name], more[name]) and not torch.equal(more[name], scene.extras[name]) for name in NAMES
    )
    assert not caplog.text
    for name in ("a.splat", "a.sog"):
        write_scene(tmp_path / name, scene)
    assert caplog.text.count("cannot hold the columns filter_scale_1, ") == 2


def test_who_does_not_draw_learned_filters_is_refused():
    scene, cameras = make_scene(3), CameraSet((VIEW,), (VIEW,))
    assert "filter_opacity_4; `aaplug finetune --learn-filters`" in (RECIPES["learned"].lacks(scene) or "")
    assert RECIPES["learned"].lacks(SCENE) is None
    for wrong in ({"viewer": "mip"}, {"method": "mipmap-gs"}):
        with pytest.raises(UsageError, match=r"method of its own|shows no learned filters"):
            finetune(scene, cameras, None, learn_filters=True, **wrong, **TUNING)


def test_columns_that_merging_drops_are_named(monkeypatch):
    said, cameras, dropped = list[str](), CameraSet((VIEW,), (VIEW,)), f"columns {', '.join(SCENE.extras)}"
    monkeypatch.setattr(Monitor, "say", lambda self, text: said.append(text))
    lod(SCENE, cameras, None, simplify=0.5, refine=False, min_seen=0.0)
    merge([SCENE, SCENE], cameras, None)
    assert [f"not have its {dropped}" in line for line in said if dropped in line] == [True] * 3


LEVELS = 4


@pytest.fixture(scope="module")
def fine(sample_scene) -> Gaussians:
    return sample_scene[::3]


@pytest.fixture(scope="module")
def together(fine, sample_cameras) -> Gaussians:
    return in_one_scene(fine, sample_cameras.train, LEVELS)


def test_its_rule_draws_fewer_gaussians_that_look_more_like_the_scene(together, fine, sample_cameras):
    view = sample_cameras.test[0]
    ceiling = Renderer.of(fine, sample_cameras, quality="best")
    by_rule = Renderer.of(together, sample_cameras, "multi-scale")
    classic = Renderer.of(fine, sample_cameras, "classic")
    for scale, gain in ((1 / 4, 0.5), (1 / 8, 1.0), (1 / 16, 2.0)):
        truth = ceiling(view.scaled(scale)).rgb
        ours, plain = (psnr(renderer(view.scaled(scale)).rgb, truth) or 0 for renderer in (by_rule, classic))
        assert ours > plain + gain, scale
    drawn = [len(by_rule.splats(view.scaled(0.5**level))) for level in range(LEVELS + 1)]
    assert drawn == sorted(drawn, reverse=True)
    assert drawn[-1] < 0.3 * drawn[0]
    full = psnr(by_rule(view).rgb, classic(view).rgb)
    assert full is None or full > 40


def test_a_wall_of_small_gaussians_stays_closed_at_every_size():
    """Every one of them is replaced, so a part that neither it nor its level covers would be a hole."""
    side = torch.arange(64) * 0.03 - 0.96
    means = torch.stack([side.repeat(64), torch.zeros(64**2), side.repeat_interleave(64)], dim=1)
    wall = replace(make_scene(1)[torch.zeros(64**2, dtype=torch.int64)], means=means)
    wall.log_scales[:], wall.logit_opacities[:] = math.log(0.02), 3.0
    views = [make_camera((x, -4.0, 0.0), (256, 256), 0.6) for x in (-0.3, 0.0, 0.3)]
    by_rule = Renderer.of(in_one_scene(wall, views, LEVELS), views, "multi-scale")
    for step in range(4 * LEVELS + 1):
        render = by_rule(views[1].scaled(2 ** (-step / 4)))
        middle = slice(render.alpha.shape[0] * 3 // 8, render.alpha.shape[0] * 5 // 8 + 1)
        assert render.alpha[middle, middle].mean() > 0.7, step
    drawn = [len(by_rule.splats(views[1].scaled(0.5**level))) for level in (0, LEVELS)]
    assert drawn[1] < 0.1 * drawn[0]


def test_every_gaussian_of_the_scene_is_there_to_the_bit(together, fine):
    rows = {tuple(row) for row in torch.cat([together.means, together.sh[:, 0]], dim=1).tolist()}
    assert {tuple(row) for row in torch.cat([fine.means, fine.sh[:, 0]], dim=1).tolist()} <= rows


def test_pixel_sizes_are_those_of_all_views():
    scene, views = make_scene(30), [make_camera((0.0, -4.0, 0.0)), make_camera((0.0, -8.0, 0.0))]
    each = [pixel_sizes(scene, [view]) for view in views]
    least, most = pixel_sizes(scene, views)
    shared = torch.stack([most > 0 for _, most in each]).all(dim=0)
    assert shared.any()
    assert torch.equal(least[shared], torch.minimum(each[0][0], each[1][0])[shared])
    assert torch.equal(most[shared], torch.maximum(each[0][1], each[1][1])[shared])


@pytest.mark.parametrize("change", [{"convention": MIP}, {"flat": True}])
def test_a_scene_that_its_rasterizer_shows_otherwise_is_refused(change):
    with pytest.raises(UsageError, match="Multi-Scale 3DGS draws 3D Gaussians by the convention 'classic'"):
        in_one_scene(replace(make_scene(5), **change), [make_camera()], 1)


NODES = 20_001
BLACK, WHITE = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)
BLENDING = GaussianBlending()
WIDE = (1e4, 0.0, 1e4)  # px²: of a splat that is even over a pixel


@pytest.mark.parametrize(("dtype", "near"), [(F64, 2e-4), (torch.float32, 3e-3)])
@pytest.mark.parametrize("half", [0.05, 0.29, 0.31, 1.0, 4.0])
@pytest.mark.parametrize("u", [0.0, 0.7, -2.5, 3.3])
def test_moments_are_integrals(u, half, dtype, near):
    """Squares to `near` of a window's own; further from the splat than 3.3 standard deviations nothing is seen."""
    x = half * torch.linspace(-1, 1, NODES, dtype=F64)
    density = (-0.5 * (u + x) ** 2).exp()
    mass = torch.trapezoid(density, x)
    mean, square = (torch.trapezoid(density * x**power, x) / mass for power in (1, 2))
    found = moments(torch.tensor([u], dtype=dtype), torch.tensor([half], dtype=dtype))
    assert found.value.item() == pytest.approx(mass.item() / (2 * half), rel=near)
    assert found.mean.item() == pytest.approx(mean.item(), abs=near * half)
    assert found.square.item() == pytest.approx(square.item(), abs=near * half**2)
    assert found.centre.item() == pytest.approx(math.exp(-0.5 * u * u), rel=near)


def after(*splats: tuple, window: float = 1.0, dtype: torch.dtype = F64):
    """The light behind splats at the pixel whose centre is the origin, and their raster rows."""
    rows = BLENDING.rows(replace(splats_of(*splats).to(dtype), window=window))
    origin = torch.zeros(1, 1, dtype=dtype)
    light = light_of(origin, window)
    for row in rows[:-1]:
        light = behind(light, row[None], origin, origin, Limits.by(RULES_3DGS))
    return light, rows


@pytest.mark.parametrize("cov", [(0.3, 0.0, 0.05), (0.2, 0.05, 0.4), (0.02, 0.01, 0.03)])
def test_the_window_has_the_moments_of_the_light_that_is_left(cov):
    """Against sums over a fine grid, turned to the splat's axes as the window is."""
    (ux, uy, vx, vy, *_), opacity = after(((0.3, -0.2), cov, 1.0, 0.8, WHITE))[1][0].tolist(), 0.8
    u_px, v_px = math.hypot(ux, uy), math.hypot(vx, vy)
    ticks = (torch.arange(400, dtype=F64) + 0.5) / 400 - 0.5
    p, q = (t.flatten() for t in torch.meshgrid(ticks, ticks, indexing="ij"))
    x, y = (ux * p / u_px + vx * q / v_px), (uy * p / u_px + vy * q / v_px)
    u, v = ux * (x - 0.3) + uy * (y + 0.2), vx * (x - 0.3) + vy * (y + 0.2)
    left = 1 - opacity * (-0.5 * (u * u + v * v)).exp()
    light, _ = after(((0.3, -0.2), cov, 1.0, opacity, WHITE))
    assert light.share.item() == pytest.approx(left.mean().item(), abs=1e-5)
    for centre, side, position, along in ((light.x, light.width, x, p), (light.y, light.height, y, q)):
        middle, mean = (((left * at).mean() / left.mean()).item() for at in (position, along))
        variance = (left * (along - mean) ** 2).mean() / left.mean()
        assert centre.item() == pytest.approx(middle, abs=1e-5)
        assert side.item() == pytest.approx((12 * variance.item()) ** 0.5, abs=1e-5)


def test_a_window_is_no_narrower_than_its_least_variance():
    light, _ = after(((0.0, 0.0), (0.25, 0.0, 0.25), 1.0, 0.5, WHITE), window=0.08)
    assert light.width.item() == pytest.approx((12 * MIN_WINDOW_VARIANCE) ** 0.5)


def test_a_window_that_spans_little_of_a_splat_is_a_point_and_stays():
    sigma = 1 / (0.99 * MAX_POINT_SPAN)
    light, _ = after(((3.0, 0.0), (sigma**2, 0.0, 0.01), 1.0, 0.5, WHITE))
    assert light.share.item() == pytest.approx(1 - 0.5 * math.exp(-0.5 * (3 / sigma) ** 2))
    assert [x.item() for x in light[1:5]] == [0, 0, 1, 1]
    moved, _ = after(((3.0, 0.0), ((0.9 * sigma) ** 2, 0.0, 0.01), 1.0, 0.5, WHITE))
    assert moved.height.item() != 1


def test_a_pixel_stops_behind_the_splat_that_ends_it():
    rules = Rules(min_transmittance=0.05)
    rows = [((4.5, 4.5), WIDE, 1.0 + i, o, WHITE) for i, o in enumerate((0.9, 0.6, 0.4))]
    for rasterizer in (Tiled(), Reference()):
        image = rasterizer(splats_of(*rows), (9, 9), BLACK, INTEGRAL, BLENDING, rules)
        assert image.alpha[4, 4].item() == pytest.approx(0.96, abs=1e-3)  # 3DGS: 0.9


def leak(compositor: GaussianBlending | None) -> float:
    """Transmittance of a pixel whose halves are each covered by a wide opaque splat."""
    covs = (0.02, 0.0, 25.0)
    splats = splats_of(((4.25, 4.5), covs, 1.0, 0.99, WHITE), ((4.75, 4.5), covs, 2.0, 0.99, WHITE))
    render = RASTERIZERS["eager"](replace(splats, window=1.0), (9, 9), BLACK, INTEGRAL, compositor)
    return 1 - render.alpha[4, 4].item()


def test_splats_side_by_side_let_less_light_through_than_independent_ones():
    apart = 1 - 2 * (1 - math.sqrt(leak(None)))  # each hides its own share of the pixel
    assert apart < leak(BLENDING) < 0.96 * leak(None)


def test_a_window_of_no_size_gives_point_samples():
    splats = splats_of(((4.2, 4.6), (0.5, 0.2, 0.4), 1.0, 0.7, WHITE), ((4.4, 3.9), (2.0, 0.0, 1.0), 2.0, 0.9, WHITE))
    draw = RASTERIZERS["eager"]
    point = draw(splats, (9, 9), BLACK, POINT)
    blended = draw(replace(splats, window=0.0), (9, 9), BLACK, INTEGRAL, BLENDING)
    torch.testing.assert_close(blended.alpha, point.alpha, rtol=1e-5, atol=1e-6)


EXTREMES = {
    "tiny": ((20.3, 12.6), (1e-4, 0.0, 1e-4), 1.0, 1.0, WHITE),
    "a needle": ((20.5, 12.5), (900.0, 0.0, 1e-6), 1.0, 1.0, WHITE),
    "a slanted needle": ((20.5, 12.5), (450.0, 449.999, 450.0), 1.0, 1.0, WHITE),
    "huge": ((1e3, -1e3), (1e9, 0.0, 1e9), 1.0, 1.0, WHITE),
    "round": ((20.5, 12.5), (2.0, 0.0, 2.0), 1.0, 1.0, WHITE),
    "off the screen": ((1e30, -1e30), (1.0, 0.0, 1.0), 1.0, 1.0, WHITE),
}


@pytest.mark.parametrize("name", EXTREMES)
@pytest.mark.parametrize("rasterizer", ALL_RASTERIZERS.values(), ids=ALL_RASTERIZERS)
def test_extreme_splats_agree_with_the_reference_among_others(rasterizer, name):
    hw = (29, 43)
    extreme, others = splats_of(EXTREMES[name]).to(torch.float32), make_splats(60, hw, seed=1)
    columns = {n: torch.cat([c.to(others.means), vars(others)[n]]) for n, c in extreme._columns().items()}
    for splats in (extreme, Splats2D(**columns | {"sources": torch.arange(61)})):
        image, exact = (draw(splats, hw, BLACK, INTEGRAL, BLENDING) for draw in (rasterizer, Reference()))
        assert image.alpha.min() >= 0
        assert image.alpha.max() <= 1
        difference = (image.rgb - exact.rgb).abs().amax(dim=2)
        assert difference.isfinite().all()
        assert (difference > 2e-5).double().mean() < 2e-3
