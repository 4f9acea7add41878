"""The renderer: how it is prepared, what recipes promise about training size, energy and samples, and its gradients."""

import ast
import copy
import itertools
from dataclasses import replace
from operator import attrgetter
from typing import Any

import pytest
import torch
from torch import Tensor

import aaplug
from aaplug import Camera, CameraSet, Gaussians, Lens, Recipe, Render, Scene, TrainingViews, read_cameras, read_scene
from aaplug.core.colours import WHITE
from aaplug.core.conventions import CONVENTIONS, MIP
from aaplug.core.imaging import average_samples, box_average
from aaplug.core.passes import PASSES
from aaplug.core.projection import project
from aaplug.methods import QUALITIES, RECIPES
from aaplug.methods.filters.dilation import Dilation
from aaplug.methods.filters.smoothing import Smoothing3D
from aaplug.methods.pixel_kernels.surfel import SURFEL
from aaplug.methods.presets import NEIGHBOURS, find_recipe, suited
from aaplug.options.verbs import RenderOptions
from aaplug.rasterizers.tiled import Tiled
from aaplug.rendering import renderer as rendering
from aaplug.rendering.job import Job
from aaplug.rendering.renderer import Renderer, own_look
from aaplug.system.errors import FrameError, UsageError
from tests.conftest import ROOT, SAMPLE, make_camera, make_scene, sized


def free(camera: Camera) -> Camera:
    return replace(camera, trained_focal=None)


def test_a_world_filter_is_applied_once_when_the_renderer_is_made(cameras):
    scene = make_scene(200)
    renderer = Renderer.of(scene, cameras, "mip-splatting", rasterizer="eager")
    training = TrainingViews.of(scene, cameras)
    filtered = Smoothing3D()(scene, training)
    assert renderer.scene.log_scales.equal(filtered.log_scales)
    assert renderer.scene.fused == filtered.fused
    by_hand = Renderer(filtered, training, RECIPES["mip"])(cameras[0])
    unprepared = Renderer(scene, training, RECIPES["mip-splatting"])(cameras[0])
    assert renderer(cameras[0]).rgb.equal(by_hand.rgb)
    assert (renderer(cameras[0]).rgb - unprepared.rgb).abs().max() > 0.1


@pytest.mark.parametrize("name", RECIPES)
def test_a_stored_3d_filter_is_fused_for_every_recipe(name, cameras):
    scene = replace(make_scene(200), filter_3d=torch.full((200,), 0.2), convention=MIP)
    if RECIPES[name].lacks(scene) is not None:
        with pytest.raises(UsageError, match=name):
            Renderer.of(scene, cameras, name)
        return
    renderer = Renderer.of(scene, cameras, name, rasterizer="eager")
    assert renderer.scene.filter_3d is None
    assert renderer.scene.fused[0].method == "filter_3D"
    assert (renderer.scene.log_scales >= scene.log_scales).all()
    assert not renderer.scene.log_scales.equal(scene.log_scales)


def test_auto_draws_discs_for_a_scene_of_2d_gaussians_only(cameras):
    scene = make_scene(60)
    flat = replace(scene, flat=True, log_scales=scene.log_scales.clone())
    flat.log_scales[:, 2] = -30.0
    renderer = Renderer.of(flat, cameras, rasterizer="eager")
    assert renderer.recipe.pixel is SURFEL
    assert renderer.recipe.name == "auto"
    discs = Renderer.of(flat, cameras, "2dgs-matched", rasterizer="eager")
    assert renderer(cameras[0]).rgb.equal(discs(cameras[0]).rgb)
    assert Renderer.of(scene, cameras, rasterizer="eager").recipe.pixel is not SURFEL
    matched = Renderer.of(flat, cameras, "matched", rasterizer="eager")
    assert matched.recipe is RECIPES["matched"], "a named recipe is kept"
    assert own_look(flat, TrainingViews.of(flat, cameras)).recipe.pixel is SURFEL
    best = suited(find_recipe("auto", quality="best"), flat)
    assert best.samples_at(0.25) == 4


