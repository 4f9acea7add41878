# ruff: noqa: F811 (fixtures come from another file)
"""Fine-tuning and converting for a viewer from the command line: files, tags, interruptions."""

import json
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import pytest
from aaplug_cli import convert

from aaplug.core.gaussians import MIP
from aaplug.finetuning import tuning
from aaplug.io.scenes import read_scene
from tests.test_cli import cli, dataset  # noqa: F401 (fixtures)

TUNE = "finetune scene.ply --cameras . -o tuned.ply --scale 0.5 --threads 1"


@pytest.mark.parametrize("options", ["", " --truth self --method mipmap-gs"])
def test_finetune_without_steps_changes_no_byte(cli, options):
    assert cli(f"{TUNE} --steps 0{options}")[0] == 0
    assert Path("tuned.ply").read_bytes() == Path("scene.ply").read_bytes()


def test_finetune_writes_scene_report_and_pictures(cli):
    code, out, err = cli(f"{TUNE} --steps 4 --checkpoint-every 2 --for mip-viewer")
    assert code == 0
    assert "before" in out
    assert "closed form" in out
    assert "step 4 of 4, loss" in err
    assert "dB at 1, " in err
    again = read_scene(Path("tuned.ply"))
    assert again.convention == MIP
    assert [fusion.method for fusion in again.fused] == ["matched-energy", "finetune"]
    assert again.fused[1].settings == {
        "steps": "4", "for": "mip-viewer", "method": "consistency"
    }  # fmt: skip
    report = json.loads(Path("tuned.finetune.json").read_text())
    assert [entry["step"] for entry in report["curve"]] == [1, 2, 3, 4]
    assert [probe["step"] for probe in report["probes"]] == [2, 4]
    assert report["after@0.5"]["PSNR"] != report["before@0.5"]["PSNR"]
    assert report["settings"]["weights"] == {"0.5": 1.0}
    assert cv2.imread("tuned.finetune.png").shape[1] > 4 * 320
    assert not Path("tuned.finetune.pt").exists()
    code, _, err = cli(f"{TUNE} --steps 4")
    assert (code, "exists; pass --overwrite" in err) == (2, True)


def test_finetune_stopped_by_ctrl_c_and_resumed_writes_what_an_uninterrupted_one_does(
    cli, monkeypatch
):
    cli(f"{TUNE} --steps 5 --checkpoint-every 2")
    real, steps = tuning.advance, []

    def pressed(job, state):
        steps.append(state.step)
        if state.step == 2:
            signal.raise_signal(signal.SIGINT)
        real(job, state)

    whole = Path("tuned.ply").rename("whole.ply").read_bytes()
    curve = json.loads(Path("tuned.finetune.json").read_text())["curve"]
    for path in Path().glob("tuned.*"):
        path.unlink()
    monkeypatch.setattr(tuning, "advance", pressed)
    code, out, err = cli(f"{TUNE} --steps 5 --checkpoint-every 2")
    assert (code, out, steps) == (130, "", [0, 1, 2])
    assert "stopped at step 3; go on with the same command and --resume" in err
    assert sorted(path.name for path in Path().glob("tuned.*")) == ["tuned.finetune.pt"]
    monkeypatch.setattr(tuning, "advance", real)
    code, _, err = cli(f"{TUNE} --steps 5 --checkpoint-every 2 --resume")
    assert (code, "resumed at step 3" in err) == (0, True)
    assert Path("tuned.ply").read_bytes() == whole
    report = json.loads(Path("tuned.finetune.json").read_text())
    assert report["curve"] == curve
    assert [probe["step"] for probe in report["probes"]] == [2, 3, 4, 5]


def test_finetune_killed_outright_resumes_from_its_checkpoint(cli, tmp_path):
    words = f"{TUNE} --steps 6 --checkpoint-every 2".split()
    program = (
        "import os, sys; from aaplug.finetuning import tuning; from aaplug_cli.main import main\n"
        "real = tuning.advance\n"
        "def advance(job, state):\n"
        "    if state.step == 5: os.kill(os.getpid(), 9)\n"
        "    real(job, state)\n"
        "tuning.advance = advance\n"
        "main(sys.argv[1:])"
    )
    killed = subprocess.run([sys.executable, "-c", program, *words], cwd=tmp_path, check=False)
    assert killed.returncode == -9
    assert not Path("tuned.ply").exists()
    code, _, err = cli(" ".join(words) + " --resume")
    assert (code, "resumed at step 4" in err) == (0, True)
    resumed = Path("tuned.ply").read_bytes()
    assert cli(" ".join(words) + " --overwrite")[0] == 0
    assert Path("tuned.ply").read_bytes() == resumed


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("--steps -1", "--steps: must be 0 or more"),
        ("--method mipmap-gs --scale 0.5 0.25", "one model for one scale"),
        ("--scale 0", "--scale: needs sizes above 0"),
        ("--upsampler nearest", "expected bicubic, lanczos"),
        ("--resume", "there is no run to resume"),
        ("--truth photographs", "has no photograph"),
        ("--checkpoint-every 0", "must be 1 or more"),
        ("--rate 0", "need a rate above 0"),
    ],
)
def test_finetune_refuses_what_cannot_be(cli, options, words):
    code, out, err = cli(f"finetune scene.ply --cameras . -o tuned.ply {options}")
    assert (code, out) == (2, "")
    assert words in err
    assert not list(Path().glob("tuned*"))


