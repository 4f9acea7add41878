"""Kernels compiled ahead of time: the same results as eager code, and a cache that survives damage."""

import errno
import heapq
import json
import os
import pickle
import re
import shutil
import struct
import sys
import tempfile
import threading
import time
import zipfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from types import CodeType
from unittest.mock import Mock

import pytest
import torch

import aaplug
from aaplug import RECIPES, Renderer, TrainingViews, UsageError
from aaplug.core import projection, shading
from aaplug.core.kernels import EAGER, Kernel, Kernels, where_signed
from aaplug.core.projection import project
from aaplug.gsplat.drawing import OnlyCompiled
from aaplug.methods.pixel_kernels import point
from aaplug.methods.pixel_kernels.point import POINT
from aaplug.methods.pixel_kernels.ray import RAY
from aaplug.rasterizers import RASTERIZERS, choice
from aaplug.rasterizers.choice import find_rasterizer
from aaplug.rasterizers.tiled import Tiled, backward, binning, forward, on_demand, order, packages, sources
from aaplug.rasterizers.tiled import ahead_of_time as compiled
from aaplug.rasterizers.tiled.packages import CompiledKernels, Package
from aaplug.system.executors import torch_threads
from aaplug.system.locks import SCRATCH_PREFIX
from tests.conftest import COMPILED, exit_code, make_camera, make_scene, run_python, sized

ANSWER = 1e-5
CACHE = compiled.cache_folder()


@pytest.fixture
def built() -> CompiledKernels:
    if COMPILED is None:
        pytest.skip("the kernels are not compiled here (aaplug warmup)")
    return COMPILED


@pytest.fixture
def empty_cache(tmp_path, monkeypatch):
    folder = tmp_path / "Caches"
    folder.mkdir()
    monkeypatch.setattr(compiled.platformdirs, "user_cache_dir", lambda *_, **__: str(folder))
    return folder


@pytest.fixture
def compiling(empty_cache, monkeypatch):
    """A function that lets another stand for the pool that compiles packages, none of which is there."""
    monkeypatch.setattr(compiled, "has_compiler", lambda: True)
    return lambda packages_of: monkeypatch.setattr(compiled.Processes, "map", packages_of)


# also those that `warmup` compiles on request, and those of trainers
ALL_KERNELS = [*compiled.kernels_of([*RECIPES.values()]), *compiled.TRAINER_KERNELS]
each_kernel = pytest.mark.parametrize("kernel", ALL_KERNELS, ids=lambda kernel: kernel.name)


@each_kernel
def test_compiled_kernels_give_the_eager_results(built, kernel: Kernel):
    if not compiled.package_path(kernel).is_file():
        pytest.skip("this kernel is not compiled here (aaplug warmup --recipe)")
    args, twins = kernel.example(), kernel.example()
    answers = zip([*built.run(kernel, *args), *args], [*EAGER.run(kernel, *twins), *twins], strict=True)
    for fast, slow in answers:  # results, and arguments updated in place
        assert fast.dtype == slow.dtype
        # behind a splat of alpha 0.99 a gradient has a hundred times the rounding of its alpha
        scale = 1 + slow.double().abs().max()
        assert (fast.double() - slow.double()).abs().max() < 10 * ANSWER * scale


COMPOSITING = [kernel for kernel in ALL_KERNELS if kernel.name.startswith(("composite-", "gaussian-", "order-"))]


@pytest.mark.parametrize("kernel", COMPOSITING, ids=lambda kernel: kernel.name)
def test_examples_show_what_compositing_computes(kernel: Kernel):
    """A broken package is found by its results on the example, so each of them depends on the splats."""
    given, results = kernel.example(), []
    for factor in (1.0, 1.01):
        args = kernel.example()
        args[0].mul_(factor)
        returned = EAGER.run(kernel, *args)
        written = [after for before, after in zip(given[1:], args[1:], strict=True) if not before.equal(after)]
        results.append([*returned, *written])
    assert results[0]
    for one, other in zip(*results, strict=True):
        assert not one.equal(other)


# loops before it find and gather raster rows, and evaluate forms at corners; a loop after it writes the sums out
LOOPS = {
    "composite-point": 4,
    "composite-point-kept": 4,
    "order-point": 3,  # so few splats are found where they are gathered
    "composite-point-backward": 4,
    "gaussian-blending": 1,
}


@pytest.mark.parametrize("name", LOOPS)
def test_compositing_is_one_loop_over_tiles(built, name):
    (kernel,) = (kernel for kernel in ALL_KERNELS if kernel.name == name)
    path = compiled.package_path(kernel)
    if not path.is_file():
        pytest.skip("this kernel is not compiled here (aaplug warmup --recipe)")
    with zipfile.ZipFile(path) as package:
        sources = [package.read(n).decode() for n in package.namelist() if "kernel.cpp" in n]
    assert sum(source.count("for(int64_t x0=") for source in sources) == LOOPS[name]


@pytest.fixture
def copied_cache(built, empty_cache):
    """The packages of this machine alone, without what was unpacked from them."""
    packages = [compiled.package_path(kernel) for kernel in compiled.KERNELS]
    (empty_cache / "kernels").mkdir()
    for package in packages:
        shutil.copy(CACHE / package.name, package)
    return empty_cache / "kernels"


linux = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="bundles are Linux's")
march = pytest.mark.skipif(not hasattr(torch._inductor.config.cpp, "march"), reason="this torch tells g++ no options")


@linux
def test_a_bundle_is_used_where_nothing_is_compiled(built, empty_cache, monkeypatch):
    """The best instruction set that the processor has.  What is unpacked goes to the cache, not to the bundle."""
    kernel, bundle, (best, least) = binning.PAIRS, empty_cache / "bundle", compiled.TARGETS
    bundle.mkdir()
    monkeypatch.setenv("AAPLUG_KERNELS", str(bundle))
    for target, users in ((least, {"AVX2", "AVX512"}), (best, {"AVX512"})):
        package = compiled._path_in(bundle, kernel, target)
        shutil.copy(compiled._path_in(CACHE, kernel), package)
        for capability in ("DEFAULT", "AVX2", "AVX512"):
            monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda name=capability: name)
            assert (compiled.package_path(kernel) == package) == (capability in users)
    assert compiled.package_of(kernel) is not None
    assert {path.suffix for path in bundle.iterdir()} == {".pt2"}
    assert (empty_cache / "kernels" / package.name).with_suffix(".so").is_file()


@linux
def test_a_bundle_is_compiled_for_each_instruction_set_of_this_processor(compiling, empty_cache, monkeypatch):
    built: list[object] = []

    def no_work(pool: object, work: object, packages: Sequence[object]) -> Iterator[tuple[object, str]]:
        built.extend(packages)
        return ((package, "") for package in packages)

    compiling(no_work)
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: "AVX512")
    made = aaplug.warmup(bundle=empty_cache / "bundle")
    kernels = [kernel.name for kernel in (*compiled.KERNELS, *compiled.TRAINER_KERNELS)]
    assert made.names == [f"{name} for {target.name}" for target in compiled.TARGETS for name in kernels]
    assert len(built) == len(set(built)) == len(made.names)
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: "DEFAULT")
    with pytest.raises(UsageError, match="bundle: needs Linux and a processor of x86-64-v4 or x86-64-v3"):
        aaplug.warmup(bundle=empty_cache / "bundle")


def test_packages_are_compared_by_one_thread_which_is_undone_after_that(copied_cache, monkeypatch):
    counts, close = [], compiled._close
    monkeypatch.setattr(compiled, "_close", lambda *x: counts.append(torch.get_num_threads()) or close(*x))
    with torch_threads(2):
        assert compiled._is_sound(compiled.KERNELS[0], compiled.package_path(compiled.KERNELS[0]))
        assert set(counts) == {1}
        assert torch.get_num_threads() == 2


@linux
@march
@pytest.mark.parametrize("counted", [True, False])
def test_a_compiler_counts_registers_where_there_are_few(counted, monkeypatch):
    monkeypatch.setattr(compiled.platform, "machine", lambda: "x86_64")
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: "AVX2" if counted else "AVX512")
    kernels = forward.pass_kernel(point.POINT), backward.step_kernel(point.POINT)
    passes, step = (compiled._configs(kernel)["cpp.march"] for kernel in kernels)
    assert "-fsched-pressure" in step  # it keeps many sums
    bundled = {compiled._configs(kernels[0], target)["cpp.march"]: target for target in compiled.TARGETS}
    assert all(options.startswith(target.name) for options, target in bundled.items())
    few = {passes: counted} | {options: target.capability == "AVX2" for options, target in bundled.items()}
    for options, expected in few.items():
        assert ("-fsched-pressure" in options) == expected
        assert ("-mprefer-vector-width=512" in options) == (not expected)  # else vectors are copied by halves


GCC_11 = "g++-11 (Debian 11.3.0-12) 11.3.0\nCopyright (C) 2021 Free Software Foundation, Inc."