def test_cameras_of_another_scene_and_none_are_refused(cameras):
    scene = make_scene(200)
    elsewhere = replace(scene, means=scene.means + 100)
    with pytest.raises(FrameError, match="different frames"):
        Renderer.of(elsewhere, cameras)
    with pytest.raises(FrameError, match=r"0\.0%"):
        Renderer.of(elsewhere, cameras, min_seen=1e-6)
    with pytest.raises(UsageError, match="cameras: there are none"):
        Renderer.of(scene, [])
    training = TrainingViews.of(elsewhere, cameras)  # whoever computes it has checked it
    assert Renderer.of(elsewhere, training, "classic", rasterizer="eager").training is training


def test_a_camera_set_gives_its_training_cameras_and_its_background(cameras):
    scene = make_scene(30)
    found = CameraSet(tuple(cameras[:2]), tuple(cameras[2:]), WHITE)
    renderer = Renderer.of(scene, found, "classic", rasterizer="eager")
    assert list(renderer.training.cameras) == cameras[:2]
    assert renderer.background == WHITE
    assert Renderer.of(scene, cameras, "classic").background == (0.0, 0.0, 0.0)
    named = {"white": WHITE, "rgb(0 51 300)": (0.0, 0.2, 1.0), "hsl(120 100% 50%)": (0.0, 1.0, 0.0)}
    for background, colour in (*named.items(), ((0.1, 0.2, 0.3), (0.1, 0.2, 0.3))):
        assert Renderer.of(scene, cameras, "classic", background=background).background == colour
    black, white = (
        Renderer.of(scene, cameras, "classic", background=b, rasterizer="eager")(cameras[0]) for b in ("black", "white")
    )
    behind = (1 - black.alpha)[..., None]
    torch.testing.assert_close(white.rgb, black.rgb + behind, rtol=0, atol=1e-6)


def test_quality_is_that_of_auto(cameras):
    scene = make_scene(30)
    for quality, rate in QUALITIES.items():
        renderer = Renderer.of(scene, cameras, quality=quality)
        assert renderer.recipe.target_rate == rate
    assert Renderer.of(scene, cameras, "matched", quality="best").recipe.target_rate == 0


@pytest.mark.parametrize("recipe", ["auto", "2dgs", "analytic", "mip-splatting"])
@pytest.mark.parametrize("precision", ["autocast", torch.float16, torch.float64], ids=str)
def test_neither_autocast_nor_the_default_precision_of_a_program_changes_anything(recipe, precision, cameras):
    def drawn(scene):
        renderer, view = Renderer.of(scene, cameras, recipe), cameras[0].scaled(1 / 2)
        return [renderer(view).rgb, *renderer.passes(view, [*PASSES]).values(), *renderer.scene.columns.values()]

    scene = make_scene(30)
    expected, casts = drawn(scene), precision == "autocast"
    torch.set_default_dtype(torch.float32 if casts else precision)
    try:
        with torch.autocast("cpu", enabled=casts):
            assert all(map(torch.equal, drawn(scene), expected))
    finally:
        torch.set_default_dtype(torch.float32)


def test_paths_are_read(sample_cameras):
    scene, view = SAMPLE / "chair.ply", sample_cameras.test[0].scaled(0.125)
    by_path, by_hand = (
        Renderer.of(*pair, rasterizer="eager")
        for pair in ((scene, str(SAMPLE)), (read_scene(scene), read_cameras(SAMPLE)))
    )
    assert by_path.recipe == by_hand.recipe
    assert by_path.background == by_hand.background
    assert all(a.equal(b) for a, b in zip(by_path.scene.columns.values(), by_hand.scene.columns.values(), strict=True))
    assert by_path.training.bounds.highest.equal(by_hand.training.bounds.highest)
    assert by_path(view).rgb.equal(by_hand(view).rgb)


