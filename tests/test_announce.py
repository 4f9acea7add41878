"""Long and large jobs are told before they start, and what the machine cannot hold is refused."""

from dataclasses import replace

import pytest

from aaplug.core.cameras import CameraSet
from aaplug.finetuning.settings import Settings
from aaplug.options.verbs import RenderOptions
from aaplug.rendering.cost import EAGER, GRADIENTS, cost_of
from aaplug.rendering.job import Job
from aaplug.rendering.renderer import Renderer
from aaplug.system.errors import UsageError
from aaplug.system.monitor import Monitor
from aaplug.verbs.bench import bench
from aaplug.verbs.evaluate import evaluate
from aaplug.verbs.finetune import _cost, finetune
from tests.conftest import make_camera, make_scene


class Heard(Monitor):
    def __init__(self):
        self.said = []

    def say(self, text):
        self.said.append(text)


def job(monitor: Monitor) -> Job[RenderOptions]:
    view = make_camera()
    return Job.of(make_scene(50), CameraSet((view,), (view,)), RenderOptions(monitor=monitor))


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
    job(heard).announce([renderer], [make_camera()])
    assert heard.said == []
    views = [make_camera(size=(3936, 2960))] * 97
    job(heard).announce([renderer], views)
    assert heard.said == ["97 images at 3936x2960: about 5 minutes; fewer views take less"]


def test_recipes_and_steps_are_told(monkeypatch):
    monkeypatch.setattr("aaplug.rendering.job.LONG_JOB", 0.0)
    scene, cameras, heard = make_scene(50), [make_camera(), make_camera((2.0, -4.0, 1.0), name="b")], Heard()
    cameras = CameraSet(tuple(cameras), tuple(cameras))
    how = {"rasterizer": "eager", "monitor": heard}
    evaluate(scene, cameras, recipe=("classic", "mip", "auto"), scale=(1.0, 0.5), **how)
    finetune(scene, cameras, steps=2, scale=(0.5,), **how)
    told = [said for said in heard.said if said.endswith("take less")]
    assert [said.partition(":")[0] for said in told] == ["12 images at 32x24, 64x48", "2 steps at 64x48"]


def test_a_step_is_estimated_with_its_anchor_and_its_truths(renderer):
    view = make_camera(size=(100, 50))
    frame, half = (cost_of([renderer], [view.scaled(scale)]).seconds for scale in (1.0, 0.5))
    settings = Settings("test", 10, {0.5: 1.0}, {}, anchor=0.0)
    assert _cost(renderer, [view], settings).seconds == pytest.approx(GRADIENTS * 10 * half + 2 * frame)
    anchored = replace(settings, anchor=3.0)
    assert _cost(renderer, [view], anchored).seconds == pytest.approx(GRADIENTS * 10 * (half + frame) + 2 * frame)


def test_what_the_machine_cannot_hold_is_refused(renderer, monkeypatch):
    monkeypatch.setenv("AAPLUG_MEMORY_SHARE", "1e-3")
    with pytest.raises(UsageError, match=r"1 image at 1000x1000: would take 0.0 GB, more than 0% of this machine's"):
        job(Heard()).announce([renderer], [make_camera(size=(1000, 1000))])
    with pytest.raises(UsageError, match=r"1,000,000 with gradients take 1.2 GB, more than"):
        bench(gaussians=(1_000_000,), resolution=("10x10",), rasterizer="eager", repeats=1)
