"""Kernels compiled ahead of time: built once, kept in the user's cache folder, loaded in milliseconds.

Each kernel becomes one package of `torch._inductor`.  The folder's name is made of the versions of torch and of the
kernels' source and of the processor's instruction set, so that a stale package is never found; a package that does
not load, or whose answer differs from the eager one, is built anew.
"""

import hashlib
import inspect
import multiprocessing
import os
import shutil
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from pathlib import Path

import platformdirs
import torch

from aaplug import kernels as kernels_module
from aaplug import projection, splats
from aaplug.errors import UsageError, listing
from aaplug.interfaces import Rasterizer
from aaplug.kernels import CompiledKernels, Kernel, Package, one_thread
from aaplug.rasterizers import RASTERIZERS, Tiled, binning, compositing, drawing, pixels, rules

KERNELS: tuple[Kernel, ...] = (  # those that take longest to compile are the last
    projection.PROJECT,
    *projection.SHADE.values(),
    splats.INSIDE,
    drawing.DRAWING,
    binning.TABLE,
    binning.SPANS,
    binning.PAIRS,
    compositing.OWNERS,
    compositing.FROM_SUMS,
    *projection.SHADE_BACKWARD.values(),
    compositing.CHUNK_BACKWARD["point"],
    projection.PROJECT_BACKWARD,
    compositing.PASSES["integral"].kernel,
    compositing.PASSES["point"].kernel,
)
OPTIONS = {
    "max_fusion_size": 1_000_000,  # a pass is one loop, however many operations it has
    "cpp.max_horizontal_fusion_size": 1_000_000,  # and however many sums
    "realize_reads_threshold": 30,  # what such a loop reads is found in it, however much that reads itself
    "assert_indirect_indexing": False,  # indices are our own, and a check a load is slow
    "cpp.enable_floating_point_contract_flag": "fast",  # multiply and add in one instruction
}
DOUBTS = (
    "cpp.enable_tiling_heuristics"  # whether the compiler leaves loops over distant numbers scalar
)
LARGEST_SIZE = 1 << 31
MOST_PROCESSES = 4  # compilers side by side: each takes most of a GB
FRAMES_THAT_PAY = 500  # a frame of 800² saves about 0.3 s, and compiling takes about 150 s
TOLERANCE = (
    1e-4  # of the largest value: between a package's answer and the eager one, on the example
)


def cache_folder() -> Path:
    """Where the packages of this version on this processor are."""
    modules = (kernels_module, projection, splats, rules, pixels, binning, drawing, compositing)
    source = "".join(inspect.getsource(module) for module in modules)
    options = f"{OPTIONS} {DOUBTS}"
    facts = [torch.__version__, torch.backends.cpu.get_cpu_capability(), source, options]
    key = hashlib.sha256("\0".join(facts).encode()).hexdigest()[:16]
    return Path(platformdirs.user_cache_dir("aaplug", appauthor=False)) / f"kernels-{key}"


def has_compiler() -> bool:
    """Whether this machine can build packages, with the compiler that torch would take."""
    standard = "clang++" if sys.platform == "darwin" else "g++"
    return shutil.which(os.environ.get("CXX", standard)) is not None


def load() -> CompiledKernels | None:
    """The compiled kernels, if all of them are built and those for images are sound.

    Those for gradients are loaded when they are first needed, and left to the eager functions if they are broken.
    """
    if not all(_path(kernel).is_file() for kernel in KERNELS):
        return None
    packages = {}
    for kernel in KERNELS:
        if not kernel.pulls_back:
            package = _load(kernel)
            if package is None:
                return None
            packages[kernel.name] = package
    pulling = {kernel.name: kernel for kernel in KERNELS if kernel.pulls_back}
    return CompiledKernels(packages, lambda name: _load(pulling[name]) if name in pulling else None)


