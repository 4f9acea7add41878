"""The command line as its users meet it: words, files, exit codes, one-line errors that leave nothing behind."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from plyfile import PlyData

from aaplug import info
from aaplug.io.images import image_size
from aaplug.io.scenes import read_scene, write_scene
from tests.conftest import EYES, SIZE, make_camera, make_scene, run_python, write_model
from tests.test_startup import START


def test_render_writes_a_view_at_a_scale_or_a_resolution(cli):
    code, out, err = cli("render scene.ply --cameras . -o out --scale 0.5")
    assert (code, out) == (0, "")
    assert image_size(Path("out/r_0.png")) == (32, 24)
    chosen = "1 view at 32x24, 0.5 × the training rate: 1×1 sample per pixel"
    assert f"recipe: auto for a classic scene, {chosen}" in err
    assert "background: black" in err
    for number, (resolution, size) in enumerate({"40x40": (40, 40), "-1x24": (32, 24), "128x-1": (128, 96)}.items()):
        cli.done(f"render scene.ply --cameras . -o {number}.png --resolution {resolution}")
        assert image_size(Path(f"{number}.png")) == size


def test_render_selects_views(cli):
    words = "--recipe classic --quality best --rate-reference global"
    out, err = cli.done(f"render scene.ply --cameras . -o out --views train --scale 0.25 --json {words}")
    images = json.loads(out)["images"]
    assert "quality best is not for recipe classic\nrate reference global is not for recipe classic\n" in err
    assert [image["view"] for image in images] == ["r_0", "r_1", "r_2"]
    assert all(Path(image["file"]).is_file() for image in images)


def test_render_by_one_file_of_cameras_which_serves_as_both_in_16_bits(cli):
    cli.done("render scene.ply --cameras transforms_test.json -o one.png --bit-depth 16")
    pixels = cv2.imread("one.png", cv2.IMREAD_UNCHANGED)
    assert pixels.dtype == np.uint16
    assert len(np.unique(pixels)) > 256


def inria_model(config: str) -> Path:
    cameras = [make_camera(eye, SIZE, name=name) for name, eye in zip("ab", EYES["train"], strict=False)]
    return write_model(Path("model"), cameras, config, make_scene(100), 7, 30)


def test_render_takes_an_inria_model_folder_as_it_is_and_a_scene_in_it_from_anywhere(cli, monkeypatch):
    model = inria_model("white_background=True, resolution=2, images='images', eval=False")
    assert "background: white (from the camera files)" in cli.done(f"render -m {model} -o out --views all")[1]
    assert cv2.imread("out/a.png")[0, 0].min() > 200
    assert image_size(Path("out/a.png")) == (32, 24)  # cameras.json holds the source's size; training was at -r 2
    cli.done(f"render {model} -o again --iteration 7 --views a")
    cli.refused(f"render {model} -o again --iteration 8 --views a --overwrite", "has no iteration 8; it has 7, 30")
    monkeypatch.chdir(model / "point_cloud")
    cli.done("render iteration_7/point_cloud.ply -o out --views a")
    monkeypatch.chdir("iteration_7")
    cli.done("render point_cloud.ply -o out --views a")


def test_cull_margin_leaves_out_what_is_centred_far_outside(cli):
    cli("render scene.ply --cameras . -o all.png")
    cli("render scene.ply --cameras . -o culled.png --cull-margin 0")
    assert Path("all.png").read_bytes() != Path("culled.png").read_bytes()
    cli("render scene.ply --cameras . -o wide.png --cull-margin 100")
    assert Path("all.png").read_bytes() == Path("wide.png").read_bytes()


def break_nan(folder: Path) -> None:
    vertices = PlyData.read(folder / "scene.ply", mmap=False)
    vertices["vertex"]["x"][3:5] = np.nan
    vertices.write(folder / "scene.ply")


CONVERT = "convert scene.ply --cameras . -o new.ply"
RENDER = "render scene.ply --cameras . -o new"
VIDEO = "video scene.ply --cameras . -o new.webm"
BARE = "render scene.ply -o new"
EVALUATE = "evaluate scene.ply --cameras . -o new"
LOD = "lod scene.ply"
COMPARE = "compare scene.ply scene.ply --cameras . --metric psnr"
TUNE = "finetune scene.ply --cameras . -o new.ply --rasterizer eager"
REFUSED = {
    "convert scene.ply --cameras . -o transforms_test.json": ["transforms_test.json"],
    "render scene.ply --cameras . -o test": ["test", "r_0.png", "--overwrite"],
    f"{RENDER} --views r_9": ["r_9", "r_0"],
    f"{RENDER} --recipe multi-scale": ["base_mask"],
    f"{RENDER} --lens-angle 90": ["--lens-angle: belongs to lenses fisheye and equisolid; name one as --lens"],
    f"{RENDER} --normal-axes world": ["--normal-axes: are of the pass normal"],
    f"{RENDER} --passes id --format exr --colour srgb": ["--colour: is of the pass rgb, which --passes leaves out"],
    f"{RENDER} --views r_0 --camera-to r_9": ["--camera-to: there is no view 'r_9'"],
    f"{RENDER} --views r_0 --samples 4": ["--samples: are of an aperture or a shutter; give --f-stop or --camera-to"],
    "render --cameras . -o new": ["error: SCENE: name one scene"],
    "render gone.ply --cameras . -o new": ["gone.ply"],
    "render gone.ply -o new --background nocolour": ["--background: takes auto or an opaque colour as CSS writes it"],
    "compare scene.ply --cameras .": ["compare: needs two scenes or more, got 1"],
    "compare --cameras .": ["compare: needs two scenes or more, got 0"],
    "compare scene.ply gone.ply --cameras .": ["gone.ply: cannot be read: no such file"],
    f"{COMPARE} --fail-under 40db": ["--fail-under: takes 0..200"],
    f"{COMPARE} --resume": ["--resume: needs a folder"],
    f"{COMPARE} --show 2": ["--show: needs a folder"],
    f"{COMPARE} --views nothing": ["there is no view 'nothing'"],
    "compare gone.ply b.ply --background transparent": ["; for none, render and video have `transparent`"],
    "render gone.ply -o new --background transparent": ["--background: takes", "video have --transparent"],
    "render scene.ply --cameras gone -o new": ["gone"],
    "render scene.ply --cameras . -o new.png --views train": ["new.png", "3 images"],
    f"{BARE} --up 0 0 0": ["--up: takes a direction"],
    f"{BARE} --up 0 1": ["--up: takes X Y Z, each -1", "got 0.0, 1.0"],
    f"{BARE} --eye 1 2 3 --look-at 1 2 3": ["--eye: and the place to look at are the same"],
    f"{BARE} --eye 1 2 3 --orbit 4": ["--orbit: moves the camera along an orbit, and --eye is one place"],
    f"{BARE} --train-view 48": ["--train-view: takes sizes"],
    f"{BARE} --train-view 99999x9": ["--train-view: would be"],
    f"{BARE} --train-view 40x40 --train-rate 5": ["--train-view: sets the training rate, as --train-rate does"],
    f"{BARE} --train-rate 1e8": ["the limit is 16384 a side"],
    f"{BARE} --cameras . --orbit 4": ["--orbit: is for scenes without cameras"],
    "check-plugin json": ["module json: holds no object that has laws"],
    f"{BARE} --test-every 4": ["--test-every: is of cameras, and there are none; name them with --cameras"],
    f"{BARE} --iteration 7": ["--iteration: is of a model folder, and scene.ply is a file"],
    f"{VIDEO} --recipe multi-scale": ["base_mask"],
    "video scene.ply --cameras . -o new.gif": ["new.gif", ".webm"],
    f"{VIDEO} --path scene.ply": ["scene.ply"],
    f"{VIDEO} --path orbitt": ["--path: takes zoom, dolly, orbit or a file of cameras; there is no orbitt"],
    f"{EVALUATE} --recipe multi-scale": ["base_mask"],
    f"{EVALUATE} --metric psnrr": ["--metric", "psnrr", "did you mean psnr?"],
    f"{EVALUATE} --metric ssim:alex": ["--metric", "ssim:3dgs"],
    "evaluate scene.ply --cameras . --report": ["--report", "--output"],
    f"{EVALUATE} --resume --overwrite": ["--resume: continues a run, and --overwrite starts anew"],
    f"{EVALUATE} --protocol blendr": ["--protocol", "blendr", "blender"],
    f"{EVALUATE} --report --show r_9": ["--show", "r_9"],
    "evaluate scene.ply --batch b.toml -o new": ["--batch", "scene.ply"],
    "evaluate scene.ply scene.ply --cameras .": ["-o FOLDER", "several"],
    f"{EVALUATE} --protocol fov --truth photographs": ["fov"],
    f"{EVALUATE} --protocol blender --scale 0.3": ["1/2"],
    f"{EVALUATE} --lpips a.pth b.pth": ["a.pth"],
    f"{EVALUATE} --metric lpips:alex": ["--lpips"],
    f"{LOD} -o x.ply --simplify 1000": ["--simplify: asks for 1,000 Gaussians, and the scene has 150"],
    f"{LOD} -o x.ply --simplify 0.5 --levels 2": ["--levels: cannot be combined with --simplify"],
    f"{LOD} -o new --scheduler local": ["--scheduler: belongs to --batch"],
    f"{LOD} -o x.ply": ["x.ply: levels go to a folder; for one scene, give --simplify or --budget"],
    f"{LOD} -o x.obj --simplify 0.5": ["has no suffix of a format that can be written"],
    f"{TUNE} --method mipmap-gs --scale 0.5 0.25": ["one model for one scale"],
    f"{TUNE} --upsampler nearest --scale 2": ["expected bicubic, lanczos"],
    f"{TUNE} --truth photographs": ["has no photograph; --truth self"],
    f"{TUNE} --move size": ["--move: 'size' is not one of means"],
    f"{TUNE} --overwrite -o scene.ply": ["is also the input"],
}


def test_broken_files_are_refused_and_nothing_is_written(cli):
    break_nan(Path())
    cli.refused(CONVERT, "scene.ply", "row 3", "1 more", "--drop-bad")
    write_scene("scene.ply", replace(make_scene(150), means=make_scene(150).means + 1000), overwrite=True)
    for words in (CONVERT, RENDER):
        cli.refused(words, "scene.ply", "different frames")


@pytest.mark.parametrize("words", REFUSED)
def test_refusals_name_file_and_cause_and_neither_draw_nor_write(cli, words, monkeypatch):
    if "blender" not in words:  # its scales fit or not by the photograph's size, known when it is read
        monkeypatch.setattr("aaplug.rendering.job.agreement", lambda *_: pytest.fail("drew before it refused"))
    cli.refused(words, *REFUSED[words])


def test_demo_does_the_whole_job(cli, monkeypatch):
    monkeypatch.setattr("aaplug.verbs.demo.SCALES", (0.25, 0.125))
    out, _ = cli.done("demo -o shown")
    assert "auto" in out
    results = json.loads(Path("shown/results.json").read_text())
    assert results["auto@0.125"]["PSNR"] > results["classic@0.125"]["PSNR"] + 15
    assert read_scene(Path("shown/chair-converted.ply")).gaussians().fused
    width, height = image_size(Path("shown/contact-sheet.png"))
    assert min(width, height) > 300
    cli.refused("demo -o shown")


@pytest.mark.parametrize(
    ("entry", "words"),
    [("main", "render --help"), ("program", "render --help"), ("main", "viewers"), ("program", "--version")],
)
def test_a_reader_that_leaves_early_is_no_failure(entry, words):
    program = [sys.executable, "-c", f"from aaplug_cli.main import {entry}; {entry}()", *words.split()]
    with subprocess.Popen(program, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as run:
        assert run.stdout is not None
        assert run.stderr is not None
        run.stdout.close()
        err = run.stderr.read()
    assert (run.returncode, err) == (0, "")


@pytest.mark.parametrize(("closed", "words", "code"), [(1, "viewers", 0), (2, "viewers", 0), (2, "render", 2)])
def test_a_stream_that_the_caller_closed_is_written_nowhere(closed, words, code):
    program = f"import os; os.close({closed}); os.execv({sys.executable!r}, ['python', '-c', {START!r}, {words!r}])"
    run = run_python(program)
    assert (run.returncode, "Traceback" in run.stderr, bool(run.stdout)) == (code, False, (closed, code) == (2, 0))


@pytest.mark.parametrize("given", [False, True])
def test_a_folder_that_matplotlib_makes_where_home_is_read_only_goes(tmp_path, given):
    change = f"main.main = lambda: (os.environ.update(MPLCONFIGDIR={str(tmp_path)!r}), sys.exit())"
    program = f"import os, sys; from aaplug_cli import main; {change}; main.program()"
    assert run_python(program, **({"MPLCONFIGDIR": tmp_path} if given else {})).returncode == 0
    assert tmp_path.exists() == given


@pytest.mark.parametrize(("words", "code"), [(["viewers", "--json"], 0), (["info"], 2)])
def test_the_program_ends_at_once_with_all_said(words, code):
    program = "import atexit; atexit.register(print, 'late'); from aaplug_cli.main import program; program()"
    run = run_python(program, *words)
    assert run.returncode == code
    assert bool(run.stdout) == (code == 0)
    assert "late" not in run.stdout
    assert run.stderr.count("error: ") == (code == 2)


# What a scene is


def test_info_with_cameras_tells_the_sampling_as_data_on_stdout_beside_a_log_on_stderr(cli):
    facts = info("scene.ply", ".")
    assert facts["training_cameras"] == 3
    assert 0.5 < facts["seen_share"] <= 1
    shares = facts["energy_above_nyquist_share"]
    assert set(shares) == {"classic", "matched", "auto"}
    assert 0 < shares["matched"]["at 1"] < shares["matched"]["at 1/8"] < 1
    _, out, err = cli("info scene.ply --cameras . --json")
    assert json.loads(out) == facts
    assert err.startswith("scene: scene.ply: 150 Gaussians, SH degree 1, classic (no tag")
    assert f"at 1/8: {shares['auto']['at 1/8']:.4g}" in " ".join(cli("info scene.ply --cameras .")[1].split())


def test_info_of_a_model_folder_tells_the_sampling_of_its_cameras(cli):
    model = inria_model("eval=False")
    facts = info(model)
    assert facts["training_cameras"] == 2
    assert "training_rate" not in facts
    assert json.loads(cli(f"info {model} --json")[1]) == facts
    cli.refused(f"info {model} --orbit 4", "--orbit: is for scenes without cameras")


def test_notes_name_options_as_the_command_line_does(cli):
    path, mark = Path("scene.ply"), b"element vertex"
    path.write_bytes(path.read_bytes().replace(mark, b"comment Generated by Nerstudio 1.1\n" + mark, 1))
    assert "`convention` antialiased" in json.loads(cli("info scene.ply --json")[1])["notes"][-1]
    assert "exported by nerfstudio: state --convention antialiased" in " ".join(cli("info scene.ply")[1].split())


def test_drop_bad_leaves_bad_gaussians_out_and_counts_them(cli):
    break_nan(Path())
    facts = info("scene.ply")
    assert (facts["gaussians"], facts["unusable_gaussians"]) == (150, 2)
    assert "--drop-bad" in facts["problems"][0]
    code, out, err = cli("convert scene.ply --cameras . -o out.ply --json --drop-bad")
    assert (code, json.loads(out)["gaussians"]) == (0, 148)
    assert "warning:" in err


PROBLEMS = {
    "exponentiated": lambda scene: replace(scene, log_scales=scene.log_scales.exp()),
    "activated": lambda scene: replace(scene, logit_opacities=scene.opacities),
    "aaplug convert": lambda scene: replace(scene, filter_3d=torch.rand(10)),
    "as discs": lambda scene: replace(scene, flat=True),
    "from the origin": lambda scene: replace(scene, means=scene.means + 1e6),
    "empty": lambda scene: scene[:0],
}


@pytest.mark.parametrize("words", PROBLEMS)
def test_info_names_problems(tmp_path: Path, words: str):
    write_scene(tmp_path / "in.ply", PROBLEMS[words](make_scene(10)))
    (problem,) = info(tmp_path / "in.ply")["problems"]
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