@pytest.mark.parametrize(("viewer", "kernel", "compensated"), [
    ("classic-viewer", 0.3, False), ("antialiased-viewer", 0.3, True),
    ("mip-viewer", 0.1, True), ("gsplat", 0.3, True),
])  # fmt: skip
def test_convert_for_a_viewer_tags_its_rule_and_tells_what_is_left(
    cli, viewer, kernel, compensated
):
    code, out, err = cli(
        f"convert scene.ply --cameras . -o c.ply --for {viewer} --steps 2 --threads 1"
    )
    assert code == 0, err
    assert [line for line in out.splitlines() if "converted" in line]
    found = read_scene(Path("c.ply"))
    assert (found.convention.kernel, found.convention.compensated) == (kernel, compensated)
    assert (b"SplatRenderMode: mip" in Path("c.ply").read_bytes()) == compensated
    settings = dict(found.fused[-1].settings)
    stepped_back = settings.pop("share", None)
    assert settings == {"steps": "2", "for": viewer}
    assert (stepped_back is not None) == ("of the way from it" in err)


def test_convert_for_a_viewer_prints_the_residual_as_json(cli):
    code, out, _ = cli("convert scene.ply --cameras . -o c.ply --for mip-viewer --steps 0 --json")
    found = json.loads(out)
    assert code == 0
    assert [f["method"] for f in found["fused"]] == ["matched-energy"]
    residual = found["residual"]
    assert residual["_aaplug"]["truth"] == "self"
    assert residual["converted@1"]["PSNR"] > residual["original@1"]["PSNR"]


def test_convert_for_the_rule_of_training_fits_nothing(cli):
    code, out, err = cli("convert scene.ply --cameras . -o c.ply --for classic-viewer --json")
    assert (code, json.loads(out)["fused"]) == (0, [])
    assert "there is nothing to fit" in err
    assert Path("c.ply").read_bytes() == Path("scene.ply").read_bytes()


def test_convert_starts_from_the_original_where_the_closed_form_is_worse(cli, monkeypatch):
    def dim(scene, training, viewer):
        return replace(scene, logit_opacities=scene.logit_opacities - 5, convention=MIP)

    monkeypatch.setattr(convert, "convert_for", dim)
    asked = "convert scene.ply --cameras . -o c.ply --for mip-viewer --steps 1"
    code, _, err = cli(asked)
    assert (code, "starting from the original" in err) == (0, True)
    original, found = (read_scene(Path(name)).logit_opacities for name in ("scene.ply", "c.ply"))
    assert (found - original).abs().max() < 1


def test_convert_says_what_it_could_not_better(cli):
    """By the rule of training the training size is as it should be, and every step takes away from that."""
    code, _, err = cli("convert scene.ply --cameras . -o c.ply --for classic-viewer --steps 2")
    assert code == 0
    assert "0.125 of the way" in err
    assert "still worse than the original" in err


def test_convert_refuses_options_that_contradict_each_other(cli):
    for options in ("--steps 3", "--for gsplat --variance 0.1", "--for gsplat --steps -1"):
        code, _, err = cli(f"convert scene.ply --cameras . -o c.ply {options}")
        assert (code, "error:" in err) == (2, True)
        assert not Path("c.ply").exists()


def test_what_was_tuned_for_fast_rendering_converts_and_what_was_converted_does_not_again(cli):
    cli(f"{TUNE} --steps 1")
    assert cli("convert tuned.ply --cameras . -o c.ply --for mip-viewer --steps 1")[0] == 0
    assert [f.method for f in read_scene(Path("c.ply")).fused] == [
        "finetune", "matched-energy", "finetune"
    ]  # fmt: skip
    code, _, err = cli("convert c.ply --cameras . -o d.ply --for mip-viewer")
    assert (code, "already has matched-energy" in err) == (2, True)
