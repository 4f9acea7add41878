"""Gradients of an image in a scene and a pose, against finite differences.

The laws of pixel kernels compare them with the reference's, and those of filters with their formulas.
"""

from dataclasses import replace
from operator import attrgetter

import pytest
import torch
from torch import Tensor

import aaplug
from aaplug import RECIPES, Camera, CameraSet, Gaussians, Recipe, Renderer, Scene, TrainingViews, UsageError
from aaplug.rasterizers.tiled import Tiled
from tests.conftest import make_camera, make_scene, sized

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
