"""Kernels compiled ahead of time: the same answers, and a cache that nothing can break."""

import zipfile
from dataclasses import replace

import pytest
import torch

from aaplug.core import kernels
from aaplug.core.errors import UsageError
from aaplug.core.kernels import EAGER, CompiledKernels, Kernel, Package
from aaplug.methods.recipes import RECIPES
from aaplug.rasterizers import RASTERIZERS, Tiled, reference
from aaplug.rasterizers.tiled import ahead_of_time as compiled
from aaplug.rendering.renderer import learn, render
from tests.conftest import make_camera, make_scene, sized

ANSWER = 1e-5


@pytest.fixture
def built() -> CompiledKernels:
    found = compiled.load()
    if found is None:
        pytest.skip("the kernels are not compiled here (aaplug warmup)")
    return found


@pytest.fixture
def empty_cache(tmp_path, monkeypatch):
    monkeypatch.setattr(compiled.platformdirs, "user_cache_dir", lambda *_, **__: str(tmp_path))
    return tmp_path


@pytest.mark.parametrize("kernel", compiled.KERNELS, ids=lambda kernel: kernel.name)
def test_compiled_kernels_give_the_eager_answer(built, kernel: Kernel):
    args, twins = kernel.example(), kernel.example()
    answers = zip(
        [*built.run(kernel, *args), *args], [*EAGER.run(kernel, *twins), *twins], strict=True
    )
    for fast, slow in answers:  # what comes back, and what was updated in place
        assert fast.dtype == slow.dtype
        # behind a splat of alpha 0.99 a gradient has a hundred times the rounding of its alpha
        scale = 1 + slow.double().abs().max()
        assert (fast.double() - slow.double()).abs().max() < 10 * ANSWER * scale


@pytest.mark.parametrize("name", ["composite-point", "composite-point-backward"])
def test_compositing_is_one_loop_over_tiles(built, name):
    with zipfile.ZipFile(compiled.cache_folder() / f"{name}.pt2") as package:
        sources = [package.read(n).decode() for n in package.namelist() if "kernel.cpp" in n]
    assert sum(source.count("for(int64_t x0=") for source in sources) == 1


def test_packages_are_checked_by_one_thread_and_all_are_there_after_that(built, monkeypatch):
    seen, close, threads = [], compiled._close, torch.get_num_threads()
    monkeypatch.setattr(
        compiled, "_close", lambda *x: seen.append(torch.get_num_threads()) or close(*x)
    )
    try:
        torch.set_num_threads(2)
        assert compiled.load() is not None
        assert set(seen) == {1}
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(threads)


@pytest.mark.parametrize("recipe", RECIPES)
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_compiled_images_are_the_eager_ones(built, recipe, degree):
    scene, camera = sized(make_scene(400, degree=degree)), make_camera(size=(150, 110))
    training, view = learn(scene, [camera]), camera.scaled(0.6)
    fast, eager = (
        render(scene, view, RECIPES[recipe], training, rasterizer)
        for rasterizer in (Tiled(built), RASTERIZERS["eager"])
    )
    difference = (fast.rgb - eager.rgb).abs().amax(dim=2)
    assert (difference > ANSWER).double().mean() < 1e-3, "more than flips at a cut-off"
    assert difference.max() < 0.02


def test_compiled_kernels_leave_gradients_and_other_precisions_to_the_eager_ones(built):
    scene = make_scene(100, dtype=torch.float64)
    camera = make_camera()
    training = learn(scene, [camera])
    exact = render(scene, camera, RECIPES["classic"], training, Tiled(built)).rgb
    assert exact.dtype == torch.float64
    eager = render(scene, camera, RECIPES["classic"], training).rgb
    assert exact.equal(eager)
    means = scene.means.clone().requires_grad_()
    image = render(replace(scene, means=means), camera, RECIPES["classic"], training, Tiled(built))
    image.rgb.sum().backward()
    assert means.grad is not None
    assert means.grad.abs().sum() > 0


