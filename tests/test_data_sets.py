"""All scenes of a paper's data set by one command: found by their layout, never averaged in silence."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from PIL import Image

import aaplug
from aaplug import FormatError, UsageError, read_scene, write_scene
from aaplug.evaluation.data_sets import DATA_SETS, PUBLISHED, Paper, find_scenes
from aaplug.io.scenes.scene import MODEL_SCENE as MODEL

RUN = "evaluate data --protocol blender --recipe classic --scale 1 0.5 --rasterizer eager -o out"


def make(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.touch()


def lay_out(protocol: str, data: Path, models: Path) -> None:
    """Empty files as the full sets have them."""
    for scene in DATA_SETS[protocol].scenes:
        cameras = data / scene / DATA_SETS[protocol].cameras
        make(cameras if cameras.suffix else cameras / "cameras.bin")
        make(models / scene / (f"{scene}.ply" if models.name == "plain" else MODEL.replace("*", "30000")))


@pytest.mark.parametrize("protocol", DATA_SETS)
@pytest.mark.parametrize("model", ["models", "plain", "data"])
def test_each_scene_of_the_full_sets_is_found(tmp_path, protocol, model):
    lay_out(protocol, tmp_path / "data", tmp_path / model)
    found = find_scenes(protocol, tmp_path / "data", None if model == "data" else tmp_path / model)
    assert [*found] == [*DATA_SETS[protocol].scenes]
    assert len(found) == (8 if protocol == "blender" else 9)


def test_archives_and_checkpoints_of_nerfbaselines_are_found(tmp_path):
    for scene in DATA_SETS["blender"].scenes:
        make(tmp_path / "nerf_synthetic" / scene / "transforms_test.json")
        make(tmp_path / "results" / "blender" / scene / "checkpoint" / MODEL.replace("*", "7000"))
    found = find_scenes("blender", tmp_path, tmp_path / "results")
    assert len(found) == 8
    assert found["mic"][0] == tmp_path / "results" / "blender" / "mic" / "checkpoint"


def test_what_is_missing_is_listed(tmp_path):
    lay_out("360-zoom-in", tmp_path / "data", tmp_path / "models")
    shutil.rmtree(tmp_path / "data" / "room")
    shutil.rmtree(tmp_path / "models" / "stump")
    folders = tmp_path / "data", tmp_path / "models"
    with pytest.raises(FormatError) as refused:
        find_scenes("360-zoom-in", *folders)
    assert "lacks 2 of the 9 scenes of Mip-NeRF 360" in str(refused.value)
    assert re.search(r"room: no sparse/0 in .*; stump: no point_cloud/iteration_N/point_cloud.ply", str(refused.value))
    assert {*DATA_SETS["360-zoom-in"].scenes} - {*find_scenes("360-zoom-in", *folders, skip=True)} == {"room", "stump"}
    with pytest.raises(FormatError, match="lacks 9 of the 9"):
        find_scenes("360-zoom-in", tmp_path, skip=True)
    for refused in (lambda: find_scenes("self", tmp_path), lambda: aaplug.batch([], tmp_path, protocol="self")):
        with pytest.raises(UsageError, match="no data set"):
            refused()


@pytest.fixture
def whole(cli):
    """The program beside a small data set of the eight scenes, whose photographs are their own renders."""
    for scene in DATA_SETS["blender"].scenes:
        folder = Path("data") / scene
        (folder / "test").mkdir(parents=True)
        shutil.copy("scene.ply", folder / f"{scene}.ply")
        shutil.copy("test/r_0.png", folder / "test")
        for split in ("train", "test"):
            shutil.copy(f"transforms_{split}.json", folder)
    return cli


def test_the_papers_table(whole):
    out, _ = whole.done(RUN)
    assert "PSNR, NeRF-synthetic, mean of 8 of 8 scenes" in out
    latex = Path("out", "table.tex").read_text()
    assert r"\begin{tabular}{lccc}" in latex
    assert "published" not in latex  # other scales than the papers'
    assert r"{\scriptsize $\pm$ 0.00}" in latex
    assert len(json.loads(Path("out", "batch.json").read_text())["mean_over"]) == 8


def test_names_that_mean_something_to_latex_are_escaped():
    row = r"5\% \& a\_b\# & 1.0 {\scriptsize $\pm$ 0.1} \\"
    assert row in Paper("", ["", "1"], [["5% & a_b#", "1.0 ± 0.1"]]).as_latex()


def test_the_papers_figures_stand_above_ours_at_their_scales(whole):
    words = RUN.replace("--scale 1 0.5", "--scale 1 0.5 0.25 0.125")
    out, _ = whole.done(words)
    assert ("…" in out, "± 0.00" in out) == (False, True)
    table = Path("out", "table.tex").read_text()
    assert "3DGS (published) & 33.33 & 26.95 & 21.38 & 17.69 & 24.84" in table
    assert PUBLISHED["blender"]["Mip-Splatting"][-1] == 31.97
    shutil.rmtree("data/mic")
    lacks = "lacks 1 of the 8 scenes of NeRF-synthetic (--skip leaves them out): mic: no transforms_test.json"
    whole.refused(f"{words} --resume", lacks)
    whole.done(f"{words} --resume --skip")
    table = Path("out", "table.tex").read_text()
    assert "without mic" in table
    assert "published" not in table  # they are means of all scenes


def test_scenes_that_fail_are_named_and_not_averaged(whole):
    data = Path("data")
    scene = read_scene(data / "ship" / "ship.ply").gaussians()
    write_scene(data / "ship" / "ship.ply", replace(scene, means=-scene.means + 6, origin=None), overwrite=True)
    cut, small = (data / name / "test" / "r_0.png" for name in ("mic", "drums"))
    cut.write_bytes(cut.read_bytes()[:-40])
    Image.open(small).resize((30, 30)).save(small)
    named = {
        "ship": "only 0.0% of its Gaussians are seen",
        "mic": "r_0.png",
        "drums": "r_0.png: is 30x30 px, of another shape than the cameras say 64x48",
    }
    code, out, _ = whole(RUN)
    assert code == 1
    assert "mean of" not in out
    assert not Path("out", "table.tex").exists()
    summary = json.loads(Path("out", "batch.json").read_text())
    assert (summary["mean_over"], summary["mean"]) == ([], {})
    for name, problem in named.items():
        assert summary["scenes"][name]["status"] == "failed"
        assert problem in summary["scenes"][name]["error"], summary["scenes"][name]
    code, out, _ = whole(f"{RUN} --resume --skip")
    assert code == 1
    assert "mean of 5 of 8 scenes, without drums, mic, ship" in " ".join(out.split())
