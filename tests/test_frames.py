"""Many frames: the same files whatever the number of processes, errors that come back whole."""

import pickle
from dataclasses import replace

import pytest
import torch

from aaplug.core.errors import FormatError, OutputError
from aaplug.methods.recipes import RECIPES
from aaplug.rendering.frames import Frames, write_frames
from aaplug.rendering.renderer import learn
from tests.conftest import ALL_RASTERIZERS, make_camera, make_scene


@pytest.fixture
def frames(tmp_path) -> Frames:
    scene = make_scene(60)
    views = [make_camera((x / 2, -4.0, 0.3), (40, 30), name=f"v{x}") for x in range(5)]
    paths = [tmp_path / f"{view.name}.png" for view in views]
    training = learn(scene, views)
    return Frames(scene, training, RECIPES["matched"], (0.2, 0.3, 0.4), views, paths)


@pytest.mark.parametrize("name", ALL_RASTERIZERS)
def test_files_are_the_same_whatever_the_number_of_processes(frames, tmp_path, name):
    told: dict[int, list[tuple[int, int]]] = {}
    files = {}
    for threads in (1, 2):
        told[threads] = []
        tell = told[threads]
        (tmp_path / str(threads)).mkdir()
        paths = [tmp_path / str(threads) / path.name for path in frames.paths]
        own = replace(frames, paths=paths)
        write_frames(
            own, ALL_RASTERIZERS[name], threads, lambda *now, tell=tell: tell.append(now), 0.0
        )
        files[threads] = [path.read_bytes() for path in paths]
    assert files[1] == files[2]
    assert len(set(files[1])) == len(frames.views)
    assert told[1] == told[2] == [(done, 5) for done in range(6)]


@pytest.mark.parametrize("threads", [1, 2])
def test_an_existing_file_is_refused_by_name(frames, threads):
    frames.paths[3].write_bytes(b"mine")
    with pytest.raises(OutputError, match=r"v3\.png: exists"):
        write_frames(frames, ALL_RASTERIZERS["eager"], threads, pays_after=0.0)
    assert frames.paths[3].read_bytes() == b"mine"


def test_little_work_starts_no_process(frames, monkeypatch):
    monkeypatch.setattr("aaplug.rendering.frames.ProcessPoolExecutor", None)
    write_frames(frames, ALL_RASTERIZERS["eager"], 8)
    assert all(path.is_file() for path in frames.paths)


def test_errors_survive_the_way_between_processes():
    error = pickle.loads(pickle.dumps(FormatError("scene.ply", "is short")))
    assert isinstance(error, FormatError)
    assert (error.where, error.problem, str(error)) == (
        "scene.ply",
        "is short",
        "scene.ply: is short",
    )


def test_threads_change_no_bit(frames):
    from aaplug.rendering.renderer import render

    before = torch.get_num_threads()
    images = []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        images.append(render(frames.scene, frames.views[0], frames.recipe, frames.training).rgb)
    torch.set_num_threads(before)
    assert images[0].equal(images[1])
