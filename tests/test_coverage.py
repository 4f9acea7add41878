"""How Gaussians sit against their sampling bounds."""

from dataclasses import replace

import pytest
import torch

from aaplug.core.conventions import CLASSIC
from aaplug.core.training import TrainingViews
from aaplug.evaluation.coverage import coverage, log_multiples
from tests.conftest import make_camera, make_scene


def at_bound(multiple: float, n: int = 10):
    """Round Gaussians at the origin whose extent is that multiple of their bound."""
    view = make_camera((0.0, -4.0, 0.0))
    sigma = multiple * 0.2**0.5 / (view.focal / 4.0)
    scene = replace(make_scene(n), means=torch.zeros(n, 3), log_scales=torch.full((n, 3), sigma).log())
    return scene, TrainingViews.of(scene, [view])


@pytest.mark.parametrize("multiple", [0.5, 1.01, 3.0])
def test_the_multiple_is_the_extent_over_the_bound(multiple):
    scene, training = at_bound(multiple)
    found = log_multiples(scene, training.bounds).exp()
    assert found == pytest.approx([multiple] * 10, rel=1e-4)
    assert coverage(scene, training, ()).under == (multiple < 1)


def test_aliasing_begins_where_what_training_drew_meets_the_bound():
    scene, training = at_bound(2.0)
    assert scene.convention == CLASSIC
    found = coverage(scene, training, (1.0, 0.5, 0.4, 0.25))
    # σ²ν² = 4·0.2 px², and 0.3 px² of dilation: r²·1.1 = 0.2
    assert found.begins == pytest.approx((0.2 / 1.1) ** 0.5, rel=1e-4)
    assert dict(found.aliased) == {1.0: 0.0, 0.5: 0.0, 0.4: 1.0, 0.25: 1.0}


@pytest.mark.parametrize(("shift", "seen"), [(0.0, True), (1e6, False)])
def test_every_seen_gaussian_is_in_the_histogram(shift, seen):
    scene = make_scene(400)
    scene = replace(scene, means=scene.means + shift, log_scales=scene.log_scales * 6)  # far into both ends
    training = TrainingViews.of(scene, [make_camera()])
    found = coverage(scene, training, (1.0,))
    assert sum(found.counts) == found.seen == int(training.bounds.seen.sum())
    assert (found.gaussians, found.seen > 0) == (400, seen)
    if not seen:
        assert (found.under, found.begins, found.aliased) == (None, None, ())
