"""Hashes that tell a continued run whether anything that its result depends on has changed."""

from dataclasses import dataclass, replace
from functools import partial

import pytest
import torch

from aaplug import RECIPES, FormatError
from aaplug.core.gaussians import digest_of_scene
from aaplug.system.digests import digest_of_files
from tests.conftest import make_scene, sized

SCENE = sized(make_scene(5))
CHANGES = {
    "a mean": lambda: replace(SCENE, means=SCENE.means + 1e-6),
    "a 3D filter": lambda: replace(SCENE, filter_3d=torch.ones(5)),
    "no extras": lambda: replace(SCENE, extras={}),
    "an extra column": lambda: replace(SCENE, extras={**SCENE.extras, "base_mask": torch.zeros(5)}),
}


@pytest.mark.parametrize("change", CHANGES)
def test_a_scene_is_known_by_all_that_it_is_drawn_by(change):
    assert digest_of_scene(CHANGES[change]()) != digest_of_scene(SCENE)
    assert digest_of_scene(replace(SCENE, means=SCENE.means.clone())) == digest_of_scene(SCENE)


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