@linux
@march
@pytest.mark.parametrize(
    ("machine", "words", "options"),
    [
        ("x86_64", GCC_11, "-fschedule-insns"),
        ("x86_64", "Debian clang version 14.0.6\nTarget: x86_64-pc-linux-gnu", "-fno-trapping-math"),
        ("x86_64", "Intel(R) oneAPI DPC++/C++ Compiler 2026.0.0", ""),
        ("aarch64", GCC_11, ""),  # there g++ schedules by itself
    ],
)
def test_a_compiler_gets_its_options_whatever_its_file_is_called(machine, words, options, monkeypatch):
    monkeypatch.setattr(compiled.platform, "machine", lambda: machine)
    monkeypatch.setenv("CXX", "/opt/conda/bin/x86_64-conda-linux-gnu-c++")
    monkeypatch.setattr(compiled, "_compiler_version", lambda compiler: words)
    monkeypatch.setattr(compiled, "_processor", lambda: "amx_tile")
    kernel, (target, *_) = forward.pass_kernel(point.POINT), compiled.TARGETS
    configs = compiled._configs(kernel)
    march = configs.get("cpp.march", "")
    assert configs.get(compiled.TRIED_OUT, False) == bool(options)
    assert march.startswith("native" if options else "")
    assert options in march
    if words == GCC_11 and options:
        assert compiled._configs(kernel, target)["cpp.march"].startswith(target.name)
    else:  # what clang compiles needs its OpenMP library, which another machine may lack
        with pytest.raises(UsageError, match=r"bundle: needs g\+\+"):
            compiled._configs(kernel, target)


@linux
def test_headers_are_precompiled_where_their_digest_can_be_computed(monkeypatch):
    if compiled.PRECOMPILES not in torch._inductor.list_options():
        pytest.skip("this torch precompiles no headers")
    for path in (None, "/usr/bin/openssl"):
        monkeypatch.setattr(shutil, "which", lambda name, path=path: path)
        assert compiled._configs(binning.PAIRS).get(compiled.PRECOMPILES, True) == (path is not None)


@linux
@march
def test_a_library_asks_for_no_executable_stack(built):
    """glibc 2.41 loads no library that does, and a bundle may be compiled elsewhere."""
    segment_of_stack, executes = 0x6474E551, 1  # as elf(5) numbers them
    content = compiled.package_path(binning.PAIRS).with_suffix(".so").read_bytes()
    (start,), (size, count) = struct.unpack_from("<Q", content, 32), struct.unpack_from("<2H", content, 54)
    segments = [struct.unpack_from("<2I", content, start + i * size) for i in range(count)]
    [flags] = [flags for kind, flags in segments if kind == segment_of_stack]
    assert not flags & executes


def test_a_library_is_unpacked_and_compared_once_until_it_changes(copied_cache, monkeypatch):
    kernel, compared = binning.PAIRS, []
    monkeypatch.setattr(compiled, "_close", lambda *x: compared.append(x) or True)
    library = compiled.package_path(kernel).with_suffix(".so")
    for change in (None, library.unlink, lambda: library.write_bytes(b"damaged")):
        if change is not None:
            change()
        compared.clear()
        assert compiled._is_sound(kernel, compiled.package_path(kernel))
        assert compared
        compared.clear()
        assert compiled._is_sound(kernel, compiled.package_path(kernel))
        assert not compared


@linux
def test_a_library_that_ended_a_process_is_left_aside(copied_cache, monkeypatch, caplog):
    kernel = binning.PAIRS
    mark = compiled.package_path(kernel).with_suffix(".so.sha256")
    with monkeypatch.context() as patch:
        patch.setattr(compiled, "_opened", lambda library: os._exit(9))
        assert exit_code(lambda: compiled.package_of(kernel)) == 9
        assert compiled.package_of(kernel) is None
    said = f"a process that loaded it died; if it was killed, delete {mark}; images are drawn eagerly"
    assert said in caplog.text
    monkeypatch.setattr(compiled, "lock", lambda descriptor, wait=False: None)
    assert compiled.package_of(kernel) is not None  # where nothing locks, that process may be alive


@linux
def test_a_library_is_not_compared_again_after_waiting_for_another_process(copied_cache, monkeypatch):
    kernel, close, compared, others = binning.PAIRS, compiled._close, list[int](), list[threading.Thread]()

    def slow(result: torch.Tensor, expected: torch.Tensor) -> bool:
        compared.append(threading.get_ident())
        if not others:
            others.append(threading.Thread(target=compiled.package_of, args=[kernel]))
            others[0].start()
            time.sleep(0.1)
        return close(result, expected)

    monkeypatch.setattr(compiled, "_close", slow)
    assert compiled.package_of(kernel) is not None
    others[0].join()
    assert {*compared} == {threading.get_ident()}


