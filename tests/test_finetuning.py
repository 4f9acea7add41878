"""Fine-tuning: gradients of the whole loss, bounds, densification, poses, and runs that nothing can spoil."""

import math
from dataclasses import replace
from functools import partial
from unittest.mock import Mock

import pytest
import torch
from skimage.metrics import structural_similarity as ssim_of_skimage

import aaplug
from aaplug import RASTERIZERS, RECIPES, VIEWERS, Camera, CameraSet, TrainingViews, finetune, write_png
from aaplug.core.colours import WHITE
from aaplug.core.gaussians import Gaussians, digest_of_scene
from aaplug.core.imaging import quantised
from aaplug.core.lenses import PINHOLE, opencv_lens
from aaplug.core.projection import rotation_matrices
from aaplug.core.sampling import sampling_bounds
from aaplug.evaluation.metrics import PSNR, psnr
from aaplug.evaluation.results import figure_of, mean
from aaplug.evaluation.truth import MEMORY, Truth, back_projected
from aaplug.finetuning import LOSSES, loop
from aaplug.finetuning.fitting import fit
from aaplug.finetuning.loop import advance, extent, least_log_scales, loss_at, run
from aaplug.finetuning.poses import moved_by, refine_pose
from aaplug.finetuning.refining import refine
from aaplug.finetuning.settings import CONSISTENCY, QUICK_SETTINGS, RATES, Settings, balance, l2, slowed
from aaplug.finetuning.state import DYNAMO_FOLDER, State, TuningJob, begin, between, leaves_of, load, save, scene_of
from aaplug.lab import mipmap_gs
from aaplug.lab.group_training import GROUP_TRAINING, drawn, regroup
from aaplug.lab.losses import l1_dssim, structural_similarity
from aaplug.lab.mipmap_gs import MIN_GRADIENT, MIN_OPACITY, MIPMAP_GS, SPLIT_SHRINKAGE, densify, moments_after
from aaplug.methods.presets import recipe_of
from aaplug.rendering.renderer import Renderer, own_look
from aaplug.system.cores import FREE_CORES
from aaplug.system.errors import FormatError, UsageError
from aaplug.system.executors import torch_threads
from aaplug.system.monitor import SILENT
from tests.conftest import make_camera, make_scene, moved, run_python, with_photographs
from tests.test_announce import Heard

F64 = torch.float64
EYES = [(0.5, -3.5, 0.4), (2.0, -3.0, 1.0), (-2.5, -3.0, 0.2)]
VIEWS = tuple(make_camera(eye, size=(32, 24), name=f"view{i}", fov=0.9) for i, eye in enumerate(EYES))
WEIGHTS = {0.5: 1.0, 0.25: 2.0}
SETTINGS = Settings("test", 6, WEIGHTS, RATES, anchor=3.0, decay=0.1)
GREY = (0.5, 0.5, 0.5)


def make_job(
    n: int = 60, settings: Settings = SETTINGS, dtype: torch.dtype = torch.float32, recipe: str = "matched"
) -> TuningJob:
    scene = make_scene(n, seed=4, dtype=dtype)
    look = own_look(scene, TrainingViews.of(scene, VIEWS), RASTERIZERS["eager"], GREY)
    truth = Truth(look, enlarge=back_projected, memory=MEMORY)
    return TuningJob(replace(look, recipe=RECIPES[recipe]), VIEWS, truth, settings)


def after(job: TuningJob, steps: int | None = None) -> State:
    state = begin(job)
    for _ in range(job.settings.steps if steps is None else steps):
        advance(job, state)
    return state


def test_the_number_of_threads_plays_no_part(monkeypatch):
    monkeypatch.setattr(FREE_CORES, "count", lambda: 2)
    states = []
    for threads in (1, 2):
        with torch_threads(1, threads):
            states.append(after(make_job(300), 2))
    one, two = states
    assert one.curve == two.curve
    assert all(torch.equal(leaf, two.leaves[name]) for name, leaf in one.leaves.items())


def test_tuning_draws_straight_views(monkeypatch):
    """Gradients through a lens are not compiled, and viewers draw pinholes."""
    bent, lenses, splats = [replace(view, lens=opencv_lens((-0.1,))) for view in VIEWS], [], Renderer.splats
    monkeypatch.setattr(Renderer, "splats", lambda self, view, *a: lenses.append(view.lens) or splats(self, view, *a))
    scene = make_scene(30)
    look = own_look(scene, TrainingViews.of(scene, bent), RASTERIZERS["eager"], GREY)
    fit(scene, VIEWERS["mip"], look, bent, 1)
    refine(scene, 0.5, look, bent, 1, None, SILENT, ())
    assert {*lenses} == {PINHOLE}
    lenses.clear()
    finetune(scene, CameraSet(tuple(bent), tuple(bent[:1])), None, steps=1, min_seen=0.0)
    assert {*lenses} == {PINHOLE, bent[0].lens}, "steps and measurements"


def test_steps_draw_by_several_rules_in_turn(monkeypatch):
    """As for khr, whose files programs show by rules of their own."""
    tuning = Mock(side_effect=KeyboardInterrupt)
    monkeypatch.setattr("aaplug.finetuning.fitting.tune", tuning)
    scene, look = make_scene(60), make_job().truth.renderer
    with pytest.raises(KeyboardInterrupt):
        fit(scene, VIEWERS["khr"], look, VIEWS, 1)
    recipes = tuning.call_args.args[0].recipes
    assert recipes == [recipe_of(VIEWERS[name]) for name in ("khr", "cesium", "babylon-classic")]
    state = begin(job := replace(make_job(), recipes=recipes))
    for state.step in range(4):
        one = replace(make_job(), recipes=[recipes[state.step % 3]])
        assert loss_at(job, state, VIEWS[0], 0.5)[0] == loss_at(one, state, VIEWS[0], 0.5)[0]
    assert len({replace(job, recipes=turns).facts["recipe"] for turns in (recipes, recipes[::-1], ())}) == 3


def test_a_scene_for_several_rules_is_measured_by_each():
    look = make_job().truth.renderer
    result, report = fit(make_scene(60), VIEWERS["khr"], look, VIEWS, 0)
    programs = {"": "khr", " in CesiumJS 1.145.0": "cesium", " in Babylon.js 9.35.0": "babylon-classic"}
    for program, name in programs.items():
        shown = replace(look, scene=result, recipe=recipe_of(VIEWERS[name]))
        [figure] = (m for m in report.select("converted" + program, 1.0) if m.view == VIEWS[0].name)
        expected = psnr(*(quantised(renderer(VIEWS[0]).rgb) for renderer in (shown, look)))
        assert figure.values["PSNR"] == pytest.approx(expected, abs=1e-9)


def test_ssim_is_skimages():
    a, b = torch.rand(2, 30, 41, 3, dtype=F64)
    options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    expected = ssim_of_skimage(a.numpy(), b.numpy(), data_range=1.0, channel_axis=2, **options)  # crops the border
    assert structural_similarity(a, b).item() == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("loss", LOSSES.values(), ids=LOSSES)
@pytest.mark.parametrize("hw", [(20, 30), (4, 7), (1, 1)])
def test_losses_are_0_where_images_are_equal_and_only_there(loss, hw):
    image = torch.rand(*hw, 3, dtype=F64)
    assert loss(image, image).item() == pytest.approx(0.0, abs=1e-12)
    assert loss(image, image + 0.1).item() > 1e-4


def test_losses_are_the_papers():
    image, truth = torch.full((12, 12, 3), 0.5).double(), torch.full((12, 12, 3), 0.3).double()
    assert l2(image, truth).item() == pytest.approx(0.04)
    luminance = (2 * 0.15 + 1e-4) / (0.25 + 0.09 + 1e-4)
    assert l1_dssim(image, truth).item() == pytest.approx(0.8 * 0.2 + 0.2 * (1 - luminance), rel=1e-6)


@pytest.mark.parametrize(("loss", "recipe"), [("l1-dssim", "matched"), ("l2", "mip")])
def test_gradients_of_the_whole_loss_are_finite_differences(loss, recipe):
    job = make_job(25, replace(SETTINGS, loss=loss), F64, recipe)
    white = replace(job.truth, renderer=replace(job.truth.renderer, background=WHITE))
    job = replace(job, truth=white)  # far from the kinks of L1
    generator = torch.Generator().manual_seed(2)
    leaves = {
        name: value + 0.05 * torch.randn(value.shape, generator=generator, dtype=F64)
        for name, value in leaves_of(job.start.scene).items()
    }  # away from where the training size has no error at all

    def total(*values):
        state = replace(begin(job), leaves=dict(zip(leaves, values, strict=True)))
        return sum(w * loss_at(job, state, VIEWS[0], s)[0] for s, w in {**WEIGHTS, 1.0: 3.0}.items())

    moving = [value.clone().requires_grad_() for value in leaves.values()]
    assert torch.autograd.gradcheck(total, moving, rtol=1e-4, atol=1e-9, fast_mode=True)
    for name, grad in zip(leaves, torch.autograd.grad(total(*moving), moving), strict=True):
        assert grad.norm() > 1e-6, f"{name} does not matter here"


