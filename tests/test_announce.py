"""Long and large jobs are told before they start, and what the machine cannot hold is refused."""

from dataclasses import replace

import pytest

from aaplug.core.errors import UsageError
from aaplug.core.monitor import Monitor
from aaplug.rendering.cost import EAGER, cost_of
from aaplug.rendering.renderer import Renderer
from aaplug.verbs.announce import announce
from aaplug.verbs.bench import bench
from tests.conftest import make_camera, make_scene


class Heard(Monitor):
    def __init__(self):
        self.said = []

    def say(self, text):
        self.said.append(text)


@pytest.fixture
def renderer() -> Renderer:
    return Renderer.of(make_scene(50), [make_camera()], "classic", rasterizer="eager")


def test_the_estimate_counts_gaussians_and_samples(renderer):
    views = [make_camera(size=(100, 50)), make_camera(size=(200, 50))]
    per_gaussian, per_sample = EAGER
    expected = 2 * 50 * per_gaussian + 15_000 * per_sample
    assert cost_of([renderer], views).seconds == pytest.approx(expected)
    assert cost_of([renderer, renderer], views).seconds == pytest.approx(2 * expected)
    fine = replace(renderer, recipe=replace(renderer.recipe, grid=3))
    assert cost_of([fine], views).image == 9 * cost_of([renderer], views).image


def test_only_long_and_large_jobs_are_told(renderer):
    heard = Heard()
    announce([renderer], [make_camera()], heard)
    assert heard.said == []
    views = [make_camera(size=(3936, 2960))] * 97
    announce([renderer], views, heard)
    assert heard.said == ["97 images at 3936x2960: about 5 minutes; fewer views take less"]


def test_what_the_machine_cannot_hold_is_refused(renderer, monkeypatch):
    monkeypatch.setenv("AAPLUG_MEMORY_SHARE", "1e-3")
    with pytest.raises(UsageError, match=r"1 image at 1000x1000: would take 0.0 GB, more than 0% of this machine's"):
        announce([renderer], [make_camera(size=(1000, 1000))], Heard())
    with pytest.raises(UsageError, match=r"1,000,000 with gradients take 1.2 GB, more than"):
        bench(gaussians=(1_000_000,), resolution=("10x10",), rasterizer="eager", repeats=1)
