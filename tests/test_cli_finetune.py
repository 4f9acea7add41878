"""Fine-tuning from the command line: files, tags, interruptions."""

import json
import os
import shutil
import signal
from pathlib import Path
from unittest.mock import Mock

import cv2
import pytest
from aaplug_cli.main import main

from aaplug.core.conventions import MIP
from aaplug.finetuning import loop
from aaplug.io.scenes import read_scene
from tests.conftest import exit_code, made_by

TUNE = "finetune scene.ply --cameras . -o tuned.ply --scale 0.5 --threads 1 --for mip --rasterizer eager"
RUN = f"{TUNE} --steps 3 --checkpoint-every 2"


@pytest.fixture(scope="module")
def whole(dataset, tmp_path_factory) -> Path:
    """A folder with the outputs of an uninterrupted run."""
    return made_by(RUN, dataset, tmp_path_factory.mktemp("whole"))


def test_finetune_without_steps_changes_no_byte(cli):
    words = "finetune scene.ply --cameras . -o tuned.ply --scale 0.5 --method mipmap-gs --steps 0"
    cli.done(words)
    assert Path("tuned.ply").read_bytes() == Path("scene.ply").read_bytes()
    for name, same in (("same.ply", True), ("less.splat", False)):  # which has no harmonics
        found = json.loads(cli(f"{words} --json -o {name}".replace("-o tuned.ply ", ""))[1])
        assert (found["after@0.5"] == found["before@0.5"]) == same


@pytest.mark.parametrize(("rate", "worse"), [("1e-6", False), ("100", True)])
def test_finetune_says_where_it_made_the_measured_views_worse(cli, rate, worse):
    how = f"--scale 0.5 --steps 1 --learning-rate {rate} --rasterizer eager"
    _, err = cli.done(f"finetune scene.ply --cameras . -o tuned.ply {how}")
    assert ("worse than before at 1, 1/2: " in " ".join(err.split())) == worse, err


def test_an_upsampler_is_for_scales_above_the_photographs(cli):
    shutil.copytree("test", "train")
    for i in (1, 2):
        shutil.copy("train/r_0.png", f"train/r_{i}.png")
    words = "finetune scene.ply --cameras . -o tuned.ply --train-scale 0.5 --upsampler bicubic --steps 0 --scale"
    cli.refused(f"{words} 2", "--upsampler: is for scales above the source images', and there is none")
    cli.done(f"{words} 4")


def test_finetune_writes_scene_report_and_pictures(whole):
    found = read_scene(whole / "tuned.ply").gaussians()
    assert found.convention == MIP
    assert [fusion.method for fusion in found.fused] == ["matched-energy", "finetune"]
    settings = {"steps": "3", "for": "mip", "method": "consistency"}
    assert found.fused[1].settings == settings
    report = json.loads((whole / "tuned.finetune.json").read_text())
    assert [entry["step"] for entry in report["curve"]] == [1, 2, 3]
    assert [probe["step"] for probe in report["probes"]] == [2, 3]
    assert report["after@0.5"]["PSNR"] != report["before@0.5"]["PSNR"]
    assert report["closed form@0.5"]["PSNR"]
    assert report["settings"]["weights"] == {"0.5": 1.0}
    assert cv2.imread(str(whole / "tuned.finetune.png")).shape[1] > 4 * 320
    assert not (whole / "tuned.finetune.pt").exists()


def test_a_run_stopped_by_ctrl_c_and_resumed_writes_what_an_uninterrupted_one_does(cli, monkeypatch, whole):
    real = loop.advance

    def pressed(job, state):
        if state.step == 0:
            signal.raise_signal(signal.SIGINT)
        real(job, state)

    monkeypatch.setattr(loop, "advance", pressed)
    code, out, err = cli(RUN)
    assert (code, out) == (130, "")
    assert "stopped at step 1\ntuned.finetune.pt is kept; --resume continues" in err
    cli.refused(RUN, "tuned.finetune.pt: is of an interrupted run; --resume continues it, --overwrite starts anew")
    assert [path.name for path in Path().glob("tuned.*")] == ["tuned.finetune.pt"]
    Path("tuned.ply").touch()  # as if it had been killed while it measured
    monkeypatch.setattr(loop, "advance", real)
    code, out, err = cli(f"{RUN} --resume")
    assert (code, "resumed at step 1" in err, "before" in out) == (0, True, True)
    assert "step 3 of 3, loss" in err
    assert Path("tuned.ply").read_bytes() == (whole / "tuned.ply").read_bytes()
    reports = [json.loads((p / "tuned.finetune.json").read_text()) for p in (Path(), whole)]
    assert reports[0]["curve"] == reports[1]["curve"]


def test_ctrl_c_while_the_result_is_measured_says_that_the_run_can_be_resumed(cli, monkeypatch):
    pressed = Mock(side_effect=KeyboardInterrupt)
    monkeypatch.setattr("aaplug.verbs.finetune.sampling_bounds", pressed)
    code, _, err = cli(RUN)
    assert (code, "tuned.finetune.pt is kept; --resume continues" in err) == (130, True)
    monkeypatch.setattr("aaplug.verbs.finetune.fuse_for", pressed)
    for words, is_its_own in (("--overwrite", False), ("--resume", True)):
        code, _, err = cli(f"{RUN} {words}")
        assert (code, "is kept; --resume continues" in err) == (130, is_its_own)


def test_a_run_killed_outright_resumes_from_its_checkpoint(cli, monkeypatch, whole):
    real = loop.advance

    def killed(job, state):
        if state.step == 2:
            os.kill(os.getpid(), signal.SIGKILL)
        real(job, state)

    with monkeypatch.context() as patch:
        patch.setattr(loop, "advance", killed)
        assert exit_code(lambda: main(RUN.split())) == -signal.SIGKILL
    assert not Path("tuned.ply").exists()
    assert "resumed at step 2" in cli.done(f"{RUN} --resume")[1]
    assert Path("tuned.ply").read_bytes() == (whole / "tuned.ply").read_bytes()


def test_a_run_killed_before_its_first_checkpoint_starts_anew(cli, whole):
    assert "there is no checkpoint yet: starting at step 0" in cli.done(f"{RUN} --resume")[1]
    assert Path("tuned.ply").read_bytes() == (whole / "tuned.ply").read_bytes()
    cli.refused(f"{RUN} --resume", "tuned.ply: is of a run that is complete")