def test_a_world_filter_follows_the_training_rate(cameras):
    scene, view = make_scene(200), cameras[0].scaled(0.5)
    renderer = Renderer.of(scene, cameras, "mip-splatting", rasterizer="eager")
    finer = renderer.trained_at(2.0)
    anew = Renderer.of(scene, TrainingViews.of(scene, cameras).finer(2.0), "mip-splatting", rasterizer="eager")
    assert finer.scene.log_scales.equal(anew.scene.log_scales)
    assert finer(view).rgb.equal(anew(view).rgb)
    rates_alone = replace(renderer, training=renderer.training.finer(2.0))
    assert (finer(view).rgb - rates_alone(view).rgb).abs().max() > 0.01
    assert renderer.trained_at(1.0)(view).rgb.equal(renderer(view).rgb)


def test_by_another_recipe_the_scene_is_prepared_anew(cameras):
    scene = make_scene(200)
    filtered = Renderer.of(scene, cameras, "mip-splatting", rasterizer="eager", background="white")
    plain = filtered.by(RECIPES["classic"])
    assert plain.scene.log_scales.equal(scene.log_scales)
    assert plain.background == WHITE
    assert plain.by(filtered.recipe).scene.log_scales.equal(filtered.scene.log_scales)


def test_recipes_are_compared_without_an_error():
    for name, other in itertools.product(RECIPES, repeat=2):
        assert (RECIPES[name] == RECIPES[other]) == (name == other)
    for name in RECIPES:
        assert copy.deepcopy(RECIPES[name]).digest == RECIPES[name].digest


def test_one_place_calls_the_rasterizer():
    """A rasterizer takes a recipe's pixel kernel and its compositor."""
    calls = [
        f"{path.stem}: {ast.unparse(call.func)}"
        for path in sorted((ROOT / "aaplug").rglob("*.py"))
        for call in ast.walk(ast.parse(path.read_text()))
        if isinstance(call, ast.Call)
        and {"pixel", "compositor"} <= {argument.attr for argument in call.args if isinstance(argument, ast.Attribute)}
    ]
    assert calls == ["renderer: self.rasterizer"]


def test_a_drawing_holds_the_splats_of_the_image_that_has_the_samples(cameras):
    renderer = Renderer.of(make_scene(50), cameras, quality="best", rasterizer="eager")
    view = cameras[0].scaled(0.5)
    drawing = renderer.draw(view)
    assert renderer.samples(view) == 2
    assert drawing.hw == (2 * view.height, 2 * view.width)
    assert drawing.render.rgb.shape == (*view.hw, 3)
    assert drawing.render.rgb.equal(renderer(view).rgb)
    fine = renderer.sampled(view)[0]
    assert drawing.splats.means.equal(renderer.splats(fine).means)


def test_a_renderer_of_a_scene_with_gradients_has_them_where_the_filter_follows_the_training_views(cameras):
    scene = make_scene(200)
    scene = replace(scene, means=scene.means.requires_grad_())
    Renderer.of(scene, cameras, "matched")(replace(cameras[0], trained_focal=None).scaled(0.5)).rgb.sum().backward()
    assert scene.means.grad.isfinite().all()
    assert scene.means.grad.abs().sum() > 0


def test_gradients_are_made_at_once_because_each_part_would_take_a_scene(cameras, monkeypatch):
    scene = make_scene(200)
    scene = replace(scene, means=scene.means.requires_grad_())
    renderer, seen = Renderer.of(scene, cameras, rasterizer="eager"), []
    monkeypatch.setattr(rendering, "GAUSSIANS_AT_ONCE", 33)
    monkeypatch.setattr(
        rendering, "project", lambda part, *rest, **more: seen.append(len(part)) or project(part, *rest, **more)
    )
    whole = renderer(cameras[0]).rgb
    assert seen == [200]
    with torch.no_grad():
        torch.testing.assert_close(renderer(cameras[0]).rgb, whole.detach(), rtol=0, atol=1e-6)
    assert seen[1:] == [33, 33, 33, 33, 33, 33, 2]


