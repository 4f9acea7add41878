"""Scenes whose harmonics stay in their file are drawn as those held in memory."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from aaplug.core.gaussians import Gaussians
from aaplug.io.images import read_image
from aaplug.io.scenes import read_scene, write_scene
from aaplug.io.scenes.harmonics import without_harmonics
from aaplug.rendering import renderer as rendering
from aaplug.rendering.renderer import Renderer
from aaplug.system.errors import FormatError
from aaplug.verbs import inputs
from aaplug.verbs.render import render
from tests.conftest import make_camera, make_scene, memory_taken, needs_peak_memory

VIEWS = (make_camera(), make_camera(eye=(0.3, -0.5, 0.2), name="inside"))
COUNT = 200_000  # Gaussians: 48 MB of .ply
A_GAUSSIAN = 150  # bytes: 11 numbers held, and once more while parts are joined; with its harmonics it takes 480
SLACK = 40 * 2**20  # bytes: parts at work


def written(folder: Path, count: int = 3000) -> tuple[Path, Gaussians]:
    """A scene in a file; some of its Gaussians have a filter to fuse."""
    scene = replace(make_scene(count, degree=3), filter_3d=torch.full((count,), 0.01))
    write_scene(folder / "scene.ply", scene)
    return folder / "scene.ply", scene


@pytest.fixture
def in_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rendering, "CHUNK", 700)


@pytest.mark.usefixtures("in_chunks")
@pytest.mark.parametrize("recipe", ["classic", "auto", "mip-splatting"])
def test_images_are_the_same_to_the_bit(tmp_path: Path, recipe: str):
    opened = read_scene(written(tmp_path)[0])
    held = Renderer.of(opened.whole(), VIEWS, recipe)
    scene, harmonics = without_harmonics(opened)
    read = replace(Renderer.of(scene, VIEWS, recipe), harmonics=harmonics)
    assert scene.sh.shape == held.scene.sh.shape
    assert scene.sh.isnan().all()
    for view in VIEWS:
        assert torch.equal(read(view).rgb, held(view).rgb)


@pytest.mark.usefixtures("in_chunks")
def test_rows_that_are_left_out_shift_no_colours(tmp_path: Path):
    path, scene = written(tmp_path)
    spoiled = scene.sh.clone()
    spoiled[[0, 5, 1999], 7, 1] = torch.inf
    write_scene(path, replace(scene, sh=spoiled), overwrite=True)
    opened = read_scene(path)
    with pytest.raises(FormatError, match=r"scene\.ply: row 0 \(and 2 more\) has Inf in f_rest_21"):
        without_harmonics(opened)
    held = Renderer.of(opened.whole(drop_bad=True), VIEWS, "classic")
    kept, harmonics = without_harmonics(opened, drop_bad=True)
    assert torch.equal(torch.cat([harmonics(0, 1500), harmonics(1500, len(kept))]), held.scene.sh)
    read = replace(Renderer.of(kept, VIEWS, "classic"), harmonics=harmonics)
    assert torch.equal(read(VIEWS[0]).rgb, held(VIEWS[0]).rgb)


def test_a_file_that_changes_is_noticed(tmp_path: Path):
    path, scene = written(tmp_path)
    kept, harmonics = without_harmonics(read_scene(path))
    write_scene(path, scene[:2000], overwrite=True)
    with pytest.raises(FormatError, match="changed while it was being read"):
        replace(Renderer.of(kept, VIEWS, "classic"), harmonics=harmonics)(VIEWS[0])


def test_the_command_draws_a_large_scene_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, sample_folder: Path):
    def images(folder: str) -> list[torch.Tensor]:
        chair, one = sample_folder / "chair.ply", {"views": "test", "scale": 1 / 8, "threads": 1}
        return [read_image(file) for _, file in render(chair, sample_folder, tmp_path / folder, **one)]

    held = images("held")
    asked: list[object] = []

    def asking(*args: object) -> tuple[Gaussians, object]:
        asked.append(args)
        return without_harmonics(*args)

    monkeypatch.setattr(inputs, "without_harmonics", asking)
    monkeypatch.setattr(inputs, "HELD_HARMONICS", 0)
    assert all(torch.equal(a, b) for a, b in zip(images("read"), held, strict=True))
    assert asked


MADE = """
from pathlib import Path
from aaplug.io.scenes import read_scene, write_scene
from aaplug.io.scenes.harmonics import without_harmonics
from tests.conftest import make_scene
path = Path({path!r})
without_harmonics(read_scene(path))
path = path.with_name("large.ply")
write_scene(path, make_scene({count}, degree=3))
"""


@needs_peak_memory
def test_memory_holds_no_harmonics(tmp_path: Path):
    prepare = MADE.format(path=str(written(tmp_path)[0]), count=COUNT)
    taken = memory_taken(prepare, "scene = without_harmonics(read_scene(path))")
    assert taken < SLACK + A_GAUSSIAN * COUNT
