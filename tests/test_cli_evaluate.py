"""aaplug evaluate as its users meet it: words, files, exit codes, one-line errors that leave nothing behind."""

import hashlib
import json
from pathlib import Path

import pytest
from aaplug_cli.verbs import VERBS

from aaplug import RECIPES, evaluate, read_scene
from aaplug.core.gaussians import digest_of_scene
from aaplug.evaluation.journal import JOURNAL
from aaplug.evaluation.report.files import COMPARED, PAGE, RESULTS
from aaplug.io.images import image_size


def test_it_writes_results_and_prints_a_table(cli):
    words = "evaluate scene.ply --cameras . -o out --recipe classic auto --scale 1 0.5 --quality best"
    code, out, err = cli(words)
    assert (code, "is not for recipe" in err) == (0, False)
    assert "training size, resampled" in out
    results = json.loads(Path("out/results.json").read_text())
    assert results["auto@1"]["PSNR"] is None or results["auto@1"]["PSNR"] > 45
    about = results["_aaplug"]
    assert about["truth"] == "photographs"
    assert about["scene"]["sha256"] == hashlib.sha256(Path("scene.ply").read_bytes()).hexdigest()
    assert about["scene"]["gaussians_sha256"] == digest_of_scene(read_scene("scene.ply").gaussians())
    assert {"aaplug", "torch"} <= set(about["versions"])
    assert list(json.loads(Path("out/per_view.json").read_text())["classic@0.5"]["SSIM"]) == ["r_0"]


def test_the_library_gives_what_the_command_line_gives(cli):
    own = evaluate("scene.ply", ".", recipe=["mip"], scale=[0.5], rasterizer="eager")
    words = "evaluate scene.ply --cameras . --recipe mip --scale 0.5 --rasterizer eager -o out"
    cli.done(words)
    found = json.loads(Path("out/results.json").read_text())
    assert found["mip@0.5"] == dict(own.select("mip", 0.5)[0].values)
    assert {key: found["_aaplug"][key] for key in own.protocol} == own.protocol


@pytest.mark.parametrize(
    "words",
    [
        "scene.ply --cameras . --recipe mip,auto --scale 1,1/2 -o a,b",
        "./scene.ply --cameras . --scale 1 1/2 --recipe=mip,auto, --output=a,b",
        "--cameras . -o a,b --recipe mip auto --scale=1,1/2 scene.ply",
        "--cameras . -o a,b --recipe mip auto --scale 1 0.5 ./scene.ply",
        "--cameras . -o a,b --recipe mip --scale 1 0.5 --recipe mip auto ./scene.ply",
    ],
)
def test_commas_part_values_as_spaces_do_and_a_scene_may_follow_several(words):
    found = VERBS["evaluate"].parse(words.split())
    expected = Path("scene.ply"), ("mip", "auto"), (1.0, 0.5), Path("a,b")
    assert (found.scene, found.recipe, found.scale, found.output) == expected


def test_all_leaves_out_what_does_not_suit_the_scene_whose_own_look_is_the_truth_without_photographs(cli):
    out, err = cli.done("evaluate scene.ply --cameras . --views r_1 --recipe all --scale 0.25 --json")
    assert "recipe multi-scale left out: the scene lacks" in err
    assert "truth: self (0 of 1 view with a photograph)" in err
    about = json.loads(out)["_aaplug"]
    assert set(about["recipes"]) == set(RECIPES) - {"multi-scale", "learned"}
    assert about["truth"] == "self"


def test_a_protocol_names_itself_and_its_flavours(cli):
    words = "evaluate scene.ply --cameras . --protocol blender --scale 0.5 --recipe matched --json"
    about = json.loads(cli(words)[1])["_aaplug"]
    assert about["protocol"]["name"] == "blender"
    assert about["background"] == [1, 1, 1]
    assert about["metrics"]["SSIM"].startswith("3dgs")
    assert "RGBA halved" in about["downscale"]
    overridden = json.loads(cli(words + " --metric ssim:wang")[1])["_aaplug"]
    assert list(overridden["metrics"]) == ["SSIM"]
    assert overridden["metrics"]["SSIM"].startswith("wang")


def test_it_writes_a_report_and_inrias_folders(cli, plots_drawn_once):
    pytest.importorskip("flip_evaluator")
    words = "evaluate scene.ply --cameras . -o out --recipe classic auto --scale 0.5"
    options = "--metric psnr,flip,flicker --report --layout inria --show r_0"
    out, _ = cli.done(f"{words} {options}")
    page = Path("out/report.html").read_text()
    assert "FLIP" in out
    assert "flicker" in page
    assert Path("out/plots/psnr.png").is_file()
    assert image_size(Path("out/test/classic@0.5/gt/00000.png")) == (32, 24)
    assert Path("out/results.csv").read_text().count("\n") == 4


def test_overwriting_leaves_nothing_of_an_earlier_run_and_all_that_others_wrote(cli, plots_drawn_once):
    own = ["note.txt", "plots/mine.png", "test/mip@0.5/renders/mine.png"]
    options = "scene.ply --cameras . -o out --rasterizer eager --metric psnr --scale 0.5"
    assert cli(f"evaluate {options} --recipe classic mip --report --layout inria")[0] == 0
    for name in own:
        Path("out", name).touch()
    evaluation = f"evaluate {options} --recipe auto --overwrite"
    for words, files in (
        (evaluation, {JOURNAL, *RESULTS}),
        (f"compare scene.ply {options} --overwrite", {JOURNAL, *COMPARED, PAGE}),
        (evaluation, {JOURNAL, *RESULTS}),
    ):
        assert cli(words)[0] == 0
        left = {str(path.relative_to("out")) for path in Path("out").rglob("*") if path.is_file()}
        page = {name for name in left if PAGE in files and name.startswith(("images", "plots"))}
        assert left == {*own, *files, *page}


def test_help_shows_the_recipes_for_users_and_says_that_there_are_more(cli):
    text = cli("evaluate --help")[1]
    assert "playcanvas-classic and others" in " ".join(text.split())
    assert "matched-integral" not in text


def test_an_unreadable_photograph_is_named(cli):
    photograph = Path("test/r_0.png")
    photograph.write_bytes(photograph.read_bytes()[: photograph.stat().st_size // 2])
    cli.refused("evaluate scene.ply --cameras . -o new", "r_0.png")