def test_softening_spreads_a_sample_over_its_neighbours():
    rgb = torch.zeros(5, 6, 3)
    rgb[2, 3] = 1.0
    soft = average_samples(Render(rgb, rgb[..., 0]), 1, 0.1)
    down, right = torch.tensor([0, 0.1, 0.8, 0.1, 0]), torch.tensor([0, 0, 0.1, 0.8, 0.1, 0])
    torch.testing.assert_close(soft.alpha, down.outer(right))
    torch.testing.assert_close(soft.rgb, soft.alpha[..., None].expand(5, 6, 3))


@pytest.mark.parametrize("hw", [(1, 1), (1, 7), (5, 6)])
def test_softening_keeps_the_sum(hw):
    image = Render(torch.rand(*hw, 3), torch.rand(hw))
    soft = average_samples(image, 1, 0.2)
    for before, after in zip(image, soft, strict=True):
        torch.testing.assert_close(after.sum(), before.sum())
    assert average_samples(image, 1) is image
    white = Render(torch.ones(*hw, 3), torch.ones(hw))
    assert average_samples(white, 1, 0.03).rgb.equal(white.rgb)


@pytest.mark.parametrize("n", [2, 3])
def test_samples_are_softened_before_they_are_averaged(n):
    image = Render(torch.rand(4 * n, 2 * n, 3), torch.rand(4 * n, 2 * n))
    soft = average_samples(average_samples(image, 1, 0.1), n)
    torch.testing.assert_close(average_samples(image, n, 0.1), soft)


@pytest.mark.parametrize("quality", QUALITIES)
def test_auto_weighs_neighbours_only_where_its_samples_are_coarser_than_training(quality, cameras):
    renderer = Renderer.of(make_scene(30), cameras, quality=quality)
    for scale in (0.125, 0.25, 0.5, 1.0, 2.0):
        view = cameras[0].scaled(scale)
        samples = renderer.samples(view)
        sampled = min(1.0, scale * samples)
        assert renderer.sampling(view, samples)[1] == pytest.approx(NEIGHBOURS * (1 - sampled**2))
        assert Renderer.of(make_scene(30), cameras, "matched").sampling(view, samples)[1] == 0


def test_auto_is_nearer_to_the_look_of_training_than_one_plain_sample(sample_scene, sample_training, sample_cameras):
    view = sample_cameras.test[0].scaled(0.25)
    fast, best = (Renderer.of(sample_scene, sample_training, quality=quality) for quality in ("fast", "best"))
    plain = replace(fast, recipe=RECIPES["matched"])
    assert plain.samples(view) == fast.samples(view) == 1
    look = best(view).rgb
    errors = [(renderer(view).rgb - look).square().mean() for renderer in (plain, fast)]
    assert errors[1] < 0.9 * errors[0]


@pytest.mark.parametrize(("distance", "rate"), [(4.0, 1.0), (2.0, 2.0), (16.0, 0.25)])
def test_a_free_camera_has_the_rate_of_its_distance(distance, rate):
    scene = make_scene(50, dtype=torch.float64)
    scene = replace(scene, means=0.01 * scene.means)
    trained = make_camera((0.0, -4.0, 0.0))
    renderer = Renderer.of(scene, [trained])
    view = free(make_camera((0.0, -distance, 0.0)))
    assert renderer.relative_rate(view) == pytest.approx(rate, rel=0.05)
    assert renderer.relative_rate(trained.scaled(0.25)) == 0.25
    unseeing = replace(free(make_camera((0.0, -9.0, 0.0))), cx=1e6)
    assert renderer.relative_rate(unseeing) == renderer.training.relative_rate(unseeing)
    by_focal = replace(renderer, recipe=find_recipe("auto", rate_reference="global"))
    assert by_focal.relative_rate(view) == renderer.training.relative_rate(view)


