"""An output is written by one process; what another wrote meanwhile is not replaced."""

import os
import shutil
from contextlib import contextmanager
from itertools import cycle
from pathlib import Path

import pytest

from aaplug.io import atomic
from aaplug.io.atomic import claimed

SCENE = "scene.ply --cameras . --rasterizer eager"
OUTPUTS = {  # verb, words, what is claimed, what a rival writes there
    "render": (f"render {SCENE} -o images", "images", "r_0.png"),
    "one image": (f"render {SCENE} -o view.png", "view.png", ""),
    "convert": ("convert scene.ply --cameras . -o c.ply", "c.ply", ""),
    "merge": ("merge scene.ply --cameras . --into mip -o m.glb", "m.glb", ""),
    "video": (f"video {SCENE} -o v.webm --seconds 0.1", "v.webm", ""),
    "lod": (f"lod {SCENE} -o light.ply --simplify 0.5 --no-refine", "light.ply", ""),
    "levels": (f"lod {SCENE} -o levels --levels 1 --no-refine", "levels", "lod.json"),
    "finetune": (f"finetune {SCENE} -o t.ply --steps 1 --truth self --scale 0.5", "t.ply", ""),
    "evaluate": (f"evaluate {SCENE} -o out --recipe mip --scale 0.5", "out", "results.json"),
    "compare": (f"compare scene.ply {SCENE} -o diff --scale 0.5 --metric psnr", "diff", "compare.json"),
    "batch": ("evaluate --cameras . -o many --recipe mip --scale 0.5 --batch scenes.toml", "many", "batch.json"),
}


@pytest.fixture
def job(cli, plots_drawn_once):
    Path("scenes.toml").write_text('[[scene]]\nscene = "scene.ply"\n')
    return cli


@pytest.mark.parametrize("name", OUTPUTS)
def test_a_second_process_is_refused(name, job):
    words, output, file = OUTPUTS[name]
    if file:
        Path(output).mkdir()
    with claimed(output):
        job.refused(f"{words} --overwrite", f"{output}: is being written by another process")
    assert list(Path().glob(f"{output}/*")) == []


@pytest.mark.parametrize("name", OUTPUTS)
def test_what_another_process_wrote_meanwhile_is_not_replaced(name, job, monkeypatch):
    words, output, file = OUTPUTS[name]
    real, written = atomic.new_file, Path(output) / file

    @contextmanager
    def after_a_rival(path):
        written.write_bytes(b"rival's")
        with real(path) as file:
            yield file

    monkeypatch.setattr(atomic, "new_file", after_a_rival)
    code, _, err = job(words)
    assert (code, written.read_bytes()) == (2, b"rival's")
    assert "exists" in err or "already holds" in err
    assert not any(word in err for word in ("tuning for", "rendering:", "---"))


# a report has all files of an evaluation
@pytest.mark.parametrize("name", [*(name for name in OUTPUTS if name != "evaluate"), "report"])
def test_no_input_is_replaced_whatever_overwrite_says(name, job):
    """Each file that a verb writes becomes, one after the other, a link to a photograph, cameras or the scene."""
    words, output, _ = OUTPUTS.get(name, (f"{OUTPUTS['evaluate'][0]} --report --layout inria", "out", ""))
    assert job(words)[0] == 0
    sources = cycle([Path("test/r_0.png"), Path("transforms_train.json"), Path("scene.ply")])
    links = cycle([os.link, lambda source, path: path.symlink_to(source.absolute())])
    written = [path for path in (Path(output), *Path(output).rglob("*"), *Path().glob("t.finetune*")) if path.is_file()]
    each_kind = {(path.parent, path.suffix): path for path in written}.values()
    assert each_kind
    for path, source, link in zip(each_kind, sources, links, strict=False):
        before, old = source.read_bytes(), path.read_bytes()
        path.unlink()
        link(source, path)
        code, _, err = job(f"{words} --overwrite")
        assert (code > 0, source.read_bytes() == before, path.samefile(source)) == (True, True, True), path
        assert f"is also the input {source}" in " ".join(err.split()), path
        path.unlink()
        path.write_bytes(old)


def test_photographs_that_the_chosen_cameras_do_not_name_are_inputs_too(job):
    cameras = Path("transforms_test.json")
    Path("images.json").write_text(cameras.read_text().replace("./test/r_0", "./images_8/r_0"))
    for folder in ("test", "val", "images_8", "images_4"):
        if folder != "test":
            shutil.copytree("test", folder)
        file = "images.json" if "images" in folder else cameras
        job.refused(f"render scene.ply --cameras {file} -o {folder} --overwrite", "is also the input")
