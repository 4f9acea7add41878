"""Many frames, by one process or by others."""

from pathlib import Path

import pytest

from aaplug.io.image_formats import Storage
from aaplug.rendering.frames import write_frames
from aaplug.rendering.renderer import Renderer
from aaplug.system.executors import Processes, ProcessesIfLong
from tests.conftest import ALL_RASTERIZERS, make_camera, make_scene

VIEWS = [make_camera((x / 2, -4.0, 0.3), (40, 30), name=f"v{x}") for x in range(4)]
FASTEST = ALL_RASTERIZERS.get("compiled", ALL_RASTERIZERS["eager"])


@pytest.fixture
def renderer() -> Renderer:
    return Renderer.of(make_scene(60), VIEWS, "matched", background=(0.2, 0.3, 0.4), rasterizer=FASTEST)


@pytest.fixture
def paths(tmp_path):
    return [tmp_path / f"{view.name}.png" for view in VIEWS]


def test_files_of_other_processes_are_the_same(renderer, paths, monkeypatch):
    """Of two that are asked for one does the work: a start takes longest."""
    storage = Storage.of(Path("a.npz"), passes=("rgb", "alpha", "depth", "normal", "id"))
    files, progress, paths = [], [], [path.with_suffix(".npz") for path in paths]
    asked = []
    monkeypatch.setattr("aaplug.system.executors.Processes", lambda count: asked.append(count) or Processes(1))
    for threads in (1, 2):
        apply = ProcessesIfLong(threads, pays_after=0.0).map
        how = {"storage": storage, "overwrite": threads == 2, "tell": lambda *now: progress.append(now)}
        write_frames(renderer, VIEWS, paths, apply, **how)
        files.append([path.read_bytes() for path in paths])
    assert asked == [2]
    assert files[0] == files[1]
    assert len(set(files[0])) == len(VIEWS)
    assert progress == 2 * [(done, 4) for done in range(5)]


def test_little_work_starts_no_process(renderer, paths, monkeypatch):
    monkeypatch.setattr("aaplug.system.executors.Processes", None)
    write_frames(renderer, VIEWS, paths, ProcessesIfLong(8).map)
    assert all(path.is_file() for path in paths)