def test_the_rate_of_a_free_camera_is_computed_once_per_pose(cameras, monkeypatch):
    renderer = Renderer.of(make_scene(50), cameras, rasterizer="eager")
    calls = []
    compute = rendering.sampling_bounds
    monkeypatch.setattr(rendering, "sampling_bounds", lambda *args: calls.append(args) or compute(*args))
    view = free(make_camera((0.3, -9.0, 0.2)))
    rate = renderer.relative_rate(view)
    renderer.samples(view)
    renderer.draw(view)
    renderer(replace(view, name="the same pose again"))
    assert renderer.relative_rate(view) == rate
    assert len(calls) == 1
    assert renderer.relative_rate(free(make_camera((0.3, -18.0, 0.2)))) < rate
    assert renderer.relative_rate(view.scaled(0.5)) == pytest.approx(rate / 2, rel=0.05)
    assert len(calls) == 3
    renderer(cameras[0])
    assert len(calls) == 3, "a pose of the data set needs no bounds"
    assert renderer.relative_rate(replace(view, lens=Lens("ortho"))) > 2 * rate
    monkeypatch.setattr(rendering, "KEPT_RATES", 2)
    assert [renderer.relative_rate(view.scaled(factor)) for factor in (1.0, 0.7, 0.8, 0.9, 1.0)][-1] == rate
    assert len(renderer._rates) <= 2


def test_without_a_look_at_the_scene_a_free_camera_is_compared_by_focal_length():
    training = TrainingViews.of(make_scene(10), [make_camera(), make_camera(fov=1.4)])
    focals = sorted(camera.focal for camera in training.cameras)
    assert training.relative_rate(free(make_camera())) == pytest.approx(make_camera().focal / (sum(focals) / 2))
    assert training.relative_rate(make_camera(fov=1.4).scaled(0.5)) == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("rate", "fast", "balanced", "best"),
    [(1.0, 1, 1, 1), (2.0, 1, 1, 1), (0.5, 1, 1, 2), (0.25, 1, 2, 4), (0.125, 2, 4, 8), (0.3, 1, 2, 4)],
)
def test_quality_takes_the_fewest_samples_that_reach_its_rate(rate, fast, balanced, best):
    counts = [find_recipe("auto", quality=quality).samples_at(rate) for quality in QUALITIES]
    assert counts == [fast, balanced, best]


@pytest.mark.parametrize("convention", CONVENTIONS.values(), ids=CONVENTIONS)
def test_matched_is_training_itself_at_every_view_of_the_training_size(convention, cameras):
    scene = replace(make_scene(200), convention=convention)
    training = TrainingViews.of(scene, cameras[1:])  # the first view is held out
    screen = Dilation(convention.kernel, convention.compensated)
    trained = Renderer(scene, training, replace(RECIPES["classic"], screen=screen))
    ours = [
        Renderer(scene, training, find_recipe(name, rate_reference=reference))
        for name, reference in itertools.product(("matched", "auto"), ("pose", "global", "interval"))
    ]
    for camera in cameras[:2]:
        expected = trained(camera).rgb
        assert all((r(camera).rgb - expected).abs().max() <= 1e-5 for r in ours)


def test_best_is_the_average_of_the_image_of_the_training_size():
    scene, camera = make_scene(200), make_camera(size=(64, 64))
    full = Renderer.of(scene, [camera], "classic", rasterizer="eager")(camera).rgb
    best = Renderer.of(scene, [camera], quality="best", rasterizer="eager")(camera.scaled(1 / 4))
    boxes = full.unflatten(1, (-1, 4)).unflatten(0, (-1, 4)).mean(dim=(1, 3))
    torch.testing.assert_close(best.rgb, boxes, atol=1e-6, rtol=0)
    torch.testing.assert_close(box_average(full, 4), boxes, atol=1e-6, rtol=0)


