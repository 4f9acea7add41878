"""Converting from the command line: files, tags, what is left for a viewer."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from aaplug import Fusion, read_scene, write_scene
from aaplug.core.conventions import MIP, PLAYCANVAS
from aaplug.evaluation.engine import evaluate
from aaplug.finetuning.session import tuned_scene
from aaplug.finetuning.state import between
from tests.conftest import make_scene

CONVERT = "convert scene.ply --cameras . -o c.ply"


def fused(name: str = "c.ply") -> list[str]:
    return [fusion.method for fusion in read_scene(Path(name)).gaussians().fused]


def test_convert_writes_what_was_fused(cli):
    out, err = cli.done(f"{CONVERT} --json")
    expected = {"method": "matched-energy", "variance": "0.2", "views": "3", "from": "classic"}
    assert json.loads(out) == {"output": "c.ply", "gaussians": 150, "fused": [expected]}
    assert "show it with 0.1 px², compensated (mip)" in err
    again = read_scene(Path("c.ply")).gaussians()
    assert (again.convention, fused()) == (MIP, ["matched-energy"])
    assert "matched-energy (variance=0.2" in cli("info c.ply")[1]


def test_convert_fuses_plain_mip_splatting_and_another_variance(cli):
    cli.done(f"{CONVERT} --form mip-splatting --variance 0.1")
    expected = Fusion("smoothing3d", {"variance": "0.1", "opacity": "volume"})
    assert read_scene(Path("c.ply")).gaussians().fused == (expected,)


@pytest.mark.parametrize("large", [False, True])
def test_convert_fuses_a_stored_filter_without_cameras(cli, monkeypatch, large):
    monkeypatch.setattr("aaplug.verbs.convert.LARGE_SCENE", 19 if large else 20)
    scene = replace(make_scene(20), filter_3d=torch.full((20,), 0.01), convention=MIP)
    write_scene(Path("unfused.ply"), scene)
    code, _, err = cli("convert unfused.ply -o c.ply")
    assert (code, "part by part" in err) == (0, large)
    found = read_scene(Path("c.ply")).gaussians()
    assert (fused(), found.filter_3d) == (["filter_3D"], None)
    expected = 0.5 * (scene.scales.square() + 0.01**2).log()
    torch.testing.assert_close(found.log_scales, expected)


def test_convert_of_a_scene_in_time_is_frame_by_frame(cli):
    for number in (1, 2):
        write_scene(Path(f"frames/{number}.ply"), make_scene(20))
    _, err = cli.done("convert frames --cameras . -o converted --min-seen 0")
    assert "wrote converted: frame by frame; show it with 0.1 px², compensated (mip)" in err


@pytest.mark.parametrize(("viewer", "steps"), [("classic", "1"), ("gsplat", "16")])
def test_convert_for_a_viewer_tags_its_rule_and_prints_what_is_left(cli, viewer, steps):
    """A viewer that draws as training did is right at the training size, and every step takes away from that."""
    out, err = cli.done(f"{CONVERT} --for {viewer} --steps {steps} --threads 1")
    assert [line for line in out.splitlines() if "converted" in line]
    found, compensated = read_scene(Path("c.ply")).gaussians(), viewer == "gsplat"
    assert (found.convention.kernel, found.convention.compensated) == (0.3, compensated)
    assert (b"SplatRenderMode: mip" in Path("c.ply").read_bytes()) == compensated
    if not compensated:
        assert "still worse than the original at some scale: keeping the closed form" in err
        assert found.fused == ()  # which is the scene itself
        return
    settings = dict(found.fused[-1].settings)
    partly = settings.pop("share", None)
    assert settings == {"steps": steps, "for": viewer}
    assert (partly is not None) == ("of the change" in err)


@pytest.mark.parametrize(
    ("viewer", "convention", "advice"),
    [
        ("playcanvas", PLAYCANVAS, "turn anti-aliasing on: app.scene.gsplat.antiAlias = true (with it off, a conv"),
        ("spark-mip", MIP, "in Spark 2.2.0, choose blurAmount: 0.1"),
    ],
)
def test_convert_for_a_program_says_what_to_choose_there(cli, viewer, convention, advice):
    _, err = cli.done(f"{CONVERT} --for {viewer} --steps 0 --threads 1")
    assert advice in " ".join(err.split())
    assert "steps" not in err  # there are none
    assert read_scene(Path("c.ply")).gaussians().convention == convention


def test_convert_says_before_its_work_that_no_viewer_opens_the_format(cli):
    _, err = cli.done(f"{CONVERT} --for cesium --steps 0")
    told = "no viewer of this rule is known to open c.ply; write a .glb or .spz.glb, or --for"
    assert " ".join(err.split()).count(told) == 1
    assert err.index("no viewer") < err.index("measuring") < err.index("wrote c.ply")


def test_convert_for_a_viewer_prints_the_residual_as_json(cli, monkeypatch):
    measured = list[str]()

    def noted(task, **how):
        measured.extend(task.renderers)
        return evaluate(task, **how)

    monkeypatch.setattr("aaplug.finetuning.fitting.evaluate", noted)
    found = cli.facts(f"{CONVERT} --viewer mip --steps 0")
    assert [f["method"] for f in found["fused"]] == ["matched-energy"]
    residual = found["residual"]
    assert residual["_aaplug"]["truth"] == "self"
    assert residual["converted@1"]["PSNR"] > residual["original@1"]["PSNR"]
    assert residual["converted@1"] == residual["closed form@1"]
    assert measured == ["original", "closed form"]


def test_convert_for_the_rule_of_training_changes_no_byte(cli):
    assert cli.facts(f"{CONVERT} --for classic")["fused"] == []
    assert Path("c.ply").read_bytes() == Path("scene.ply").read_bytes()


def dim(scene, *_):
    return replace(scene, logit_opacities=scene.logit_opacities - 5, convention=MIP)


def test_convert_starts_from_the_original_where_the_closed_form_is_worse(cli, monkeypatch):
    monkeypatch.setattr("aaplug.finetuning.fitting.fuse_for", dim)
    assert "starting from the original" in cli.done(f"{CONVERT} --for mip --steps 1")[1]
    original, found = (read_scene(Path(name)).gaussians() for name in ("scene.ply", "c.ply"))
    assert (found.logit_opacities - original.logit_opacities).abs().max() < 1
    monkeypatch.setattr(
        "aaplug.finetuning.fitting.tuned_scene",
        lambda *naming: replace(dim(tuned_scene(*naming)), fused=(Fusion("finetune"),)),
    )
    out, err = cli.done(f"{CONVERT} --for mip --steps 1 --json --threads 1 --overwrite")
    assert "still worse than the original at some scale: keeping the original" in err
    residual, found = json.loads(out)["residual"], read_scene(Path("c.ply")).gaussians()
    assert residual["converted@1"] == residual["original@1"]
    assert (found.fused, found.convention) == ((), MIP)
    assert torch.equal(found.logit_opacities, original.logit_opacities)


def test_convert_keeps_the_closed_form_where_tuning_leads_away_from_it(cli, monkeypatch):
    """Not as far as the original, so that no scale is worse than that."""

    def spoilt(state, job, *naming):
        return between(read_scene(Path("scene.ply")).gaussians(), tuned_scene(state, job, *naming), 0.7)

    monkeypatch.setattr("aaplug.finetuning.fitting.tuned_scene", spoilt)
    out, err = cli.done(f"{CONVERT} --for mip --steps 1 --json --threads 1")
    assert "tuning did not bring it closer, over all scales: keeping the closed form" in err
    residual = json.loads(out)["residual"]
    assert (fused(), residual["converted@1"]) == (["matched-energy"], residual["closed form@1"])


def test_what_was_tuned_converts_and_what_was_converted_does_not_again(cli):
    tuned = replace(read_scene(Path("scene.ply")).gaussians(), fused=(Fusion("finetune"),))
    write_scene(Path("tuned.ply"), tuned)
    cli.done("convert tuned.ply --cameras . -o c.ply")
    assert fused() == ["finetune", "matched-energy"]
    cli.refused("convert c.ply --cameras . -o d.ply --for mip --steps 0", "already has matched-energy")


def test_a_file_fits_the_viewer_or_names_one_that_opens_it(cli):
    means = read_scene("scene.ply").gaussians().means
    for viewer, axes in (("spark", "opencv"), ("spark --spz-axes opengl", "opengl"), ("mip", "opengl")):
        _, err = cli.done(f"convert scene.ply --cameras . -o c.spz --for {viewer} --steps 0 --overwrite")
        assert ("is known to open c.spz; --for spark-mip" in err) == (viewer == "mip")
        assert torch.allclose(read_scene("c.spz", spz_axes=axes).gaussians().means, means, atol=1e-5)
    _, err = cli.done("convert scene.ply --cameras . -o c.glb")
    other = "write a .ply, or --for khr, babylon, babylon-classic, cesium writes one for its own rule"
    assert f"known to open c.glb; {other}" in err
    _, err = cli.done("convert scene.ply --cameras . -o c.splat")
    assert "open c.splat in Spark 2.2.0 (blurAmount: 0.1) or GaussianSplats3D 0.4.7 (antialiased: true" in err
    assert " ".join(err.split()).count("a .splat cannot hold") == 1
    assert "open meta.json in " in cli.done("convert scene.ply --cameras . -o sog/meta.json --for mip --steps 0")[1]
