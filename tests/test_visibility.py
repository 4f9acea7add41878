"""How much of each Gaussian views show, and what merging makes of it."""

import math
from dataclasses import replace

import pytest
import torch

import aaplug
from aaplug import CameraSet, TrainingViews
from aaplug.core.gaussians import Gaussians, joined
from aaplug.levels.clusters import clusters_of, merge_pairs
from aaplug.levels.merging import Goal, merge
from aaplug.rendering.renderer import own_look
from aaplug.rendering.visibility import visibility
from aaplug.system.executors import torch_threads
from tests.conftest import make_camera, make_scene

RATE = 40.0  # px per world unit
FRONT = make_camera((0.0, -4.0, 0.0), (96, 96))
WALL = 0.6  # opacity


def one(place: tuple[float, float, float], size: float, opacity: float) -> Gaussians:
    """A round Gaussian."""
    scene = make_scene(1)
    columns = {"means": torch.tensor([place]), "log_scales": torch.full((1, 3), math.log(size))}
    return replace(scene, **columns, logit_opacities=torch.tensor([opacity]).logit())


def wall_and_behind(opacity: float) -> Gaussians:
    """A wide Gaussian, and a small one behind it as the camera in front sees it."""
    return joined([one((0.0, 0.0, 0.0), 0.4, opacity), one((0.0, 0.5, 0.0), 0.03, 0.5)])


def shown(
    scene: Gaussians, *eyes: tuple[float, float, float], rasterizer: str = "eager", side: int = 96
) -> torch.Tensor:
    views = [make_camera(eye, (side, side)) for eye in eyes] or [FRONT]
    return visibility(own_look(scene, TrainingViews.of(scene, views), rasterizer), views, 0.5)


@pytest.mark.parametrize("opacity", [0.2, WALL, 0.95])
def test_behind_a_wall_is_seen_what_the_wall_lets_through(opacity):
    front, behind = shown(wall_and_behind(opacity)).tolist()
    assert front == pytest.approx(1, abs=0.03)
    assert behind == pytest.approx(1 - opacity, abs=0.03)


def test_the_view_that_shows_most_counts():
    scene = wall_and_behind(0.95)
    assert shown(scene)[1] < 0.1
    assert shown(scene, (0.0, -4.0, 0.0), (0.0, 4.0, 0.0))[1] > 0.9


@pytest.mark.parametrize("place", [(0.0, -9.0, 0.0), (5.0, 0.0, 0.0)], ids=["behind", "beside"])
def test_of_what_lies_in_no_image_nothing_is_known(place):
    scene = joined([make_scene(20), one(place, 0.1, 0.9)])
    found = shown(scene)
    assert found[-1].isnan()
    assert (found[:-1] > 0).any()
    assert shown(one(place, 0.1, 0.9), rasterizer="reference").isnan().all()


@pytest.mark.parametrize("size", [0.05, 1.0, 10.0])
@pytest.mark.parametrize("opacity", [0.02, 0.9])
def test_all_is_seen_of_what_nothing_hides_however_large_and_faint(size, opacity):
    """Only what lies in the image counts, above the cut-off of alpha."""
    assert shown(one((0.1, 0.0, -0.2), size, opacity))[0] > 0.85


def test_lod_leaves_out_what_is_hidden_from_its_cameras():
    """Without cameras, nothing counts as hidden: the orbit's views stand in, and may look from the wrong side."""
    wall = one((0.0, 0.0, 0.0), 0.4, 0.99)
    layers = [replace(wall, means=torch.tensor([[0.0, 0.02 * i, 0.0]])) for i in range(4)]
    hidden = replace(make_scene(8), means=make_scene(8).means * 0.02 + torch.tensor([0.0, 0.7, 0.0]))
    hidden.log_scales[:], hidden.logit_opacities[:] = math.log(0.02), 2.0
    scene = joined([*layers, hidden])
    views = tuple(make_camera((x, -4.0, 0.0), (96, 96)) for x in (-0.2, 0.0, 0.2))
    found = [aaplug.lod(scene, known, levels=1, steps=1)[1].scene for known in (CameraSet(views, views), None)]
    behind = [int((level.means[:, 1] > 0.4).sum()) for level in found]
    assert behind[0] == 0
    assert behind[1] > 0


def test_it_equals_the_reference_rasterizers():
    scene, eyes = make_scene(150), ((0.0, -4.0, 0.0), (3.0, -2.0, 1.0))
    fast, slow = (shown(scene, *eyes, rasterizer=name) for name in ("eager", "reference"))
    torch.testing.assert_close(fast, slow, rtol=1e-3, atol=1e-5, equal_nan=True)
    assert (fast > 0).sum() > 100


def test_it_does_not_depend_on_the_number_of_threads():
    found = []
    for threads in (1, 2):
        with torch_threads(threads):
            found.append(shown(make_scene(500), (0.0, -4.0, 0.0), (3.0, -2.0, 1.0), side=512))
    assert torch.equal(*(share.nan_to_num(-1) for share in found))


def test_a_level_leaves_out_what_is_hidden_and_keeps_it_where_nothing_is_known():
    scene, rates = make_scene(40), torch.full((40,), RATE)
    hidden = torch.arange(40) % 2 == 0
    goal = Goal(1.0, tolerance=0.0)
    assert len(merge(scene, rates, goal).scene) == 40
    left = merge(scene, rates, goal, visible=(~hidden).float()).scene
    assert torch.equal(left.means.sort(dim=0).values, scene.means[~hidden].sort(dim=0).values)


def test_equally_visible_gaussians_merge_alike_for_a_tolerance_of_their_squared_share():
    scene, rates, share = make_scene(60), torch.full((60,), RATE), 0.4
    found = [
        merge(scene, rates, Goal(0.1, tolerance=0.3 * own**2), visible=torch.full((60,), own)).scene
        for own in (1.0, share)
    ]
    assert len(found[0]) < 50
    for name, column in found[0].columns.items():
        torch.testing.assert_close(found[1].columns[name], column, rtol=1e-3, atol=1e-4)


def test_a_hidden_gaussian_adds_nothing_to_the_seen_one_that_it_is_merged_with():
    scene = joined([one((0.0, 0.0, 0.0), 0.1, 0.5), one((0.0, 0.1, 0.0), 0.1, 0.5)])
    scene.sh[:, 0] = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    clusters = clusters_of(scene, torch.full((2,), RATE), visible=torch.tensor([1.0, 0.0]))
    seen, hidden = (clusters[torch.tensor([place])] for place in range(2))
    both = merge_pairs(seen, hidden)
    for name in ("means", "covs", "opacities", "colours", "visible"):
        torch.testing.assert_close(getattr(both, name), getattr(seen, name), rtol=5e-3, atol=5e-3)