def test_order_tile_draws_what_the_reference_does_and_others_refuse_it():
    scene, camera = make_scene(200), make_camera(size=(64, 64))
    eager, exact = (
        Renderer.of(scene, [camera], find_recipe("auto", order="tile"), rasterizer=name)(camera).rgb
        for name in ("eager", "reference")
    )
    assert (eager - exact).abs().max() < 1e-4
    assert (eager - Renderer.of(scene, [camera], rasterizer="eager")(camera).rgb).abs().max() > 1e-3
    [auto] = Job.of(scene, CameraSet((camera,), ()), RenderOptions(order="tile")).named("auto")
    assert auto.order == "tile"
    with pytest.raises(UsageError, match="order: tile is for pinhole views"):
        Renderer.of(scene, [camera], find_recipe("auto", order="tile"))(replace(camera, lens=Lens("equidistant")))
    with pytest.raises(UsageError, match="rasterizer: by-depth sorts by depth; order tile needs"):
        Renderer.of(scene, [camera], find_recipe("auto", order="tile"), rasterizer=ByDepth())


class ByDepth:
    name = "by-depth"

    def __call__(self, *args: Any, **options: Any) -> Render:
        raise AssertionError


@pytest.mark.parametrize(
    ("words", "culprit"),
    [
        ({"name": "mipp"}, "recipe: 'mipp' is not one of"),
        ({"name": "auto", "quality": "great"}, "quality: 'great'"),
        ({"name": "classic", "rate_reference": "global"}, "rate_reference: .*classic"),
        ({"name": "matched", "rate_reference": "newest"}, "rate_reference: 'newest'"),
        ({"name": "auto", "order": "newest"}, "order"),
    ],
)
def test_unknown_names_are_refused(words, culprit):
    with pytest.raises(UsageError, match=culprit):
        find_recipe(**words)


F64 = torch.float64
STEP = 1e-6
RELATIVE = 1e-5
SCENE = sized(make_scene(25, seed=4, dtype=F64))
CAMERA = make_camera((0.5, -3.5, 0.4), size=(28, 20))
# a free pose: at a training pose the range of rates ends at the view itself, which is a kink
VIEW = replace(make_camera((0.7, -3.4, 0.2), size=(28, 20)), trained_focal=None).scaled(0.75)
TRAINING = TrainingViews.of(SCENE, [CAMERA, make_camera((2.0, -3.0, 1.0), size=(28, 20))])
NAMES = ("means", "quats", "log_scales", "logit_opacities", "sh", "pose")


arguments = attrgetter(  # of a recipe: everything that makes an image
    "world", "screen", "pixel", "compositor", "selection", "grid", "target_rate", "neighbours"
)
NAMED = {**RECIPES, "samples": replace(RECIPES["sa-gs"], target_rate=1.0)}
DIFFERENT = {arguments(recipe): name for name, recipe in NAMED.items()}  # one name where several are alike


def loss(recipe: Recipe, values: dict[str, Tensor]) -> Tensor:
    """A weighted sum of the image and of its alpha."""
    scene: Gaussians = replace(SCENE, **{n: v for n, v in values.items() if n != "pose"})
    view: Camera = replace(VIEW, cam_from_world=values["pose"])
    background = (0.1, 0.5, 0.9)
    image = Renderer.of(scene, TRAINING, recipe, rasterizer=Tiled(), background=background)(view)
    weights = torch.rand(*view.hw, 4, generator=torch.Generator().manual_seed(1), dtype=F64)
    return (torch.cat([image.rgb, image.alpha[..., None]], dim=2) * weights.to(image.rgb)).sum()


def direction(name: str, like: Tensor) -> Tensor:
    """A random direction; of a pose, one that turns and moves it."""
    g = torch.Generator().manual_seed(NAMES.index(name))
    if name != "pose":
        return torch.randn(like.shape, generator=g, dtype=F64)
    turn = torch.randn(3, 3, generator=g, dtype=F64)
    twist = torch.zeros(4, 4, dtype=F64)
    twist[:3, :3], twist[:3, 3] = turn - turn.T, torch.randn(3, generator=g, dtype=F64)
    return twist @ like


