"""Scenes whose harmonics stay in their file are drawn as those held in memory."""

import math
import pickle
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from plyfile import PlyData

from aaplug import FormatError, Gaussians, Renderer, read_image, read_scene, render, write_scene
from aaplug.io.scenes.scene import Scene, without_harmonics
from aaplug.rendering import renderer as rendering
from tests.conftest import SAMPLE, make_camera, make_scene, memory_taken, needs_peak_memory

VIEWS = (make_camera(), make_camera(eye=(0.3, -0.5, 0.2), name="inside"))
COUNT = 200_000  # Gaussians: 48 MB of .ply
A_GAUSSIAN = 150  # bytes: 11 numbers held, and once more while parts are joined
ONCE = 1.3 * 248 * COUNT  # bytes: the file's 62 numbers a Gaussian, and small parts
SLACK = 40 * 2**20  # bytes: parts at work


def written(folder: Path, count: int = 3000) -> tuple[Path, Gaussians]:
    """A scene in a file; some of its Gaussians have a filter to fuse."""
    scene = replace(make_scene(count, degree=3), filter_3d=torch.full((count,), 0.01))
    write_scene(folder / "scene.ply", scene)
    return folder / "scene.ply", scene


@pytest.fixture
def in_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Harmonics of any size stay in the file, and Gaussians are projected in chunks."""
    monkeypatch.setattr("aaplug.io.scenes.scene.MAX_HARMONICS_BYTES", 0)
    monkeypatch.setattr(rendering, "GAUSSIANS_AT_ONCE", 700)


def both(path: Path, recipe: str, drop_bad: bool = False) -> tuple[Renderer, Renderer]:
    """A renderer whose harmonics stay in the file, and one that holds them."""
    read, held = (read_scene(path, drop_bad=drop_bad) for _ in range(2))
    return Renderer.of(read, VIEWS, recipe), Renderer.of(held.gaussians(), VIEWS, recipe)


@pytest.mark.usefixtures("in_chunks")
@pytest.mark.parametrize("recipe", ["classic", "auto", "mip-splatting"])
def test_images_are_the_same_to_the_bit(tmp_path: Path, recipe: str):
    read, held = both(written(tmp_path)[0], recipe)
    assert read.scene.sh.shape == held.scene.sh.shape
    assert read.scene.sh.isnan().all()
    for view in VIEWS:
        assert torch.equal(read(view).rgb, held(view).rgb)
        assert torch.equal(read.trained_at(2.0)(view).rgb, held.trained_at(2.0)(view).rgb)


@pytest.mark.usefixtures("in_chunks")
def test_rows_that_are_left_out_shift_no_colours(tmp_path: Path):
    path, _ = written(tmp_path)
    spoiled = PlyData.read(path, mmap=False)
    spoiled["vertex"]["f_rest_21"][[0, 5, 1999]] = math.inf
    spoiled.write(path)
    with pytest.raises(FormatError, match=r"scene\.ply: row 0 \(and 2 more\) has Inf in f_rest_21"):
        without_harmonics(read_scene(path))
    read, held = both(path, "classic", drop_bad=True)
    assert torch.equal(torch.cat([read.harmonics(0, 1500), read.harmonics(1500, len(read.scene))]), held.scene.sh)
    assert torch.equal(read(VIEWS[0]).rgb, held(VIEWS[0]).rgb)


@pytest.mark.usefixtures("in_chunks")
def test_a_file_that_changes_is_noticed(tmp_path: Path):
    path, scene = written(tmp_path)
    renderer = Renderer.of(path, VIEWS, "classic")
    write_scene(path, scene[:2000], overwrite=True)
    with pytest.raises(FormatError, match="changed while it was being read"):
        renderer(VIEWS[0])


@pytest.mark.usefixtures("in_chunks")
def test_another_process_reads_the_file_itself(tmp_path: Path):
    renderer = Renderer.of(written(tmp_path)[0], VIEWS, "classic").portable()
    sent = pickle.dumps(renderer)
    assert len(sent) < A_GAUSSIAN * len(renderer.scene)
    assert torch.equal(pickle.loads(sent)(VIEWS[0]).rgb, renderer(VIEWS[0]).rgb)


def test_gaussians_that_were_read_anyway_are_drawn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("aaplug.io.scenes.scene.MAX_HARMONICS_BYTES", 0)
    scene = read_scene(written(tmp_path)[0])
    assert without_harmonics(scene) is without_harmonics(scene), "it is read once"
    scene.gaussians()
    assert without_harmonics(scene) == (scene.gaussians(), None)


def test_the_command_draws_a_large_scene_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def images(folder: str) -> list[torch.Tensor]:
        chair, one = SAMPLE / "chair.ply", {"views": "r_8", "scale": 1 / 16, "threads": 1}
        return [read_image(file) for _, file in render(chair, SAMPLE, tmp_path / folder, **one)]

    expected = images("held")
    monkeypatch.setattr("aaplug.io.scenes.scene.MAX_HARMONICS_BYTES", 0)
    monkeypatch.setattr(Scene, "gaussians", lambda scene: pytest.fail("all of the scene is read"))
    assert all(torch.equal(a, b) for a, b in zip(images("read"), expected, strict=True))


MADE = """
from pathlib import Path
from aaplug.evaluation.laws.base import make_scene
from aaplug.io.scenes import ply, read_scene, scene, write_scene
from aaplug.io.scenes.scene import without_harmonics
scene.MAX_HARMONICS_BYTES = 0
ply.ROWS_PER_PART = 5_000
small = Path({path!r})
path = small.with_name("large.ply")
write_scene(path, make_scene({count}, degree=3))
"""


@needs_peak_memory
def test_memory_holds_a_scene_once_and_no_large_harmonics(tmp_path: Path):
    prepare = MADE.format(path=str(written(tmp_path)[0]), count=COUNT)
    works = "scene = without_harmonics(read_scene(path))", "scene = read_scene(path).gaussians()"
    without, whole = memory_taken(prepare, *works, warm="without_harmonics(read_scene(small))")
    assert without < SLACK + A_GAUSSIAN * COUNT
    assert whole < ONCE
