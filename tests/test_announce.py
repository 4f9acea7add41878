"""Long and large jobs are told before they start, and what the machine cannot hold is refused."""

from dataclasses import replace

import pytest
import torch

from aaplug import CameraSet, Monitor, Orbit, Render, UsageError, bench, evaluate, render, video
from aaplug.finetuning.settings import Settings
from aaplug.io import limits
from aaplug.io.limits import SAMPLE_BYTES
from aaplug.methods.recipe import MAX_SAMPLES
from aaplug.options.verbs import RenderOptions
from aaplug.rendering import job as jobs
from aaplug.rendering.assumed import CROP_SAMPLES
from aaplug.rendering.cost import EAGER, GRADIENTS, cost_of
from aaplug.rendering.job import Job
from aaplug.rendering.renderer import Drawing, Renderer
from aaplug.system import groups
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


@pytest.fixture
def machine_alone(monkeypatch, tmp_path):
    monkeypatch.setattr(groups, "CONTROL_GROUPS", tmp_path / "none")


def test_what_the_machine_cannot_hold_is_refused(renderer, machine_alone, monkeypatch):
    monkeypatch.setenv("AAPLUG_MEMORY_SHARE", "1e-3")
    with pytest.raises(UsageError, match=r"1 image at 1000x1000: would take 0.0 GB, more than 0% of this machine's"):
        job(Heard()).announce([renderer], [make_camera(size=(1000, 1000))])
    with pytest.raises(UsageError, match=r"1,000,000 with gradients take 1.2 GB, more than"):
        bench(gaussians=(1_000_000,), resolution=("10x10",), rasterizer="eager", repeats=1)
    with pytest.raises(UsageError, match=r"view view at 9000x9000: with 1×1 samples per pixel would take 2.6 GB, more"):
        renderer(make_camera(size=(9000, 9000)))


FAR = Orbit(eye=(0.0, 0.0, 1000.0))
JOBS = {
    "render, far": lambda scene, **how: render(scene, FAR, "images", resolution="40x40", **how),
    "video": lambda scene, **how: video(scene, Orbit(), None, path="dolly", seconds=0.1, scale=0.05, end=50.0, **how),
    "evaluate, distance": lambda scene, **how: evaluate(
        scene, Orbit(train_view="64x48", orbit=1), protocol="distance", scale=(0.02, 1.0), **how
    ),
    "evaluate, fov": lambda scene, **how: evaluate(
        scene, Orbit(train_view="64x48", orbit=1), protocol="fov", scale=(0.02,), recipe="classic", **how
    ),
}


@pytest.mark.parametrize("name", JOBS)
def test_memory_is_checked_before_anything_is_drawn_and_for_what_is_drawn(name, monkeypatch, tmp_path):
    checked, drawn = [], []

    def draw(renderer, camera):
        assert checked, "drawn before memory was checked"
        drawn.append(SAMPLE_BYTES * camera.width * camera.height * renderer.samples(camera) ** 2)
        blank = Render(torch.zeros(*camera.hw, 3), torch.ones(camera.hw))
        return Drawing(blank, renderer.splats(camera), camera.hw)

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(Renderer, "draw", draw)
    monkeypatch.setattr(jobs, "lack_of_memory", checked.append)
    JOBS[name](make_scene(50), rasterizer="eager")
    crop = SAMPLE_BYTES * (2 * CROP_SAMPLES) ** 2  # drawn to tell how much hangs on the assumed rate
    assert max(drawn) <= max(*checked, crop)
    monkeypatch.setattr(jobs, "lack_of_memory", lambda needed: "more than there is")
    drawn.clear()
    with pytest.raises(UsageError, match=r"would take more than there is; a smaller `scale` or fewer `threads`"):
        JOBS[name](make_scene(50), rasterizer="eager", overwrite=True)
    assert not drawn


@pytest.mark.parametrize("factor", [1e-3, 1e-9])
def test_samples_have_a_bound(factor):
    camera = make_camera()
    renderer = Renderer.of(make_scene(50), [camera], rasterizer="eager")
    tiny = camera.scaled(factor)
    assert renderer.samples(tiny) == MAX_SAMPLES
    assert renderer(tiny).rgb.shape == (1, 1, 3)


LIMITS = [  # groups of a process, and the file of a limit
    ("0::/job/step\n", "memory.max"),
    ("0::/job/step\n", "job/memory.max"),
    ("9:cpu:/\n4:memory:/docker/1\n0::/\n", "memory/memory.limit_in_bytes"),
    ("4:hugetlb,memory:/docker/1\n", "memory/docker/1/memory.limit_in_bytes"),
]


@pytest.mark.parametrize(("lines", "file"), LIMITS)
def test_the_limit_of_a_container_counts_where_it_has_one(machine_alone, lines, file, monkeypatch, tmp_path):
    machine = limits.usable_memory()
    root = tmp_path / "cgroup"
    (root / file).parent.mkdir(parents=True)
    (root / file).write_text("1000000000\n")
    (tmp_path / "groups").write_text(lines)
    (root / "memory.high").write_text("5\n")
    monkeypatch.setattr(groups, "ROOT", root)
    monkeypatch.setattr(groups, "CONTROL_GROUPS", tmp_path / "groups")
    assert limits.lack_of_memory(4e8) is None
    assert limits.lack_of_memory(6e8) == "0.6 GB, more than 50% of this container's 1.0 GB"
    (root / file).write_text("max\n")
    assert limits.usable_memory() == machine


def test_what_ulimit_leaves_counts(machine_alone, monkeypatch, tmp_path):
    resource = pytest.importorskip("resource")
    (tmp_path / "statm").write_text(f"{5 * 10**8 // resource.getpagesize()} 1 1\n")
    monkeypatch.setattr(limits, "STATM", tmp_path / "statm")
    monkeypatch.setattr(resource, "getrlimit", lambda which: (15 * 10**8, -1))
    assert limits.lack_of_memory(4e8) is None
    assert limits.lack_of_memory(6e8) == "0.6 GB, more than 50% of the 1.0 GB that `ulimit -v` leaves"