@pytest.mark.parametrize("recipe", DIFFERENT.values())
def test_gradients_are_finite_differences(recipe):
    """In one direction, in which the image changes as much by every leaf: an error of any of them shows."""
    chosen, fixed = NAMED[recipe], {name: getattr(SCENE, name) for name in NAMES[:-1]} | {"pose": VIEW.cam_from_world}
    values = {name: value.clone().requires_grad_() for name, value in fixed.items()}
    grads = torch.autograd.grad(loss(chosen, values), list(values.values()))
    directions = {name: direction(name, value) for name, value in fixed.items()}
    slopes = {name: (grad * directions[name]).sum().item() for name, grad in zip(NAMES, grads, strict=True)}
    least = min(abs(slope) for slope in slopes.values())
    assert least > 1e-3, f"something does not matter here: {slopes}"
    steps = {name: STEP * least / slopes[name] * directions[name] for name in NAMES}
    ends = [loss(chosen, {n: fixed[n] + sign * steps[n] for n in NAMES}).item() for sign in (1, -1)]
    slope = (ends[0] - ends[1]) / (2 * STEP)
    assert slope == pytest.approx(len(NAMES) * least, rel=RELATIVE / len(NAMES)), slopes


@pytest.mark.parametrize(
    "mode", [torch.enable_grad, torch.no_grad, torch.inference_mode], ids=lambda mode: mode.__name__
)
@pytest.mark.parametrize("held", [Gaussians, Scene.in_memory], ids=["Gaussians", "Scene"])
def test_verbs_work_in_every_mode_of_autograd_and_on_what_it_follows(mode, held, recwarn):
    with mode():
        scene = SCENE.to(torch.float32)
        scene = replace(scene, **{name: 1 * column.clone().requires_grad_() for name, column in scene.columns.items()})
        view = replace(CAMERA, cam_from_world=CAMERA.cam_from_world.clone().requires_grad_())
        scene = scene if held is Gaussians else Scene.in_memory(scene)
        level = aaplug.lod(scene, CameraSet((view,), (view,)), levels=1, steps=1, rasterizer="eager")[-1]
    assert not level.scene.means.requires_grad
    assert not [each for each in recwarn if "requires_grad" in str(each.message)]


def test_a_scene_that_was_read_in_inference_mode_has_gradients_later(tmp_path):
    aaplug.write_scene(tmp_path / "scene.ply", SCENE)
    scene = aaplug.read_scene(tmp_path / "scene.ply")
    with torch.inference_mode():
        scene.gaussians()
    pose = CAMERA.cam_from_world.clone().requires_grad_()
    renderer = Renderer.of(scene, [CAMERA], rasterizer="eager", min_seen=0.0)
    renderer(replace(CAMERA, cam_from_world=pose)).rgb.sum().backward()
    assert pose.grad is not None


def test_what_autograd_follows_is_looked_at_and_measured(recwarn):
    torch.set_warn_always(True)
    try:
        scene = replace(SCENE, means=SCENE.means.clone().requires_grad_())
        assert len(aaplug.cameras_around(scene, aaplug.Orbit(orbit=2)).train) > 0
        eye, up = torch.tensor([0.0, 0.0, -4.0], requires_grad=True), torch.tensor([0.0, -1.0, 0.0])
        pose = aaplug.look_at(eye, torch.zeros(3), up)
        pose[2, 3].backward()
        image = torch.rand(16, 16, 3, requires_grad=True)
        assert all(aaplug.METRICS[name].compare(image, image) is not None for name in ("SSIM", "FLIP"))
    finally:
        torch.set_warn_always(False)
    assert eye.grad is not None
    assert eye.grad.tolist() == [0.0, 0.0, -1.0]
    assert not [str(each.message) for each in recwarn]
    with pytest.raises(UsageError, match="motion: expected poses that require no gradients"):
        aaplug.Exposure(None, (CAMERA, replace(CAMERA, cam_from_world=pose)))
