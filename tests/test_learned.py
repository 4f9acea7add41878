"""Learned filters: what they draw, what learning changes, and where their columns stay."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from aaplug import RECIPES, CameraSet, Monitor, Renderer, UsageError, finetune, lod, merge, read_scene, write_scene
from aaplug.lab.learned import NAMES
from tests.conftest import make_camera, make_scene, sized

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