def build(
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> CompiledKernels:
    """Build what is missing, stale or broken, in a process for each thread that torch has, and load all.

    progress: told (kernels done, kernels in all).

    Raises:
        UsageError: there is no compiler or it fails, the cache folder cannot be written, or a process died.
    """
    total = len(KERNELS)
    missing = [kernel.name for kernel in KERNELS if _load(kernel) is None]
    progress(total - len(missing), total)
    if missing:
        if not has_compiler():
            raise UsageError(
                "warmup", "needs a C++ compiler (g++ or clang++) for torch to compile with"
            )
        processes = min(torch.get_num_threads(), MOST_PROCESSES, len(missing))
        pool = ProcessPoolExecutor(processes, multiprocessing.get_context("spawn"))
        try:
            # backwards, so that the longest do not come when the others are done
            built = as_completed([pool.submit(_build, name) for name in missing[::-1]])
            for done, future in enumerate(built, start=total - len(missing) + 1):
                future.result()
                progress(done, total)
        except BrokenProcessPool as error:
            raise UsageError("warmup", "a process died, which too little memory does") from error
        finally:
            pool.shutdown(cancel_futures=True)
    loaded = load()
    if loaded is None:
        raise UsageError("warmup", f"the packages in {cache_folder()} do not load")
    return loaded


def choose(name: str, frames: int, say: Callable[[str], None]) -> Rasterizer:
    """The rasterizer that a user asked for by name, or for "auto" the one that pays.

    Compiled kernels are used where they are built, and built where `frames` are enough to repay it.

    Raises:
        UsageError: the name is not known, or "compiled" was asked for and cannot be built.
    """
    if name in RASTERIZERS:
        return RASTERIZERS[name]
    if name not in ("auto", "compiled"):
        names = listing(["auto", "compiled", *RASTERIZERS])
        raise UsageError("--rasterizer", f"'{name}' is not one of {names}")
    kernels = load()
    if kernels is None and (name == "compiled" or (frames >= FRAMES_THAT_PAY and has_compiler())):
        say("rasterizer: compiling the kernels, once for this machine (about two minutes)")
        try:
            kernels = build()
        except UsageError as error:
            if name == "compiled":
                raise
            say(f"rasterizer: eager ({error})")
            return RASTERIZERS["eager"]
    if kernels is not None:
        say("rasterizer: compiled")
        return Tiled(kernels)
    why = "`aaplug warmup` compiles it, for several times the speed"
    say(f"rasterizer: eager ({why if has_compiler() else 'no C++ compiler found to compile it'})")
    return RASTERIZERS["eager"]


def _path(kernel: Kernel) -> Path:
    return cache_folder() / f"{kernel.name}.pt2"


def _load(kernel: Kernel) -> Package | None:
    """A package that gives the eager answer, or nothing."""
    path = _path(kernel)
    if not path.is_file():
        return None
    try:
        # what `aoti_load_package` wraps; the import that it needs takes two seconds, and its calls four times as long
        loader = torch._C._aoti.AOTIModelPackageLoader  # pyright: ignore[reportAttributeAccessIssue]
        package = loader(str(path), "model", True, 1, -1).run
        with torch.no_grad(), one_thread():  # several would wait for each other
            args, twins = kernel.example(), kernel.example()
            found = [*package(list(args)), *args]  # what comes back, and what was updated in place
            expected = [*kernel.function(*twins), *twins]
            close = all(_close(a, b) for a, b in zip(found, expected, strict=True))
        return Package.of(package, args) if close else None
    except Exception:  # a broken package can fail in any way; it is built anew
        return None


def _close(found: torch.Tensor, expected: torch.Tensor) -> bool:
    found, expected = found.double(), expected.double()
    return bool((found - expected).abs().max() <= TOLERANCE * (1 + expected.abs().max()))


def _build(name: str) -> None:
    """Build one of the kernels, by its name, which other processes know too."""
    kernel = next(kernel for kernel in KERNELS if kernel.name == name)
    path = _path(kernel)
    sizes = {
        name: torch.export.Dim(f"size_{name}", min=2, max=LARGEST_SIZE)
        for name in kernel.sizes
        if name is not None
    }
    shapes = tuple({0: sizes[name]} if name is not None else None for name in kernel.sizes)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        from torch.fx.experimental.proxy_tensor import make_fx  # takes a second

        with tempfile.TemporaryDirectory(dir=path.parent) as folder, _quiet(), torch.no_grad():
            args = kernel.example()
            module = (
                make_fx(kernel.function, tracing_mode="symbolic")(*args)
                if kernel.pulls_back
                else _Module(kernel)
            )
            program = torch.export.export(
                module, args, dynamic_shapes=shapes if kernel.pulls_back else (shapes,)
            )
            made = torch._inductor.aoti_compile_and_package(
                program,
                package_path=str(Path(folder) / "k.pt2"),
                inductor_configs={**OPTIONS, DOUBTS: not kernel.gathers},
            )
            os.replace(made, path)
    except OSError as error:
        raise UsageError("warmup", f"cannot write {path.parent}: {error}") from error
    except Exception as error:  # compilers fail in ways of their own
        problem = f"torch {torch.__version__} cannot compile '{kernel.name}' here: {error}"
        raise UsageError("warmup", problem) from error


class _Module(torch.nn.Module):
    """A kernel as torch.export takes it."""

    def __init__(self, kernel: Kernel):
        super().__init__()
        self._function = kernel.function

    def forward(self, *args: torch.Tensor) -> tuple[torch.Tensor, ...]:
        return self._function(*args)


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep torch's own deprecation notices from the user."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield
