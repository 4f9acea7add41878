"""What a scene is, from the library and the command line."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from aaplug.io.scenes import write_scene
from aaplug.verbs.info import info
from tests.conftest import make_scene
from tests.test_cli import break_nan, inria_model

BOTH_MODES = b"comment SplatRenderMode: mip\ncomment SplatRenderMode: default\nelement vertex"


def test_info_prints_data_on_stdout_and_the_log_on_stderr(cli):
    _, out, err = cli("info scene.ply --json")
    assert json.loads(out)["gaussians"] == 150
    assert err.startswith("scene: scene.ply: 150 Gaussians, SH degree 1, classic (no tag")


def test_info_with_cameras_tells_the_sampling(cli):
    facts = info("scene.ply", ".")
    assert facts["training_cameras"] == 3
    assert 0.5 < facts["seen_share"] <= 1
    shares = facts["energy_above_nyquist_share"]
    assert set(shares) == {"classic", "matched", "auto"}
    assert 0 < shares["matched"]["at 1"] < shares["matched"]["at 1/8"] < 1
    assert json.loads(cli("info scene.ply --cameras . --json")[1]) == facts
    assert f"at 1/8: {shares['auto']['at 1/8']:.4g}" in " ".join(cli("info scene.ply --cameras .")[1].split())


def test_info_of_a_model_folder_tells_the_sampling_of_its_cameras(cli):
    model = inria_model(Path("model"), "Namespace(eval=False)")
    facts = info(model)
    assert facts["training_cameras"] == 2
    assert "training_rate" not in facts
    assert json.loads(cli(f"info {model} --json")[1]) == facts
    cli.refused(f"info {model} --orbit 4", "--orbit: is for scenes without cameras")


def test_drop_bad_leaves_bad_gaussians_out_and_counts_them(cli):
    break_nan(Path())
    facts = info("scene.ply")
    assert (facts["gaussians"], facts["unusable_gaussians"]) == (150, 2)
    assert "--drop-bad" in facts["problems"][0]
    code, out, err = cli("convert scene.ply --cameras . -o out.ply --json --drop-bad")
    assert (code, json.loads(out)["gaussians"]) == (0, 148)
    assert "warning:" in err


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("scales", "exponentiated"),
        ("opacities", "activated"),
        ("tags", "contradict"),
        ("filter", "aaplug convert"),
        ("discs", "as discs"),
        ("far", "from the origin"),
        ("empty", "empty"),
    ],
)
def test_info_names_problems(tmp_path: Path, kind: str, words: str):
    scene = make_scene(0 if kind == "empty" else 10)
    changed = {
        "scales": {"log_scales": scene.log_scales.exp()},
        "opacities": {"logit_opacities": scene.opacities},
        "filter": {"filter_3d": torch.rand(10)},
        "discs": {"flat": True},
        "far": {"means": scene.means + 1e6},
    }
    path = tmp_path / "in.ply"
    write_scene(path, replace(scene, **changed.get(kind, {})))
    if kind == "tags":
        path.write_bytes(path.read_bytes().replace(b"element vertex", BOTH_MODES, 1))
    (problem,) = info(path)["problems"]
    assert words in problem


@pytest.mark.parametrize("column", ["log_scales", "logit_opacities"])
def test_few_gaussians_may_all_have_values_of_activated_ones(tmp_path: Path, column: str):
    scene = make_scene(3)
    write_scene(tmp_path / "in.ply", replace(scene, **{column: torch.full_like(getattr(scene, column), 0.5)}))
    assert info(tmp_path / "in.ply")["problems"] == []


def test_limits_are_printed(cli, monkeypatch):
    monkeypatch.setenv("AAPLUG_GAUSSIANS", "123")
    assert json.loads(cli("info --limits --json")[1])["GAUSSIANS"] == 123
    assert "AAPLUG_INFLATE" in (shown := cli("info --limits")[1])
    assert "123 " in shown
