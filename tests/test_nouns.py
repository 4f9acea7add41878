"""Nouns are values: they can be compared, hashed, copied and sent to another process; digests tell their contents."""

import copy
import math
import os
import pickle
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing.context import set_spawning_popen
from multiprocessing.reduction import ForkingPickler
from pathlib import Path

import pytest
import torch
from beartype.roar import BeartypeCallHintParamViolation
from jaxtyping import TypeCheckError

from aaplug import METRICS, RECIPES, CameraSet, Renderer, TrainingViews, look_at
from aaplug.core.gaussians import Origin, digest_of_scene
from aaplug.core.orbits import frame_of
from aaplug.core.pyramids import Cutter, Pyramid
from aaplug.core.spherical_harmonics import sh_colour
from aaplug.evaluation.results import Measurement, Report
from aaplug.io.scenes import read_scene, scene_of, write_scene
from aaplug.system.digests import digest_of_files
from aaplug.system.errors import FormatError, UsageError, listing
from aaplug.verbs.render import Written
from tests.conftest import make_camera, make_scene, make_splats, sized

VIEWS = make_camera(), make_camera((3.0, -2.0, 1.0), name="other")
ORIGIN = Origin("scene.ply", "ply", "", None, torch.arange(6))
SCENE = replace(sized(make_scene(6)), origin=ORIGIN)
TRAINING = TrainingViews.of(SCENE, VIEWS)
PYRAMID = Pyramid.of([SCENE], [torch.zeros(6, dtype=torch.int64)])
CUTTER = Cutter.of(PYRAMID, TRAINING)
IMAGE = Renderer.of(SCENE, TRAINING, "classic", rasterizer="eager")(VIEWS[0])
VALUES = (VIEWS[0], CameraSet(VIEWS, VIEWS[:1]))
LARGE = (SCENE, ORIGIN, TRAINING, TRAINING.bounds, make_splats(6, (8, 8)), PYRAMID, CUTTER, CUTTER(VIEWS[0]), IMAGE)
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


def test_a_printed_scene_says_what_it_is_and_leaves_out_what_its_writer_needs(tmp_path):
    write_scene(tmp_path / "scene.ply", make_scene(6))
    scene = read_scene(tmp_path / "scene.ply")
    for printed in (repr(scene), repr(scene.gaussians())):
        assert "scene.ply" in printed
        assert "convention=" in printed
        assert "f_dc_0" not in printed
    assert repr(METRICS).startswith("Registry(metric: PSNR, SSIM, LPIPS")


def test_what_is_printed_of_cameras_and_of_a_renderer_does_not_grow_with_them():
    few, many = (CameraSet(VIEWS[:1] * n, VIEWS[1:] * n, notes=("COLMAP",)) for n in (10, 99))
    assert repr(few).replace("10", "99") == repr(many)
    assert "COLMAP" in repr(many)
    few, many = (Renderer.of(make_scene(n), cameras, "classic") for n, cameras in ((10, few), (99, many)))
    assert len(repr(many)) == len(repr(few))
    assert "count=99" in repr(many)
    assert "name='classic'" in repr(many)
    measured = Measurement("classic", 1.0, "a view", {"PSNR": 30.0}, 1, 0.1)
    reports = [Report((measured,) * n, {}) for n in (10, 99)]
    for short, long in ((few.scene, many.scene), (few.training, many.training), reports):
        assert repr(short).replace("10", "99") == repr(long)
    assert "\n" not in repr(Written(VIEWS[0], Path("a.png")))


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


class Starting(list[int]):
    """A process that is being started: the files that torch hands over to it, by number."""

    duplicate_for_child, DupFd = list[int].append, str


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system hands no files over")
@pytest.mark.parametrize("read", [True, False], ids=["read", "unread"])
@pytest.mark.parametrize("first", [b"", b"\xff" * 4], ids=["whole", "a row left out"])
def test_a_scene_is_sent_to_a_process_that_starts(read, first, tmp_path):
    path, process = tmp_path / "scene.ply", Starting()
    write_scene(path, make_scene(6))
    header, end, rows = path.read_bytes().partition(b"end_header\n")
    path.write_bytes(header + end + first + rows[len(first) :])
    scene = read_scene(path, drop_bad=True)
    if read:
        assert len(scene.gaussians()) == 6 - bool(first)
    set_spawning_popen(process)
    try:
        ForkingPickler.dumps(scene)
    finally:
        set_spawning_popen(None)
    assert len({*process}) == len(process) > 0
    for number in process:
        os.fstat(number)  # open until the process has started