def test_steps_lower_the_loss_at_every_scale():
    job = make_job(60, replace(SETTINGS, steps=24))

    def losses(scene: Gaussians) -> list[float]:
        state = replace(begin(job), leaves=leaves_of(scene))
        return [sum(loss_at(job, state, view, scale)[0].item() for view in VIEWS) for scale in WEIGHTS]

    before, now = losses(job.start.scene), losses(after(job).scene(job))
    assert all(b < 0.9 * a for a, b in zip(before, now, strict=True)), (before, now)


def test_only_what_has_a_rate_moves():
    job = make_job(settings=replace(SETTINGS, rates={"dc": 0.1}))
    state = after(job, 3)
    for name, leaf in leaves_of(job.start.scene).items():
        assert torch.equal(leaf, state.leaves[name]) == (name != "dc"), name


def test_the_result_is_the_mean_of_the_last_steps():
    job = make_job(settings=replace(SETTINGS, averaged=0.5))
    alone, state = begin(job), begin(job)
    steps = []
    for _ in range(SETTINGS.steps):
        advance(job, alone)
        steps.append({name: leaf.detach().clone() for name, leaf in alone.leaves.items()})
    run(job, state)
    for name, leaf in state.leaves.items():
        torch.testing.assert_close(leaf.detach(), sum(step[name] for step in steps[3:]) / 3, rtol=1e-6, atol=1e-6)


def test_infinite_parameters_are_averaged_as_what_they_look_like():
    job = make_job(settings=replace(SETTINGS, averaged=0.5))
    job.start.scene.logit_opacities[:2] = torch.tensor([-torch.inf, torch.inf])
    job.start.scene.log_scales[2, 0] = -torch.inf
    state = begin(job)
    run(job, state)
    assert all(leaf.isfinite().all() for leaf in state.leaves.values())
    assert state.leaves["logit_opacities"][:2].sigmoid().tolist() == pytest.approx([0, 1], abs=1e-3)


def test_no_step_leaves_a_gaussian_thinner_than_its_bound():
    job = make_job(settings=replace(SETTINGS, rates={"log_scales": 0.5}, anchor=0.0))
    first, nyquist = job.start.scene.log_scales, 0.2**0.5 / job.start.training.bounds.highest_or_coarsest[:, None]
    bound = least_log_scales(first, job.start.training.bounds)
    torch.testing.assert_close(bound, torch.minimum(first, nyquist.log()))  # or where the Gaussian started
    assert {True, False} == set((first < nyquist.log()).flatten().tolist())
    state = begin(job)
    held = 0
    for _ in range(6):
        advance(job, state)
        held += int((state.leaves["log_scales"] == bound).sum())
        assert (state.leaves["log_scales"] >= bound).all()
    assert held > 10


def test_densify_clones_the_small_splits_the_large_and_prunes_the_faint():
    sizes, opacities = torch.tensor([-6.0, -6.0, 0.0, 0.0])[:, None].repeat(1, 3), torch.tensor([1.0, -9.0, 1.0, 1.0])
    scene = replace(make_scene(4), log_scales=sizes, logit_opacities=opacities)
    pull = torch.tensor([2 * MIN_GRADIENT, 0.0, 2 * MIN_GRADIENT, 0.0])
    change = densify(scene, pull, 1.0, torch.Generator().manual_seed(0))
    assert change.sources.tolist() == [0, 3, 0, 2, 2]
    assert change.new.tolist() == [False, False, True, True, True]
    clone, halves = change.scene[2:3], change.scene[3:]
    assert torch.equal(clone.means[0], scene.means[0])
    torch.testing.assert_close(halves.log_scales, scene.log_scales[2:] - math.log(SPLIT_SHRINKAGE))
    assert not torch.equal(halves.means[0], halves.means[1])
    assert (change.scene.opacities >= MIN_OPACITY).all()


def test_halves_lie_where_the_gaussian_lies():
    scene = make_scene(1)
    scene = replace(scene, log_scales=torch.tensor([[1.0, -3.0, -5.0]]))
    many = scene[torch.zeros(4000, dtype=torch.long)]
    change = densify(many, torch.full((4000,), 1.0), 0.1, torch.Generator().manual_seed(1))  # all are split
    offsets = (change.scene.means - scene.means).double()
    along = offsets @ rotation_matrices(scene.unit_quats.double())[0]
    torch.testing.assert_close(along.std(dim=0), scene.scales[0].double(), rtol=0.05, atol=0)


def test_the_optimizer_forgets_what_is_new_alone():
    change = densify(make_scene(3), torch.tensor([1.0, 0.0, 0.0]), 1e9, torch.Generator().manual_seed(0))
    moments = {"step": torch.tensor(5.0), "exp_avg": torch.arange(1.0, 4.0)[:, None]}
    found = moments_after(moments, change)
    assert found["exp_avg"][:, 0].tolist() == [1.0, 2.0, 3.0, 0.0]
    assert found["step"] == 5


def test_a_densified_scene_is_reported_with_its_own_bounds(monkeypatch):
    """The scene before has fewer Gaussians, and `matched` reads a bound of each."""
    monkeypatch.setattr(mipmap_gs, "STEPS", 2)
    state = after(job := replace(make_job(settings=replace(SETTINGS, steps=4)), method=MIPMAP_GS))
    here = sampling_bounds(state.leaves["means"].detach(), job.start.training.cameras)
    assert len(state.bounds.highest) == len(state.leaves["means"]) > 60
    torch.testing.assert_close(state.bounds.highest, here.highest, rtol=0.1, atol=0.0)
    cameras = CameraSet(VIEWS, VIEWS, background=GREY)
    settings = {"method": "mipmap-gs", "scale": (0.25,), "steps": 3}
    found = finetune(make_scene(60, seed=4), cameras, **settings, truth="self", views="view0", rasterizer="eager")
    assert len(found.scene) > 60
    assert [m.recipe for m in found.report.measurements] == ["before"] * 2 + ["after"] * 2
    assert all(m.values["PSNR"] for m in found.report.measurements if m.recipe == "after")


def test_a_group_trains_alone_and_is_drawn_anew_as_the_published_code_does_in_proportion():
    settings = replace(SETTINGS, steps=60)
    job = replace(make_job(settings=settings), method=GROUP_TRAINING)
    state, groups, moved = begin(job), [], {}
    for step in range(60):
        if step in (4, 29, 58):  # a group, and all
            before = {name: leaf.detach().clone() for name, leaf in state.leaves.items()}
            advance(job, state)
            moved[step] = int((state.leaves["dc"] != before["dc"]).flatten(1).any(dim=1).sum())
            inside = torch.arange(60) if state.group is None else state.group
            others = torch.ones(60, dtype=torch.bool).index_fill_(0, inside, False)
            for name, leaf in state.leaves.items():
                assert torch.equal(leaf[others], before[name][others]), name
        else:
            state.step = step
            regroup(state, settings)
            state.step = step + 1
        groups.append(state.group)
    assert [i for i, group in enumerate(groups) if group is None] == [0, 1, 29, 58, 59]
    assert {len(group) for group in groups if group is not None} == {36}
    assert 0 < moved[4] <= 36 < moved[29]
    assert not torch.equal(groups[2], groups[3])


def test_groups_are_drawn_by_opacity():
    opacities = torch.cat([torch.full((500,), 0.9), torch.full((500,), 0.1)])
    group = drawn(opacities, 0.3, torch.Generator().manual_seed(1))
    assert len(group.unique()) == 300
    assert 230 < int((group < 500).sum()) < 290  # 300 draws with replacement would hit them 270 times


@pytest.mark.parametrize(
    ("method", "stopped_at", "averaged"), [(CONSISTENCY, 2, 0.8), (MIPMAP_GS, 3, 0.0), (GROUP_TRAINING, 3, 0.0)]
)
def test_a_run_that_was_stopped_and_resumed_is_one_that_never_was(method, stopped_at, averaged, tmp_path, monkeypatch):
    monkeypatch.setattr(mipmap_gs, "STEPS", 2)
    job = replace(make_job(settings=replace(SETTINGS, averaged=averaged)), method=method)
    whole = begin(job)
    assert run(job, whole, every=2)
    first = begin(job)

    def keep(state):
        save(tmp_path / "run.pt", job, state)

    assert not run(job, first, every=2, keep=keep, stop=lambda: first.step == stopped_at)
    again = load(tmp_path / "run.pt", job)
    assert again.step == stopped_at
    assert run(job, again, every=2, keep=keep)
    assert (again.step, again.curve) == (whole.step, whole.curve)
    for name, leaf in again.leaves.items():
        assert torch.equal(leaf, whole.leaves[name]), name


def spoil(monkeypatch, bad_steps: set[int]) -> None:
    """Make the gradient of these steps, counted from 0, not a number."""
    calls = iter(range(10**6))
    real = loop.loss_at

    def spoiled(job, state, view, scale):
        loss, drawing = real(job, state, view, scale)
        return (loss * math.nan if next(calls) // 2 in bad_steps else loss), drawing

    monkeypatch.setattr(loop, "loss_at", spoiled)


WITHOUT_SAME = replace(SETTINGS, weights={0.5: 1.0})  # two losses a step


def test_a_step_without_a_finite_gradient_changes_nothing(monkeypatch):
    job = make_job(settings=WITHOUT_SAME)
    state = after(job, 3)
    before = state.scene(job)
    spoil(monkeypatch, {0})
    advance(job, state)
    assert (state.step, state.bad_steps, len(state.curve)) == (4, 1, 3)
    assert torch.equal(state.scene(job).means, before.means)
    advance(job, state)
    assert (state.step, state.bad_steps, len(state.curve)) == (5, 0, 4)


def test_a_run_ends_where_no_step_has_a_finite_gradient(monkeypatch):
    job = make_job(settings=replace(WITHOUT_SAME, steps=8))
    monkeypatch.setattr(loop, "MAX_BAD_STEPS", 3)
    spoil(monkeypatch, {1, 2, 4, 5})
    state = begin(job)
    assert run(job, state)
    assert [entry["step"] for entry in state.curve] == [1, 4, 7, 8]
    spoil(monkeypatch, {0, 3, 4, 5})
    with pytest.raises(UsageError, match="no finite gradient at step 6, nor at the 2 before"):
        run(job, begin(job))


def test_checkpoints_of_others_are_refused(tmp_path):
    job, path = make_job(), tmp_path / "run.pt"
    save(path, job, begin(job))
    for content in (b"not a checkpoint", path.read_bytes()[:-100]):
        (tmp_path / "damaged.pt").write_bytes(content)
        with pytest.raises(FormatError, match="damaged"):
            load(tmp_path / "damaged.pt", job)
    torch.save(torch.load(path) | {"version": 1}, tmp_path / "old.pt")
    said = "another version: expected aaplug finetune 10, got aaplug finetune 1; start again with `overwrite`"
    with pytest.raises(FormatError, match=said):
        load(tmp_path / "old.pt", job)
    with pytest.raises(UsageError, match="steps changed from 6 to 13; repeat that run, or start again with"):
        load(path, replace(job, settings=replace(SETTINGS, steps=13)))


A_LITTLE = (1e-9, 0.0, 0.0)
CHANGES = {
    "views": lambda job: replace(job, views=[moved(job.views[0], A_LITTLE), *job.views[1:]]),
    "training cameras": lambda job: replace(
        job, start=replace(job.start, training=replace(job.start.training, cameras=[moved(v, A_LITTLE) for v in VIEWS]))
    ),
    "scene": lambda job: replace(
        job, start=replace(job.start, scene=replace(job.start.scene, filter_3d=torch.ones(len(job.start.scene))))
    ),
    "truth": lambda job: replace(job, upsampler="lanczos"),
    "recipe": lambda job: replace(
        job, start=replace(job.start, recipe=replace(job.start.recipe, screen=RECIPES["mip"].screen))
    ),
}


@pytest.mark.parametrize("key", CHANGES)
def test_a_checkpoint_is_of_all_that_the_result_depends_on(tmp_path, key):
    job, path = make_job(), tmp_path / "run.pt"
    save(path, job, begin(job))
    with pytest.raises(UsageError, match=f"another run: {key} changed from"):
        load(path, CHANGES[key](job))


def test_a_checkpoint_is_of_its_photographs(tmp_path):
    photo, path = tmp_path / "photo.png", tmp_path / "run.pt"
    write_png(photo, torch.zeros(*VIEWS[0].hw, 3))
    job = make_job()
    views = [replace(view, photo=photo) for view in job.views]
    job = replace(job, views=views, truth=replace(job.truth, source="photographs"))
    save(path, job, begin(job))
    write_png(photo, torch.ones(*VIEWS[0].hw, 3), overwrite=True)
    with pytest.raises(UsageError, match="photographs changed from"):
        load(path, replace(job))


def test_what_a_run_depends_on_is_hashed_once(tmp_path, monkeypatch):
    job, hashed = make_job(), []
    told = "aaplug.finetuning.state.digest_of_scene"
    monkeypatch.setattr(told, lambda scene: hashed.append(scene) or digest_of_scene(scene))
    for _ in range(3):
        save(tmp_path / "run.pt", job, begin(job))
    assert len(hashed) == 2  # the start, and the truth's scene


def test_the_extent_is_that_of_the_training_cameras():
    centres = torch.stack([view.centre for view in VIEWS])
    assert extent(VIEWS) == pytest.approx(1.1 * (centres - centres.mean(0)).norm(dim=1).max().item())
    assert extent(VIEWS[:1]) == 1.0


def test_between_two_scenes_are_both_and_what_is_half_way():
    start, end = make_scene(5, seed=1), make_scene(5, seed=2)
    for share, expected in ((0.0, start), (1.0, end)):
        found = between(start, end, share)
        for name in ("means", "quats", "log_scales", "logit_opacities", "sh"):
            assert torch.equal(getattr(scene_of(leaves_of(expected), start), name), getattr(expected, name))
            torch.testing.assert_close(getattr(found, name), getattr(expected, name))
    half = between(start, end, 0.5)
    torch.testing.assert_close(half.means, 0.5 * (start.means + end.means))


def test_balanced_weights_are_against_the_roots_of_errors():
    errors = {1.0: 1e-4, 0.5: 4e-4, 0.25: 1e-2, 0.125: 1.0}
    found = balance(QUICK_SETTINGS, errors)
    assert found.weights == pytest.approx({0.5: 50.0, 0.25: 10.0, 0.125: 1.0})
    assert found.anchor == pytest.approx(QUICK_SETTINGS.anchor * 100)


def test_rates_are_lower_in_proportion_where_the_start_is_close():
    settings = replace(QUICK_SETTINGS, weights={1.0: 1.0, 0.5: 3.0}, anchor=2.0, usual_error=0.02)
    for root, share in ((0.04, 1.0), (0.02, 1.0), (0.005, 0.25), (0.0, 0.0)):
        for errors in ({1.0: root**2, 0.5: root**2}, {1.0: 0.0, 0.5: root**2 * (0.5 + 2 + 1.5) / 1.5}):
            found = slowed(settings, errors).rates
            assert found == pytest.approx({name: share * rate for name, rate in settings.rates.items()})
    assert slowed(replace(settings, usual_error=0.0), {1.0: 0.0, 0.5: 0.0}).rates == settings.rates


def test_a_scene_that_is_close_is_tuned_slowly(monkeypatch):
    scene = make_scene(40, seed=4)
    scene = replace(scene, log_scales=scene.log_scales.clamp(min=-0.7))  # several pixels: right at half the size, too
    settings = {"scale": (0.5,), "steps": 2, "rasterizer": "eager", "views": "view0"}
    curve = finetune(scene, CameraSet(VIEWS, VIEWS, background=GREY), **settings).curve
    assert curve[1]["loss"][0.5] < 2 * curve[0]["loss"][0.5]
    tuning = Mock(side_effect=KeyboardInterrupt)
    monkeypatch.setattr("aaplug.finetuning.fitting.tune", tuning)
    with pytest.raises(KeyboardInterrupt):
        fit(scene, VIEWERS["mip"], make_job().truth.renderer.showing(scene), VIEWS, 1)
    assert tuning.call_args.args[0].settings.rates["dc"] < 0.5 * QUICK_SETTINGS.rates["dc"]


def test_a_run_begins_without_a_file_among_the_temporary_ones(tmp_path, monkeypatch):
    program = "from tests.test_finetuning import begin, make_job; begin(make_job()); import os; print(os.environ)"
    monkeypatch.delenv(DYNAMO_FOLDER, raising=False)
    done = run_python(program, TMPDIR=tmp_path)
    assert done.stdout, done.stderr
    assert DYNAMO_FOLDER not in done.stdout
    assert not [*tmp_path.iterdir()]


CHANGE = torch.tensor([0.006, -0.008, 0.005, 0.004, -0.005, 0.006], dtype=torch.float64)  # radians, shares of the depth
DEPTH = 4.0


@pytest.fixture(scope="module")
def photographed(tmp_path_factory):
    """A scene and two views with photographs, which the scene itself made."""
    scene, eyes = make_scene(200, seed=3), [(0.5, -4.0, 0.4), (2.6, -3.0, 1.0)]
    views = [make_camera(eye, size=(128, 96), name=f"view{i}") for i, eye in enumerate(eyes)]
    return scene, with_photographs(Renderer.of(scene, views, min_seen=0.0), views, tmp_path_factory.mktemp("photos"))


def apart(a: Camera, b: Camera) -> tuple[float, float]:
    """Angle in degrees and distance in world units between two cameras."""
    cosine = ((a.cam_from_world[:3, :3] * b.cam_from_world[:3, :3]).sum() - 1) / 2
    return math.degrees(math.acos(min(1.0, float(cosine)))), float((a.centre - b.centre).norm())


def test_a_change_turns_about_the_point_ahead_and_shifts_by_shares_of_its_depth():
    camera = make_camera((0.0, -4.0, 0.0))
    ahead = camera.centre + DEPTH * camera.cam_from_world[2, :3]
    turned = moved_by(camera, torch.cat([CHANGE[:3], torch.zeros(3)]), DEPTH)
    place, depth = turned.project(ahead[None])
    assert torch.allclose(place, camera.project(ahead[None])[0], atol=1e-9)
    assert float(depth) == pytest.approx(DEPTH)
    assert apart(turned, camera)[0] == pytest.approx(math.degrees(float(CHANGE[:3].norm())))
    shifted = moved_by(camera, torch.cat([torch.zeros(3), CHANGE[3:]]), DEPTH)
    assert apart(shifted, camera) == (pytest.approx(0, abs=1e-5), pytest.approx(DEPTH * float(CHANGE[3:].norm())))


def test_the_gradient_of_a_change_equals_finite_differences():
    camera, places = make_camera((0.5, -4.0, 0.4)), make_scene(20, dtype=torch.float64).means
    for at in (CHANGE, torch.zeros(6, dtype=torch.float64)):
        start = at.clone().requires_grad_()
        assert torch.autograd.gradcheck(lambda change: moved_by(camera, change, DEPTH).project(places), start)


def test_poses_that_are_off_come_back_and_right_ones_stay(photographed):
    scene, cameras = photographed
    off = CameraSet((moved_by(cameras.train[0], CHANGE, DEPTH), cameras.train[1]), ())
    found, poses = aaplug.refine_poses(scene, off, min_seen=0.0)
    degrees, distance = apart(off.train[0], cameras.train[0])
    left, right = found.train
    assert apart(left, cameras.train[0])[0] < degrees / 5
    assert apart(left, cameras.train[0])[1] < distance / 5
    assert right == cameras.train[1]
    first, second = poses
    assert first.after < first.before / 5
    assert (first.degrees, first.distance) == pytest.approx(apart(left, off.train[0]))
    assert (second.degrees, second.distance, second.after) == (0.0, 0.0, second.before)


@pytest.mark.parametrize(
    "lens", [opencv_lens((-0.2, 0.05)), opencv_lens((0.05,), fisheye=True)], ids=["barrel", "fisheye"]
)
def test_poses_of_bent_photographs_come_back(photographed, lens, tmp_path, monkeypatch):
    """Of a pinhole's by straightened ones, because gradients through a lens are not compiled."""
    scene, cameras = photographed
    bent, search, tried = replace(cameras.train[0], lens=lens), refine_pose, []
    right = with_photographs(Renderer.of(scene, cameras, "matched", min_seen=0.0), [bent], tmp_path)
    monkeypatch.setattr("aaplug.finetuning.poses.refine_pose", lambda r, view: tried.append(view) or search(r, view))
    off = CameraSet(tuple(moved_by(view, CHANGE, DEPTH) for view in right.train), ())
    found, _ = aaplug.refine_poses(scene, off, min_seen=0.0)
    assert [view.lens for view in tried] == [PINHOLE if lens.flat else lens]
    assert found.train == (replace(right.train[0], cam_from_world=found.train[0].cam_from_world),)
    assert apart(found.train[0], bent)[0] < apart(off.train[0], bent)[0] / 4


def test_coarse_scales_lead_farther_than_fine_ones(photographed):
    scene, cameras = photographed
    renderer = Renderer.of(scene, cameras, min_seen=0.0)
    off = moved_by(cameras.train[0], 14 * CHANGE, DEPTH)
    coarse_to_fine, fine = (refine_pose(renderer, off, scales).camera for scales in ((1 / 8, 1 / 4, 1 / 2), (1 / 2,)))
    assert apart(coarse_to_fine, cameras.train[0])[0] < apart(fine, cameras.train[0])[0] / 2


def test_a_move_that_makes_up_for_aliasing_is_no_gain(tmp_path):
    """At the training size, a square wall of small Gaussians has a sharp edge, which a smaller render misplaces."""
    side = torch.linspace(-0.6, 0.6, 20)
    x, z = torch.meshgrid(side, side, indexing="ij")
    scene, view = make_scene(x.numel(), degree=0), make_camera((0.5, -4.0, 0.4), size=(16, 16))
    scene = replace(
        scene,
        means=torch.stack([x, torch.zeros_like(x), z], dim=2).flatten(0, 1),
        log_scales=torch.full_like(scene.log_scales, -2.8),
        logit_opacities=torch.full_like(scene.logit_opacities, 6.0),
        sh=torch.full_like(scene.sh, 1.5),
    )
    renderer = Renderer.of(scene, [view], min_seen=0.0)
    write_png(tmp_path / "wall.png", renderer(view).rgb.clamp(0, 1))
    found = refine_pose(renderer, replace(view, photo=tmp_path / "wall.png"), (1 / 2,))
    assert (found.degrees, found.distance) == (0.0, 0.0)


def test_a_view_without_a_photograph_is_named(photographed):
    scene, cameras = photographed
    bare = CameraSet((replace(cameras.train[0], photo=None),), ())
    tune = partial(aaplug.finetune, poses=True, truth="self", steps=1, rasterizer="eager")
    for refines in (aaplug.refine_poses, tune):
        with pytest.raises(aaplug.UsageError, match=r"^view0: has no photograph, on which its pose is refined$"):
            refines(scene, bare, min_seen=0.0)


def test_evaluate_tells_errors_of_poses_from_others(photographed):
    scene, cameras = photographed
    off = CameraSet(*[tuple(moved_by(view, CHANGE, DEPTH) for view in cameras.train)] * 2)
    how = {"min_seen": 0.0, "recipe": "classic", "scale": (1.0,), "metric": "psnr", "rasterizer": "eager"}
    heard = Heard(), Heard()
    before, after = (aaplug.evaluate(scene, off, None, poses=p, monitor=heard[p], **how) for p in (False, True))
    assert [line for line in heard[1].said if "poses moved" not in line] == heard[0].said
    gained = mean(after.select("classic", 1.0), "PSNR") - mean(before.select("classic", 1.0), "PSNR")
    assert gained > 6
    [note] = [note for note in after.protocol["cameras"]["notes"] if "poses" in note]
    assert note.startswith("2 of 2 poses moved")
    with pytest.raises(aaplug.UsageError, match="poses: are refined on photographs"):
        aaplug.evaluate(scene, off, None, poses=True, truth="self", **how)


def test_finetune_refines_poses_first(photographed, monkeypatch):
    scene, cameras = photographed
    found = cameras, ()  # the search itself is tried above
    monkeypatch.setattr("aaplug.verbs.finetune.refined", lambda look, cameras, views, monitor: found)
    off = tuple(moved_by(view, CHANGE, DEPTH) for view in cameras.train)
    how = {"min_seen": 0.0, "steps": 1, "scale": (0.5,), "rasterizer": "eager"}
    errors = []
    for poses in (False, True):
        tuned = aaplug.finetune(scene, CameraSet(off, off), None, poses=poses, **how)
        errors.append(figure_of(PSNR, tuned.report.select("before", 1.0)))
    assert errors[1] > errors[0] + 6
