"""aaplug as a method of nerfbaselines: its checkpoints, its images and what it refuses."""

import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from aaplug import Camera, FormatError, Renderer, UsageError, read_scene, write_scene
from aaplug.core.colours import WHITE
from aaplug.core.imaging import quantised
from aaplug.evaluation.data_sets import MIP_NERF_360, NERF_SYNTHETIC
from aaplug.evaluation.metrics import psnr, ssim
from tests.conftest import make_camera, make_scene

EYES = [(0.3, -3.0, 0.4), (2.5, -1.0, -0.5), (-2.0, -2.0, 0.3)]


@pytest.fixture
def method(monkeypatch, stand_in):
    """The module, loaded beside nerfbaselines, or where that is missing beside what the module asks of it."""
    specs = []
    stand_in("nerfbaselines", register=specs.append)
    monkeypatch.delitem(sys.modules, "aaplug.evaluation.nerfbaselines", raising=False)
    import aaplug.evaluation.nerfbaselines as module

    assert specs[0]["id"] == "aaplug"
    assert specs[0]["method_class"] == f"{module.__name__}:{module.Aaplug.__name__}"
    yield module
    sys.modules.pop("aaplug.evaluation.nerfbaselines", None)


def theirs(view: Camera) -> SimpleNamespace:
    """A camera as nerfbaselines gives it."""
    pose = torch.linalg.inv(view.cam_from_world)[:3].numpy().astype(np.float32)
    intrinsics, sizes = np.array([view.fx, view.fy, view.cx, view.cy], np.float32), np.array([view.width, view.height])
    camera = SimpleNamespace(poses=pose, intrinsics=intrinsics, image_sizes=sizes)
    camera.item = lambda: camera
    return camera


@pytest.fixture
def scene_file(tmp_path):
    write_scene(tmp_path / "scene.ply", make_scene(80))
    return tmp_path / "scene.ply"


def dataset() -> dict[str, object]:
    return {
        "cameras": [theirs(make_camera(eye)) for eye in EYES],
        "image_paths": ["/data/r_0.png", "/elsewhere/r_0.png", "/elsewhere/r_0.png"],  # outside the root, and twice
        "image_paths_root": "/data",
        "metadata": {"background_color": np.array([255, 255, 255], np.uint8)},
    }


@pytest.mark.parametrize("recipe", ["auto", "classic"])
def test_images_are_the_renderers_also_from_a_checkpoint(method, scene_file, tmp_path, recipe):
    chosen = {"scene": str(scene_file), "recipe": recipe}
    made = method.Aaplug(train_dataset=dataset(), config_overrides=chosen)
    made.save(str(tmp_path / "checkpoint"))
    loaded = method.Aaplug(checkpoint=str(tmp_path / "checkpoint"))
    assert loaded.get_info()["hparams"] == made.get_info()["hparams"]
    assert (made.get_info()["loaded_step"], loaded.get_info()["loaded_step"]) == (None, 0)
    assert len(loaded.cameras) == 3
    views = [make_camera(eye) for eye in EYES]
    renderer = Renderer.of(read_scene(scene_file).gaussians(), views, recipe, background=WHITE)
    for view in (views[1], replace(views[1].scaled(0.5), trained_focal=None)):
        expected = renderer(view)
        for each in (made, loaded):
            found = each.render(theirs(view), options={"output_type_dtypes": {"color": "float32"}})
            assert found["color"].dtype == np.float32
            assert np.abs(found["color"] - expected.rgb.clamp(0, 1).numpy()).max() < 1e-4
            assert np.abs(found["accumulation"] - expected.alpha.numpy()).max() < 1e-4
        stored = made.render(theirs(view))["color"]
        assert stored.dtype == np.uint8
        assert np.abs(stored / 255 - found["color"]).max() < 0.6 / 255


ODD_SETTINGS = [
    *("{", "[]", "{}", '{"recipe": "auto", "quality": "best", "background": [0, 2, 0]}'),
    *('{"recipe": 3, "quality": "best", "background": [0, 0, 0]}', '{"recipe": "auto", "background": [0, 0, 0]}'),
]


@pytest.mark.parametrize("settings", ODD_SETTINGS)
def test_settings_of_a_checkpoint_are_checked(method, scene_file, tmp_path, settings):
    method.Aaplug(train_dataset=dataset(), config_overrides={"scene": str(scene_file)}).save(str(tmp_path / "made"))
    (tmp_path / "made" / "aaplug.json").write_text(settings)
    with pytest.raises(FormatError, match=r"aaplug\.json: "):
        method.Aaplug(checkpoint=str(tmp_path / "made"))


def test_what_is_missing_or_not_known_is_said(method, scene_file):
    for words, message in (
        ({"train_dataset": dataset()}, "--set scene: name the file of the scene"),
        ({"config_overrides": {"scene": str(scene_file)}}, "--set scene: name the file of the scene"),
        ({"config_overrides": {"steps": 3}}, "--set steps: 'steps' is not one of scene, recipe, quality"),
        ({"train_dataset": dataset(), "config_overrides": {"scene": str(scene_file), "recipe": "x"}}, "recipe: 'x'"),
    ):
        with pytest.raises(UsageError) as error:
            method.Aaplug(**words)
        assert str(error.value).startswith(message)
    made = method.Aaplug(train_dataset=dataset(), config_overrides={"scene": str(scene_file)})
    with pytest.raises(UsageError, match="trains nothing"):
        made.train_iteration(0)
    assert made.get_method_info()["supported_camera_models"] == {"pinhole"}


def test_nerfbaselines_finds_the_method_and_takes_it_for_one():
    package = pytest.importorskip("nerfbaselines", reason="the package nerfbaselines is not installed")
    with package.build_method_class(package.get_method_spec("aaplug"), backend="python") as found:
        assert issubclass(found, package.Method)


def test_its_scenes_file_names_and_metrics_are_ours():
    package = pytest.importorskip("nerfbaselines", reason="the package nerfbaselines is not installed")
    from nerfbaselines import metrics

    for name, data_set in (("blender", NERF_SYNTHETIC), ("mipnerf360", MIP_NERF_360)):
        spec = package.get_dataset_spec(name)
        assert {scene["id"] for scene in spec["metadata"]["scenes"]} == set(data_set.scenes)
        assert (name in data_set.folders, spec["evaluation_protocol"]) == (True, "nerf")
    generator = torch.Generator().manual_seed(0)
    truth = quantised(torch.rand(40, 50, 3, generator=generator))
    image = quantised((truth + 0.1 * torch.randn(40, 50, 3, generator=generator)).clamp(0, 1))
    pair = image.numpy()[None], truth.numpy()[None]
    assert float(metrics.psnr(*pair)[0]) == pytest.approx(float(psnr(image, truth)), abs=1e-3)
    assert float(metrics.ssim(*pair)[0]) == pytest.approx(float(ssim(image, truth)), abs=1e-5)
