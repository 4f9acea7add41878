"""The benchmark: figures that are measured, scenes that are what they say."""

import sys
from pathlib import Path

import pytest

from aaplug import CameraSet, Renderer, UsageError, bench, lod, read_scene, write_scene
from aaplug.core.kernels import EAGER
from aaplug.rendering.benchmark import Figures, exponent, measure, synthetic_camera, synthetic_scene
from tests.conftest import make_camera, make_scene

STAGES = ["project", "filter", "cull", "shade", "bin", "forms", "composite"]


def test_figures_of_a_small_scene():
    camera = synthetic_camera(40, 24).as_trained()
    run = measure(Renderer.of(synthetic_scene(500), [camera], "classic"), camera, EAGER, repeats=1)
    assert run.rasterizer == "eager"
    assert (run.gaussians, run.width, run.height) == (500, 40, 24)
    assert list(run.stages_ms) == STAGES
    assert min(run.stages_ms.values()) > 0
    assert run.forward_ms > 0
    assert run.forward_backward_ms > 0
    assert run.evaluations % 64 == 0
    assert run.ns_per_evaluation == pytest.approx(run.stages_ms["composite"] * 1e6 / run.evaluations)
    assert run.peak_bytes > 1e7
    assert run.exponentials == pytest.approx(run.forward_ms * 1e6 / run.evaluations / run.exponential_ns)
    assert run.calls["operators"] > 100
    assert run.calls["compiled kernels"] == 0


def test_synthetic_scenes_cover_the_image_alike_at_every_size():
    camera = synthetic_camera(96, 96)
    alphas = []
    for n in (3000, 30000):
        scene = synthetic_scene(n)
        assert len(scene) == n
        assert scene.means.isfinite().all()
        alphas.append(Renderer.of(scene, [camera], "classic")(camera).alpha.mean().item())
    assert min(alphas) > 0.8
    assert alphas[0] == pytest.approx(alphas[1], abs=0.1)


@pytest.mark.parametrize("power", [0.5, 1.0, 2.0])
def test_the_exponent_of_a_power_is_found(power):
    sizes = [10.0, 100.0, 1000.0]
    assert exponent(sizes, [3 * size**power for size in sizes]) == pytest.approx(power)


BENCH = "bench --rasterizer eager --repeats 1 --resolution 40x24"


def test_cameras_without_a_scene_are_refused(program):
    program.refused("bench --cameras .", "--cameras: belongs to a scene; name one, too")


def test_one_run_is_one_object_also_on_windows(program, monkeypatch):
    monkeypatch.setitem(sys.modules, "resource", None)
    figures = program.facts(f"{BENCH} --gaussians 300")
    assert figures["peak_bytes"] is None
    names = "rasterizer forward_ms forward_backward_ms evaluations ns_per_evaluation stages_ms peak_bytes"
    assert set(names.split()) <= set(figures)
    assert figures["gaussians"] == 300


def test_several_runs_are_a_table_with_exponents_that_breaks_no_word_at_80_columns(program, monkeypatch):
    stages = {"cut": 123.0} | dict.fromkeys(STAGES, 123.0) | {"composite": 123_456.0}
    rest = 12345.0, 45678.0, 10**8, 12.34, stages, 10**11, {"operators": 1234}, 1.0

    def large(drawn, *_):
        return Figures("compiled", 10_000 * len(drawn.scene), 1600, 1060, *rest)

    monkeypatch.setattr("aaplug.verbs.bench.measure", large)
    said, _ = program.done(f"{BENCH} --gaussians 300 600")
    assert "time grows as compiled: Gaussians^" in said
    assert "compiled: pixels" not in said
    assert {"3,000,000", "1600x1060", "compiled", *stages, "123456", "45678", "exp/eval", "ns/eval"} <= {*said.split()}


def test_the_middle_scene_is_drawn_at_every_size(program):
    found = program.facts(f"{BENCH} 48x32 --gaussians 300 400 500")
    sizes = [(run["gaussians"], run["width"]) for run in found["runs"]]
    assert sizes == [(300, 40), (400, 40), (500, 40), (400, 48)]
    assert set(found["exponents"]) == {"eager: Gaussians", "eager: pixels"}


@pytest.fixture(scope="module")
def model(tmp_path_factory) -> Path:
    """A folder of two levels, and cameras of 64x48 px."""
    folder = tmp_path_factory.mktemp("model")
    views, scene = [make_camera(name=name) for name in "ab"], make_scene(400)
    cameras = CameraSet(tuple(views), tuple(views))
    how = {"levels": 2, "refine": False, "rasterizer": "eager"}
    lod(scene, cameras, folder / "levels", **how)
    write_scene(folder / "whole.ply", scene)
    return folder


@pytest.mark.parametrize("scene", ["levels", "whole.ply"])
def test_a_scene_is_timed_as_it_is_drawn_at_the_sizes_that_are_asked_for(model, scene):
    cameras = CameraSet(*[(make_camera(),)] * 2)
    how = {"rasterizer": "eager", "repeats": 1}
    with pytest.raises(UsageError, match="gaussians: are of synthetic scenes"):
        bench(model / scene, gaussians=(300,), **how)
    runs = [
        *bench(model / scene, cameras, **how).runs,
        *bench(model / scene, cameras, resolution=("64x48", "16x12"), **how).runs,
    ]
    assert [(run.width, run.height) for run in runs] == [(64, 48), (64, 48), (16, 12)]
    first, second, small = (run.gaussians for run in runs)
    coarsest = read_scene(model / "levels").levels.sizes[1]
    assert first == second > coarsest
    assert small == 400 if scene == "whole.ply" else 0 < small <= coarsest
    assert runs[2].evaluations < runs[0].evaluations