def test_a_kernel_that_ends_a_process_is_built_last_next_time(compiling):
    built, deadly = list[str](), compiled.KERNELS[3]
    mark = compiled.package_path(deadly).with_suffix(".so.sha256")
    mark.parent.mkdir()

    dies = Mock(side_effect=UsageError("worker process", "died"))

    def builds(pool: object, work: object, packages: Sequence[tuple[str, None]]) -> Iterator[object]:
        for name, target in packages:
            if name == deadly.name:
                mark.write_text(f"{compiled.TRIED}hash")
                dies()
            built.append(name)
            yield (name, target), ""

    compiling(builds)
    for _ in range(2):
        built.clear()
        with pytest.raises(UsageError, match=f"cannot compile {deadly.name} here: a process that loaded it died$"):
            compiled.build()
    assert sorted([*built, deadly.name]) == sorted(kernel.name for kernel in compiled.kernels_of(()))
    compiling(dies)
    with pytest.raises(UsageError, match="worker process: died"):
        compiled.build()


DRAWS = """if True:
    import os, resource, signal, sys
    from aaplug.evaluation.laws.base import make_camera, make_scene
    from aaplug.rendering.renderer import Renderer
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
    renderer = Renderer.of(make_scene(100), [make_camera()], "classic")
    renderer(make_camera())
    print(renderer.rasterizer.name, flush=True)
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_drawing_writes_nothing_and_a_killed_process_leaves_nothing(built, tmp_path):
    """The folder of temporary files may be full, missing, or not allow programs to run."""
    done = run_python(DRAWS, TMPDIR=tmp_path)
    assert (done.stdout, done.returncode) == ("compiled\n", -9), done.stderr
    assert not [*tmp_path.iterdir()]


def of_another_machine(package: Path) -> None:
    with zipfile.ZipFile(package) as members:
        [name] = [name for name in members.namelist() if name.endswith(".so")]
        library = bytearray(members.read(name))
    library[18:20] = b"\xf3\x00"  # ELF's number of RISC-V
    with zipfile.ZipFile(package, "w") as members:
        members.writestr(name, bytes(library))


DAMAGES = {
    "no package": lambda package: package.write_bytes(b"not a package"),
    "of another kernel": lambda package: shutil.copy(CACHE / compiled.package_path(binning.PAIRS).name, package),
    "of another machine": of_another_machine,
    "cut": lambda package: package.write_bytes(package.read_bytes()[:100_000]),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_or_foreign_package_is_left_aside_with_one_line(copied_cache, damage, caplog):
    package = compiled.package_path(compiled.KERNELS[0])
    DAMAGES[damage](package)
    for _ in range(2):
        assert find_rasterizer("auto") is RASTERIZERS["eager"]
    assert len(caplog.messages) == 1
    assert re.fullmatch(rf"{package}: cannot be used: .+; images are drawn eagerly, .+", caplog.messages[0])


@pytest.mark.parametrize(
    ("name", "error"),
    [
        ("scratch", OSError(errno.EROFS, "read-only file system", "/home/caches")),
        ("_opened", OSError("failed to map segment")),
        ("_opened", OSError("version `GLIBC_2.38' not found")),
    ],
)
def test_a_cache_that_cannot_be_used_means_eager_images_and_one_line(copied_cache, monkeypatch, caplog, name, error):
    """A read-only folder, one that does not allow programs to run, and a bundle of a newer system."""
    monkeypatch.setattr(compiled, name, Mock(side_effect=error))
    assert find_rasterizer("auto") is RASTERIZERS["eager"]
    [line] = caplog.messages
    assert (f"{error.filename}: {error.strerror}" if error.filename else str(error)) in line


def test_a_cache_that_may_not_be_looked_into_is_an_empty_one(empty_cache, monkeypatch):
    """As that of HOME=/root is to other accounts."""

    def denied(path: str | Path, real: Callable[..., object] = os.stat, **how: object) -> object:
        if str(path).startswith(str(empty_cache)):
            raise PermissionError(errno.EACCES, "permission denied", str(path))
        return real(path, **how)

    monkeypatch.setattr(os, "stat", denied)
    assert find_rasterizer("auto", 1) is RASTERIZERS["eager"]
    assert not compiled.is_built(binning.PAIRS)


def test_without_a_home_images_are_eager_and_one_line_says_what_to_set(monkeypatch, caplog):
    """As for an account that the system does not know."""
    pwd = pytest.importorskip("pwd")
    monkeypatch.setattr(pwd, "getpwuid", Mock(side_effect=KeyError))
    for variable in ("HOME", "XDG_CACHE_HOME"):
        monkeypatch.delenv(variable, raising=False)
    compiled._warn.cache_clear()
    assert find_rasterizer("auto") is RASTERIZERS["eager"]
    [line] = caplog.messages
    assert line.startswith("HOME: names no folder to keep kernels in; set it, or XDG_CACHE_HOME; images are drawn")
    assert not compiled.is_built(binning.PAIRS)
    with pytest.raises(UsageError, match="HOME: names no folder"):
        compiled.build()


@pytest.mark.skipif(not hasattr(os, "ST_NOEXEC"), reason="this system does not tell")
def test_nothing_is_compiled_into_a_folder_that_no_program_runs_from(compiling, empty_cache, monkeypatch):
    compiling(Mock(side_effect=AssertionError))
    monkeypatch.setattr(os, "statvfs", lambda path: Mock(f_flag=os.ST_NOEXEC))
    with pytest.raises(UsageError, match=rf"{empty_cache}/kernels is mounted without execution .* XDG_CACHE_HOME"):
        compiled.build()


PIXELS_AND_SELECTIONS = {(r.pixel.name, r.compositor, r.selection): name for name, r in RECIPES.items()}
IMAGES = [(name, 1) for name in PIXELS_AND_SELECTIONS.values()] + [("matched", degree) for degree in (0, 2, 3)]


@pytest.mark.parametrize(("recipe", "degree"), IMAGES)
def test_compiled_images_are_the_eager_ones(built, recipe, degree):
    """The recipe chooses the kernels of a pixel, the degree that of colours."""
    scene, camera = sized(make_scene(400, degree=degree)), make_camera(size=(150, 110))
    view = camera.scaled(0.6)
    fast, eager = (
        Renderer.of(scene, [camera], recipe, rasterizer=rasterizer)(view) for rasterizer in (Tiled(built), Tiled())
    )
    difference = (fast.rgb - eager.rgb).abs().amax(dim=2)
    assert (difference > ANSWER).double().mean() < 1e-3, "more than flips at a cut-off"
    assert difference.max() < 0.02


def test_compiled_passes_by_order_are_the_eager_ones(built):
    scene, camera = sized(make_scene(400)), make_camera(size=(150, 110))
    assert built.ready(order.pass_kernel(POINT))
    names = ["id", "depth-median", "depth-nearest", "samples"]
    fast, eager = (Renderer.of(scene, [camera], rasterizer=Tiled(k)).passes(camera, names) for k in (built, EAGER))
    for name in names:
        assert fast[name].unique().numel() > 10
        assert torch.isclose(fast[name], eager[name], rtol=1e-5).double().mean() > 0.998, "more than flips at a cut-off"


@pytest.mark.parametrize("at_once", [13, 1000])
def test_compiled_gradients_are_the_eager_ones_in_parts_and_at_once(built, at_once, monkeypatch):
    scene, camera = make_scene(100, degree=2), make_camera()
    training = TrainingViews.of(scene, [camera])

    def gradients(kernels: Kernels) -> tuple[torch.Tensor, ...]:
        leaves = {name: column.clone().requires_grad_() for name, column in scene.columns.items()}
        pose = camera.cam_from_world.clone().requires_grad_()
        renderer = Renderer(replace(scene, **leaves), training, RECIPES["classic"], Tiled(kernels))
        image = renderer(replace(camera, cam_from_world=pose)).rgb
        return torch.autograd.grad(image.square().sum(), [*leaves.values(), pose])

    expected = gradients(EAGER)
    monkeypatch.setattr(packages, "MAX_GRADIENT_ROWS", at_once)
    monkeypatch.setattr(shading, "SPLATS_PER_CALL", at_once)
    for fast, slow in zip(gradients(built), expected, strict=True):
        assert slow.abs().max() > 0
        torch.testing.assert_close(fast, slow, rtol=0, atol=1e-4 * float(slow.abs().max()))


def test_gradients_reach_parameters_in_any_layout(built):
    scene, camera = make_scene(100, degree=2), make_camera()
    splats = project(scene, camera)
    for sh, means in ((scene.sh.mT.contiguous().mT, scene.means), (scene.sh, scene.means.T.contiguous().T)):
        leaves = sh.requires_grad_(), means.requires_grad_()
        rgb = shading.shade(splats, replace(scene, sh=sh, means=means), camera, built).rgb
        gradients = torch.autograd.grad(rgb.square().sum(), leaves)
        rgb = shading.shade(splats, replace(scene, sh=sh, means=means), camera).rgb
        torch.testing.assert_close(gradients, torch.autograd.grad(rgb.square().sum(), leaves))


@each_kernel
def test_kernels_name_the_arguments_that_they_update(kernel: Kernel):
    args, untouched = kernel.example(), kernel.example()
    kernel.function(*args)
    changed = [i for i, (now, before) in enumerate(zip(args, untouched, strict=True)) if not torch.equal(now, before)]
    assert changed == [*kernel.updates]


def test_a_kernel_refuses_to_update_a_copy():
    kernel = Kernel("fill", lambda x: (), lambda: (torch.ones(4, 2),), ("n",), updates=(0,))
    with pytest.raises(AssertionError, match="fill would update copies"):
        CompiledKernels(lambda kernel: Package.of(lambda args: [], kernel)).run(kernel, torch.ones(2, 4).T)


def test_a_pickled_rasterizer_loads_the_packages_of_its_machine(built, empty_cache):
    packed = pickle.dumps(Tiled(built))
    assert pickle.loads(packed).name == "eager", "nothing is built in the empty cache"
    assert len(packed) < 1000


def paths(kernels: Sequence[Kernel] = compiled.KERNELS) -> dict[str, str]:
    return {kernel.name: compiled.package_path(kernel).name for kernel in kernels}


PASSES = {"composite-point", "composite-point-kept", "composite-point-backward", "composite-ray", "order-point"}
EVERY = {kernel.name for kernel in compiled.KERNELS}


def other_polynomial(x: torch.Tensor, coefficients: tuple[float, ...]) -> torch.Tensor:
    return x


@pytest.mark.parametrize(
    ("module", "name", "value", "changed"),
    [
        (binning, "CUTOFF_SLACK", 2e-4, {"table", "spans"}),
        (point, "_polynomial", other_polynomial, PASSES),
        (point, "ROOT_OF_EXP2", (1.0, 2.0), PASSES),
        (point.Point, "exact", lambda *_: None, set()),
        (projection, "JACOBIAN_MARGIN", 0.5, set()),  # nothing that is traced names it
        (projection, "MAX_SIGMA", 1e8, {"project", "project-backward"}),
        (shading, "COMPILED_COEFFICIENTS", (4,), set()),
        (forward, "EXAMPLE_TILES", 8, PASSES),
        (compiled, "OPTIONS", {"max_fusion_size": 1}, EVERY),
        (compiled, "_compiler_version", lambda compiler: "g++ 99", EVERY),
        (compiled, "_processor", lambda: "another", EVERY),
        (compiled, "_compiler", lambda: "clang++", EVERY),
    ],
)
def test_what_a_kernel_is_compiled_from_and_by_names_its_package(monkeypatch, module, name, value, changed):
    before = paths()
    assert paths() == before
    monkeypatch.setattr(module, name, value)
    after = paths()
    assert {kernel for kernel in before if before[kernel] != after[kernel]} == changed


def test_a_bundle_serves_every_python_and_every_build_of_its_torch(monkeypatch):
    def bundled() -> dict[str, str]:
        paths = {kernel.name: compiled._path_in(CACHE, kernel, compiled.TARGETS[0]) for kernel in ALL_KERNELS}
        return {name: path.name for name, path in paths.items()}

    def in_another_order(code: CodeType) -> tuple[str, ...]:
        return names_of(code)[::-1]

    before, names_of, [version, *_] = bundled(), sources._names, torch.__version__.split("+")
    monkeypatch.setattr(sources, "_names", in_another_order)
    assert bundled() == before
    monkeypatch.setattr(torch, "__version__", f"{version}+another")
    assert bundled() == before
    monkeypatch.setattr(torch, "__version__", f"{version}.1")
    assert not {*before.values()} & {*bundled().values()}


def test_names_of_packages_and_digests_of_recipes_are_the_same_in_every_process():
    """Also where annotations of arrays are not checked, as in the user's process."""
    program = (
        "import json; from aaplug.methods import RECIPES; from aaplug.rasterizers.tiled.ahead_of_time import *;"
        "kernels = [*kernels_of([*RECIPES.values()]), *TRAINER_KERNELS];"
        "packages = {kernel.name: package_path(kernel).name for kernel in kernels};"
        "print(json.dumps([packages, {name: recipe.digest for name, recipe in RECIPES.items()}]))"
    )
    done = run_python(program, PYTHONHASHSEED=7)
    digests = {name: recipe.digest for name, recipe in RECIPES.items()}
    assert json.loads(done.stdout) == [paths(ALL_KERNELS), digests]