def test_two_openings_of_a_file_are_two_scenes(tmp_path):
    write_scene(tmp_path / "scene.ply", make_scene(6))
    first, second = (read_scene(tmp_path / "scene.ply") for _ in range(2))
    assert first != second
    assert first.digest == second.digest
    assert first.gaussians() is first.gaussians(), "rows are read once"


POSE = VIEWS[0].cam_from_world
ODD_CAMERAS = [
    *({"fx": x} for x in (0.0, -1.0, math.inf, math.nan, 1e30)),
    *({"cy": x} for x in (math.inf, math.nan)),
    *({"width": x} for x in (0, -1, 10**10)),
    *({"trained_focal": x} for x in (0.0, -1.0, math.nan)),
    *({"cam_from_world": x} for x in (POSE * math.nan, 0 * POSE, 2 * POSE, POSE.half())),
    {"cam_from_world": POSE * torch.tensor([[-1.0], [1.0], [1.0], [1.0]], dtype=torch.float64)},
    {"cam_from_world": POSE + torch.eye(4, dtype=torch.float64)[:, [3, 0, 1, 2]]},
]


@pytest.mark.parametrize("odd", ODD_CAMERAS, ids=lambda odd: "-".join(map(str, odd)))
def test_a_camera_is_a_pinhole_at_a_rigid_pose(odd):
    with pytest.raises(UsageError, match="expected"):
        replace(VIEWS[0], **odd)


def test_the_last_row_of_a_pose_may_be_rounded():
    off = torch.zeros(4, 4, dtype=torch.float64)
    off[3] = torch.tensor([-1e-17, 1e-17, 0.0, 1e-16])
    assert replace(VIEWS[0], cam_from_world=POSE + off).hw == VIEWS[0].hw
    with pytest.raises(UsageError, match="0 0 0 1 below"):
        replace(VIEWS[0], cam_from_world=POSE + 1e12 * off)


@pytest.mark.parametrize(
    "odd", [{"cull_margin": math.nan}, {"cull_margin": -1.0}, {"min_seen": math.nan}, {"min_seen": -0.1}]
)
def test_training_views_take_shares(odd):
    with pytest.raises(UsageError, match="expected a number"):
        TrainingViews.of(SCENE, VIEWS, **odd)


@pytest.mark.parametrize("column", ["means", "quats", "log_scales", "logit_opacities", "sh"])
def test_gaussians_with_nan_are_refused_in_memory_as_from_a_file(column):
    poisoned = getattr(SCENE, column).clone()
    poisoned[3] = math.nan
    with pytest.raises(UsageError, match="row 3 has NaN"):
        scene_of(replace(SCENE, **{column: poisoned}))


@pytest.mark.parametrize("index", [torch.tensor([6]), torch.zeros(5) > 0, slice(None, None, -1), slice(0.5, None)])
@pytest.mark.parametrize("noun", [SCENE, make_splats(6, (8, 8))], ids=lambda noun: type(noun).__name__)
def test_an_index_is_a_place_of_each(noun, index):
    with pytest.raises(UsageError, match="index: expected places of 6 "):
        noun[index]


def test_gaussians_have_a_row_of_their_file_each(tmp_path):
    write_scene(tmp_path / "scene.ply", SCENE)
    read = read_scene(tmp_path / "scene.ply").gaussians()
    columns = {name: torch.cat([column, column]) for name, column in read.columns.items()} | {"extras": {}}
    with pytest.raises(UsageError, match="origin: expected a row of the file for each of"):
        replace(read, **columns)
    assert len(replace(read, **columns, origin=None)) == 2 * len(read)


NO_COLOURS = [(1.0, 1.0), (1.0, 1.0, math.nan), (255.0, 0.0, 0.0), "bluish", 3, "rgb(0 51,300)", "rgb(0 51 300 / 50%)"]


@pytest.mark.parametrize("background", NO_COLOURS)
def test_a_background_is_a_colour(background):
    with pytest.raises(UsageError, match=r"^background: (expected|takes auto or an opaque colour)"):
        Renderer.of(make_scene(6), VIEWS, background=background)