def test_an_empty_cache_gives_nothing(empty_cache):
    assert compiled.load() is None


def test_a_broken_package_gives_nothing_and_does_not_raise(built, empty_cache):
    folder = compiled.cache_folder()
    folder.mkdir(parents=True)
    for kernel in compiled.KERNELS:
        (folder / f"{kernel.name}.pt2").write_bytes(b"not a package")
    assert compiled.load() is None


def test_another_source_is_another_folder(monkeypatch):
    before = compiled.cache_folder()
    assert compiled.cache_folder() == before
    monkeypatch.setattr(compiled, "OPTIONS", {"max_fusion_size": 1})
    assert compiled.cache_folder() != before


@pytest.mark.parametrize("compiler", [True, False])
def test_without_packages_auto_runs_eagerly_and_says_why(empty_cache, monkeypatch, compiler):
    monkeypatch.setattr(compiled, "has_compiler", lambda: compiler)
    said: list[str] = []
    assert compiled.choose("auto", 1, said.append) is RASTERIZERS["eager"]
    assert len(said) == 1
    assert ("warmup" if compiler else "no C++ compiler") in said[0]


def test_many_frames_build_what_is_missing(empty_cache, monkeypatch):
    made = CompiledKernels({})
    monkeypatch.setattr(compiled, "has_compiler", lambda: True)
    monkeypatch.setattr(compiled, "build", lambda: made)
    chosen = compiled.choose("auto", compiled.FRAMES_THAT_PAY, lambda text: None)
    assert isinstance(chosen, Tiled)
    assert chosen.kernels is made


def test_without_a_compiler_a_build_is_refused_in_words(empty_cache, monkeypatch):
    monkeypatch.setattr(compiled, "has_compiler", lambda: False)
    with pytest.raises(UsageError, match=r"warmup: needs a C\+\+ compiler"):
        compiled.build()


def test_a_build_that_fails_leaves_auto_eager_and_says_so(empty_cache, monkeypatch):
    def fails():
        raise UsageError("warmup", "torch cannot compile 'owners' here")

    monkeypatch.setattr(compiled, "has_compiler", lambda: True)
    monkeypatch.setattr(compiled, "build", fails)
    said: list[str] = []
    chosen = compiled.choose("auto", compiled.FRAMES_THAT_PAY, said.append)
    assert chosen is RASTERIZERS["eager"]
    assert "cannot compile 'owners'" in said[-1]
    with pytest.raises(UsageError, match="cannot compile 'owners'"):
        compiled.choose("compiled", 1, said.append)


def test_a_kernel_that_does_not_compile_is_named(empty_cache, monkeypatch):
    def fails(*args, **options):
        raise KeyError("buf14")

    monkeypatch.setattr(torch._inductor, "aoti_compile_and_package", fails)
    with pytest.raises(UsageError, match=r"warmup: torch .* cannot compile 'owners' here"):
        compiled._build("owners")


def test_an_unknown_name_lists_the_known_ones():
    with pytest.raises(UsageError, match="'fast' is not one of auto, compiled, eager, reference"):
        compiled.choose("fast", 1, lambda text: None)


def test_one_row_is_left_to_the_eager_function():
    ran = CompiledKernels({"double": Package.of(lambda args: [3 * args[0]], (torch.ones(4),))})
    double = Kernel("double", lambda x: (2 * x,), lambda: (torch.ones(4),), ("n",))
    assert ran.run(double, torch.ones(1))[0].item() == 2
    assert ran.run(double, torch.ones(2))[0].tolist() == [3, 3]
    assert ran.run(double, torch.ones(2).double())[0].tolist() == [2, 2]
    assert kernels.EAGER.run(double, torch.ones(2))[0].tolist() == [2, 2]


def test_the_judge_runs_no_compiled_stage():
    assert RASTERIZERS["reference"].kernels is EAGER
    assert reference.Reference().kernels is EAGER