def test_warmup_builds_what_recipes_need(empty_cache, monkeypatch):
    asked = []
    monkeypatch.setattr("aaplug.verbs.warmup.build", lambda tell, recipes: asked.append([r.name for r in recipes]))
    own = [kernel.name for kernel in compiled.KERNELS]
    assert aaplug.warmup().names == aaplug.warmup(["auto", "matched", "classic", "mip"]).names == own
    assert aaplug.warmup("analytic").names == [*own, "composite-integral"]
    both = aaplug.warmup(["2dgs", RECIPES["gaussian-blending"]]).names
    assert both == [*own, "composite-surfel", "gaussian-blending"]
    assert asked == [[], ["auto", "matched", "classic", "mip"], ["analytic"], ["2dgs", "gaussian-blending"]]
    with pytest.raises(UsageError, match="recipe: 'mipp' is not one of"):
        aaplug.warmup("mipp")


SECONDS = {  # to compile, measured; the others take 7 to 15
    "composite-point": 63,
    "composite-point-kept": 63,
    "project-backward": 38,
    "order-point": 20,
    "composite-point-backward": 27,
    **{f"shade-{n}-gradients": t for n, t in ((4, 11), (9, 21), (16, 23))},
}


@pytest.mark.parametrize("processes", [1, 2, 4])
def test_the_time_left_of_a_warmup_is_honest_from_the_first_kernel_on(compiling, monkeypatch, processes):
    taken, told = {kernel.name: SECONDS.get(kernel.name, 10) for kernel in compiled.KERNELS}, [(0.0, 0, 100)]

    def in_turn(pool: object, work: object, packages: Sequence[tuple[str, None]]) -> Iterator[tuple[object, str]]:
        """Each package when it is done, as a pool would yield it."""
        ends, free = [], [0.0] * processes
        for name, _ in packages:
            ends.append((heapq.heappop(free) + taken[name], name))
            heapq.heappush(free, ends[-1][0])
        for now, name in sorted(ends):
            told.append((now, 0, 0))
            yield (name, None), ""

    def tell(done: int, total: int) -> None:
        told[-1] = (told[-1][0], done, total)

    compiling(in_turn)
    monkeypatch.setattr(compiled, "load", lambda: CompiledKernels(lambda kernel: None))
    monkeypatch.setattr(torch, "get_num_threads", lambda: processes)
    compiled.build(tell)
    (*estimated, (end, *last)) = told[1:]
    assert last == [100, 100]
    for now, done, total in estimated:
        assert end / 1.5 < now * total / done < end * 1.5, now