def test_sight_has_a_direction_that_is_not_up():
    eye, up = torch.tensor([0.0, 0.0, -4.0]), torch.tensor([0.0, -1.0, 0.0])
    with pytest.raises(UsageError, match="target: expected a place other than"):
        look_at(eye, eye, up)
    with pytest.raises(UsageError, match="up: expected a direction other than"):
        look_at(eye, 2 * up + eye, up)


def test_a_name_that_a_registry_lacks_is_a_key_error_and_ours():
    for error in (KeyError, UsageError):
        with pytest.raises(error, match="did you mean mip"):
            RECIPES["mipp"]
    assert RECIPES.get("mipp") is None
    assert pickle.loads(pickle.dumps(RECIPES)) is RECIPES


@pytest.mark.parametrize("test", ["one", "another"])
def test_types_and_shapes_are_checked_in_every_test(test):
    with pytest.raises(BeartypeCallHintParamViolation):
        listing(3)
    with pytest.raises(TypeCheckError):
        replace(make_splats(6, (8, 8)), depths=torch.zeros(5))
    with pytest.raises(TypeCheckError):
        sh_colour(torch.zeros(6, 4, 3), torch.zeros(5, 3))


KNOWN = sized(make_scene(5))
CHANGES = {
    "a mean": lambda: replace(KNOWN, means=KNOWN.means + 1e-6),
    "a 3D filter": lambda: replace(KNOWN, filter_3d=torch.ones(5)),
    "no extras": lambda: replace(KNOWN, extras={}),
    "an extra column": lambda: replace(KNOWN, extras={**KNOWN.extras, "base_mask": torch.zeros(5)}),
}


@pytest.mark.parametrize("change", CHANGES)
def test_a_scene_is_known_by_all_that_it_is_drawn_by(change):
    assert digest_of_scene(CHANGES[change]()) != digest_of_scene(KNOWN)
    assert digest_of_scene(replace(KNOWN, means=KNOWN.means.clone())) == digest_of_scene(KNOWN)


@dataclass(frozen=True)
class Weighted:
    weights: torch.Tensor

    def __call__(self, splats, camera, training):
        return splats


class Plain:
    def __init__(self, variance):
        self.variance = variance

    __call__ = Weighted.__call__


def made(variance):
    def screen(splats, camera, training):
        return splats.blurred(variance, compensate=True)

    return screen


def many(middle):
    return torch.cat([torch.zeros(5000), torch.tensor([middle]), torch.zeros(5000)]).requires_grad_()


SAME_NAMES = {
    "a function's variable": (made(0.1), made(0.3), made(0.1)),
    "a lambda's number": (
        lambda splats, camera, training: splats.blurred(0.1, compensate=True),
        lambda splats, camera, training: splats.blurred(0.3, compensate=True),
        lambda splats, camera, training: splats.blurred(0.1, compensate=True),
    ),
    "a field": (Plain(0.1), Plain(0.3), Plain(0.1)),
    "one of many numbers": (Weighted(many(0.0)), Weighted(many(1.0)), Weighted(many(0.0))),
    "an argument": (partial(made(0.1), training=1), partial(made(0.3), training=1), partial(made(0.1), training=1)),
}


@pytest.mark.parametrize("change", SAME_NAMES)
def test_a_recipe_is_known_by_what_its_functions_and_objects_hold(change):
    screen, other, same = (replace(RECIPES["classic"], screen=screen).digest for screen in SAME_NAMES[change])
    assert screen == same != other


def test_a_recipe_is_known_by_what_it_draws_by():
    """In every process: test_compiled.py starts one."""
    assert len({recipe.digest for recipe in RECIPES.values()}) == len(RECIPES)
    auto = RECIPES["auto"]
    assert replace(auto, when="always").digest == auto.digest
    assert replace(auto, target_rate=0.6).digest != auto.digest


def test_a_file_that_cannot_be_read_is_named(tmp_path):
    (tmp_path / "folder").mkdir()
    for name, problem in (("missing", "no such file or directory"), ("folder", "is a directory")):
        with pytest.raises(FormatError, match=f"{name}: cannot be read: {problem}"):
            digest_of_files([tmp_path / name])
