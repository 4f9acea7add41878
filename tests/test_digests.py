"""Hashes that tell a continued run whether anything that its result depends on has changed."""

from dataclasses import replace

import pytest
import torch

from aaplug.core.digests import digest_of_scene
from tests.conftest import make_scene, sized

SCENE = sized(make_scene(5))
SIZES = SCENE.pixel_sizes
CHANGES = {
    "a mean": lambda: replace(SCENE, means=SCENE.means + 1e-6),
    "no pixel sizes": lambda: replace(SCENE, pixel_sizes=None),
    "a smallest size": lambda: replace(SCENE, pixel_sizes=replace(SIZES, smallest=SIZES.smallest + 1)),
    "a largest size": lambda: replace(SCENE, pixel_sizes=replace(SIZES, largest=SIZES.largest + 1)),
    "a base": lambda: replace(SCENE, pixel_sizes=replace(SIZES, base=~SIZES.base)),
    "a 3D filter": lambda: replace(SCENE, filter_3d=torch.ones(5)),
}


@pytest.mark.parametrize("change", CHANGES)
def test_a_scene_is_known_by_all_that_it_is_drawn_by(change):
    assert digest_of_scene(CHANGES[change]()) != digest_of_scene(SCENE)
    assert digest_of_scene(replace(SCENE, means=SCENE.means.clone())) == digest_of_scene(SCENE)