@pytest.mark.parametrize("compiler", [True, False])
def test_without_packages_auto_is_eager_and_says_why(empty_cache, monkeypatch, compiler):
    monkeypatch.setattr(choice, "has_compiler", lambda: compiler)
    monkeypatch.setenv("AAPLUG_KERNELS", "/nowhere")
    assert compiled.load() is None
    said: list[str] = []
    assert find_rasterizer("auto", 1, said.append) is RASTERIZERS["eager"]
    assert len(said) == 1
    assert f"AAPLUG_KERNELS names /nowhere, which has no kernels for torch {torch.__version__}" in said[0]
    assert ("warmup" if compiler else "no C++ compiler") in said[0]


def test_many_frames_build_what_is_missing(empty_cache, monkeypatch):
    kernels = CompiledKernels(lambda kernel: None)
    monkeypatch.setattr(choice, "has_compiler", lambda: True)
    monkeypatch.setattr(choice, "build", lambda **_: kernels)
    for frames, gradients in ((choice.FRAMES_THAT_PAY, False), (choice.STEPS_THAT_PAY, True)):
        chosen = find_rasterizer("auto", frames, gradients=gradients)
        assert isinstance(chosen, Tiled)
        assert chosen.kernels is kernels
        assert find_rasterizer("auto", frames - 1, gradients=gradients) is RASTERIZERS["eager"]


