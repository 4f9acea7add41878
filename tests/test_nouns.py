"""Nouns are values: they can be compared, hashed, copied and sent to another process."""

import copy
import pickle
from dataclasses import replace

import pytest
import torch

from aaplug.core.cameras import CameraSet
from aaplug.core.gaussians import Origin
from aaplug.core.orbits import frame_of
from aaplug.core.pyramids import Cutter, Pyramid
from aaplug.core.training import TrainingViews
from aaplug.io.scenes import read_scene, scene_of, write_scene
from tests.conftest import make_camera, make_scene, make_splats, sized

VIEWS = make_camera(), make_camera((3.0, -2.0, 1.0), name="other")
ORIGIN = Origin("scene.ply", "ply", "", None, torch.arange(6))
SCENE = replace(sized(make_scene(6)), origin=ORIGIN)
TRAINING = TrainingViews.of(SCENE, VIEWS)
PYRAMID = Pyramid.of([SCENE], [torch.zeros(6, dtype=torch.int64)])
CUTTER = Cutter.of(PYRAMID, TRAINING)
VALUES = (VIEWS[0], CameraSet(VIEWS, VIEWS[:1]))
LARGE = (SCENE, ORIGIN, TRAINING, TRAINING.bounds, make_splats(6, (8, 8)), PYRAMID, CUTTER, CUTTER(VIEWS[0]))
COPIES = {"copy": copy.copy, "deepcopy": copy.deepcopy, "pickle": lambda noun: pickle.loads(pickle.dumps(noun))}


@pytest.mark.parametrize("copied", COPIES.values(), ids=COPIES)
@pytest.mark.parametrize("noun", [*VALUES, *LARGE, frame_of(SCENE)], ids=lambda noun: type(noun).__name__)
def test_a_copy_has_every_field_and_a_large_noun_equals_itself_alone(noun, copied):
    other = copied(noun)
    assert repr(other) == repr(noun)
    assert (other == noun) == any(noun is value for value in VALUES)
    assert noun == noun
    assert len({noun, other, noun}) == (1 if other == noun else 2)


@pytest.mark.parametrize("field", ["name", "width", "fx", "cam_from_world", "trained_focal"])
def test_cameras_are_equal_by_value(field):
    view = VIEWS[0]
    changes = {"name": "new", "width": 65, "fx": 1.0, "cam_from_world": VIEWS[1].cam_from_world, "trained_focal": None}
    changed = replace(view, **{field: changes[field]})
    assert view != changed
    assert CameraSet((view,), ()) != CameraSet((changed,), ())
    assert view == replace(view, cam_from_world=view.cam_from_world.clone())
    assert view != "view"


@pytest.mark.parametrize("copied", COPIES.values(), ids=COPIES)
@pytest.mark.parametrize("held", [SCENE, PYRAMID, "file"], ids=["Gaussians", "levels", "file"])
def test_a_copy_of_a_scene_holds_its_rows_and_equals_itself_alone(held, copied, tmp_path):
    path = tmp_path / "scene.ply"
    if held == "file":
        write_scene(path, make_scene(6))
        held = path
    digest, scene = scene_of(held).digest, scene_of(held)
    other = copied(scene)
    path.unlink(missing_ok=True)  # a copy does not read it
    assert (other.title, other.count, other.digest) == (scene.title, 6, digest)
    assert (other.levels is None) == (held is not PYRAMID)
    assert scene == scene != other
    assert len({scene, other}) == 2


def test_two_openings_of_a_file_are_two_scenes(tmp_path):
    write_scene(tmp_path / "scene.ply", make_scene(6))
    first, second = (read_scene(tmp_path / "scene.ply") for _ in range(2))
    assert first != second
    assert first.digest == second.digest
    assert first.gaussians() is first.gaussians(), "rows are read once"