def test_missing_kernels_are_built_beside_the_work_and_taken_up_once(empty_cache, monkeypatch, caplog):
    for name, value in {"PATIENCE_SECONDS": 0.0, "LOOK_SECONDS": 0.0, "has_compiler": lambda: True}.items():
        monkeypatch.setattr(on_demand, name, value)
    program = (
        "import sys; open('asked', 'a').write(' '.join(sys.argv[1:]));"
        "sys.stderr.buffer.write(b'\\x81' * 100_000 + b'\\n'); sys.exit('the disk is full')"  # more than a pipe holds
    )
    monkeypatch.setattr(on_demand, "COMPILER", program)
    monkeypatch.chdir(empty_cache)
    kernels, looked_up = on_demand.OnDemandKernels(), []
    monkeypatch.setattr(kernels, "_package_of", lambda kernel: looked_up.append(kernel.name))
    for _ in range(2):
        project(make_scene(50), make_camera(), kernels)
    assert kernels._compiler is not None
    kernels._compiler.wait(20)
    for _ in range(3):
        project(make_scene(50), make_camera(), kernels)
    assert (empty_cache / "asked").read_text() == "project"
    assert looked_up == ["project", "project"]
    assert caplog.messages[0].startswith("this program is slower")
    assert "the disk is full" in caplog.messages[1]
    assert len(caplog.messages) == 2


@pytest.mark.parametrize(
    ("built", "at_once", "with_gradients"),
    [([], [3], [3]), (["composite-point-4"], [3, 4], [3]), (["-kept", "-backward"], [3], [3, 4])],
)
def test_four_channels_are_composited_together_where_their_kernels_are_built_and_else_asked_for(
    empty_cache, monkeypatch, built, at_once, with_gradients
):
    kernels, package = on_demand.OnDemandKernels(), Package(Mock(), [], [], ())
    monkeypatch.setattr(kernels, "_package_of", lambda of: package if of.name.endswith(tuple(built)) else None)
    monkeypatch.setattr(kernels, "_can_build", True)
    for asked in (kernels, OnlyCompiled(kernels), packages.CountingKernels(kernels, Mock())):
        assert choice.channels_at_once(Tiled(asked), POINT) == at_once
        assert choice.channels_at_once(Tiled(asked), POINT, gradients=True) == with_gradients
        assert choice.channels_at_once(Tiled(asked), RAY) == [3]
    needed = ["composite-point-4", "composite-point-4-kept", "composite-point-4-backward"]
    assert kernels._missing == {name for name in needed if not name.endswith(tuple(built))}
    assert choice.channels_at_once(RASTERIZERS["eager"], POINT, gradients=True) == [3, 4]


def test_without_a_compiler_a_build_is_refused(empty_cache, monkeypatch):
    monkeypatch.setenv("CXX", "g++-99")
    with pytest.raises(UsageError, match=r"warmup: needs a C\+\+ compiler .* g\+\+-99 is not here"):
        compiled.build()
    assert compiled._compiler_version("no-such-compiler") == ""
    assert compiled._compiler_version(sys.executable).startswith("Python 3.")


@pytest.fixture
def failing(monkeypatch):
    """A compiler that cannot compile one of the kernels."""
    monkeypatch.setattr(choice, "has_compiler", lambda: True)
    monkeypatch.setattr(choice, "build", Mock(side_effect=UsageError("warmup", "torch cannot compile slots here")))


def test_after_a_failed_build_auto_is_eager_and_says_why(empty_cache, failing):
    said: list[str] = []
    chosen = find_rasterizer("auto", choice.FRAMES_THAT_PAY, said.append)
    assert chosen is RASTERIZERS["eager"]
    assert "cannot compile slots" in said[-1]
    with pytest.raises(UsageError, match="cannot compile slots"):
        find_rasterizer("compiled", 1, said.append)


def test_kernels_that_do_not_compile_are_named_and_leave_no_other_unbuilt(compiling, monkeypatch):
    temporary = list[Path]()

    def fails(*args, **options):
        temporary.append(Path(tempfile.gettempdir()))  # of torch, which leaves hundreds of MB there
        raise KeyError("buf14")

    monkeypatch.setattr(tempfile, "tempdir", tempfile.tempdir)  # `_build` has a process of its own
    monkeypatch.setattr(compiled.gc, "set_threshold", lambda *_: None)
    compiling(lambda pool, work, packages: map(work, packages))
    monkeypatch.setattr(torch._inductor, "aoti_compile_and_package", fails)
    with pytest.raises(UsageError, match=r"warmup: torch .* cannot compile slots, spans here: 'buf14'"):
        compiled.build(names={"slots", "spans"})
    assert all(folder.name.startswith(SCRATCH_PREFIX) and not folder.exists() for folder in temporary)
    assert len(temporary) == 2


@pytest.mark.parametrize("asked", [("auto", choice.STEPS_THAT_PAY), ("compiled", 1)])
def test_kernels_of_images_are_used_where_those_of_gradients_do_not_compile(failing, monkeypatch, asked):
    kernels, said = CompiledKernels(lambda kernel: None), list[str]()
    monkeypatch.setattr(choice, "load", lambda: kernels)
    monkeypatch.setattr(choice, "is_built", lambda _: False)
    chosen = find_rasterizer(*asked, said.append, gradients=True)
    assert isinstance(chosen, Tiled)
    assert chosen.kernels is kernels
    assert "torch cannot compile slots here" in said[1]


@pytest.mark.parametrize("reads_bits", [True, False])
def test_signs_choose_as_comparisons_do(monkeypatch, reads_bits):
    monkeypatch.setattr("aaplug.core.kernels.READS_BITS", reads_bits)
    signs = torch.tensor([-torch.inf, -2.5, -1e-38, 0.0, 1e-38, 3.0, torch.inf])
    values = torch.tensor([1.0, -2.0, torch.inf, 4.0, torch.nan, 0.0, -7.0])
    for negative, chosen in ((True, signs < 0), (False, signs >= 0)):
        result = where_signed(signs, values, negative=negative)
        assert torch.equal(result[chosen].nan_to_num(5.0), values[chosen].nan_to_num(5.0))
        assert (result[~chosen] == 0).all()


def test_one_row_and_another_precision_are_left_to_the_eager_function():
    double = Kernel("double", lambda x: (2 * x,), lambda: (torch.ones(4),), ("n",))
    ran = CompiledKernels(lambda kernel: Package.of(lambda args: [3 * args[0]], kernel))
    assert ran.run(double, torch.ones(1))[0].item() == 2
    assert ran.run(double, torch.ones(2))[0].tolist() == [3, 3]
    assert ran.run(double, torch.ones(2).double())[0].tolist() == [2, 2]
    assert EAGER.run(double, torch.ones(2))[0].tolist() == [2, 2]
