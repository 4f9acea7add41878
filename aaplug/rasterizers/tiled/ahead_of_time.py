"""Kernels compiled ahead of time: built once, kept in the user's cache folder, loaded in milliseconds.

Each kernel becomes one package of `torch._inductor`.  The folder's name is a hash of torch's version, the kernels'
source and the processor's instruction set, so a stale package is never found.  A package that does not load, or whose
result differs from the eager one, is built again.  A package that passed is remembered by its hash and is not compared
again.
"""

import hashlib
import inspect
import os
import platform
import shutil
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import platformdirs
import torch

from aaplug.core import culling, ellipses, kernels, projection, rules, shading, spherical_harmonics, splats
from aaplug.core.errors import UsageError
from aaplug.core.executors import Processes, torch_threads
from aaplug.core.kernels import EAGER, ONE_MORE, Kernel, Kernels
from aaplug.core.locks import scratch
from aaplug.core.monitor import Tell
from aaplug.core.rules import RULES_3DGS
from aaplug.methods.compositors import gaussian_blending
from aaplug.methods.pixel_kernels import INTEGRAL, POINT, averages, integral, point, raster_rows
from aaplug.rasterizers.tiled import backward, binning, forward, layout
from aaplug.rasterizers.tiled.packages import CompiledKernels, Package

KERNELS: tuple[Kernel, ...] = (  # those that take longest to compile come last
    projection.project_kernel(),
    *map(shading.shade_kernel, shading.COMPILED),
    splats.SELECT,
    culling.cull_kernel(),
    point.POINT_ROWS,
    binning.table_kernel(),
    binning.SPANS,
    binning.PAIRS,
    binning.LISTS,
    layout.LINES,
    backward.SLOTS,
    point.FROM_SUMS,
    point.POINT_ROWS_BACKWARD,
    *map(shading.gradients_kernel, shading.COMPILED),
    backward.step_kernel(POINT, RULES_3DGS),
    projection.PROJECT_BACKWARD,
    gaussian_blending.pass_kernel(),
    forward.pass_kernel(INTEGRAL, RULES_3DGS),
    forward.pass_kernel(POINT, RULES_3DGS),
)
SOURCES = (  # modules whose source the kernels are made of
    *(kernels, rules, splats, ellipses, culling, projection, shading, spherical_harmonics),
    *(raster_rows, averages, point, integral, gaussian_blending, binning, forward, backward, layout),
)
OPTIONS = {
    "max_fusion_size": 1_000_000,  # a pass stays one loop, however many operations it has
    "cpp.max_horizontal_fusion_size": 1_000_000,  # and however many sums it has
    "realize_reads_threshold": 30,  # inputs are recomputed inside the loop, however much they read
    "assert_indirect_indexing": False,  # indices are our own, and checking each load is slow
    "cpp.enable_floating_point_contract_flag": "fast",  # multiply and add in one instruction
}
# inductor leaves loops that gather scattered numbers scalar
TILING_HEURISTIC = "cpp.enable_tiling_heuristics"
# operations up to which inductor writes a value out again for each of its readers, where kernels are chained
CHAINED = {"realize_opcount_threshold": 10}
OVERLAPS = {  # of `Kernel`; as the architecture, the only setting whose text reaches g++
    "freely": "native -fschedule-insns",
    "within registers": "native -fschedule-insns -fsched-pressure",
}
LARGEST_SIZE = 1 << 31
STANDARD_COMPILER = "clang++" if sys.platform == "darwin" else "g++"
MOST_PROCESSES = 4  # compilers side by side: each takes most of a GB
# of the largest value: between a package's result and the eager one, on the example
TOLERANCE = 1e-4


def cache_folder() -> Path:
    """Folder of the packages for this version and this processor."""
    source = "".join(inspect.getsource(module) for module in SOURCES)
    options = f"{OPTIONS} {TILING_HEURISTIC} {CHAINED} {OVERLAPS} {_compiler()}"
    facts = [torch.__version__, torch.backends.cpu.get_cpu_capability(), source, options]
    key = hashlib.sha256("\0".join(facts).encode()).hexdigest()[:16]
    return Path(platformdirs.user_cache_dir("aaplug", appauthor=False)) / f"kernels-{key}"


def has_compiler() -> bool:
    """Whether this machine has the compiler that torch would use."""
    return shutil.which(_compiler()) is not None


def _compiler() -> str:
    return os.environ.get("CXX", STANDARD_COMPILER)


def load() -> CompiledKernels | None:
    """The compiled kernels, if all are built and those for images are sound.

    Each loads when it is first needed; a broken one for gradients is replaced by its eager function.
    """
    known = {kernel.name: kernel for kernel in KERNELS}
    if not all(_path(kernel).is_file() for kernel in KERNELS):
        return None
    if not all(_is_sound(kernel) for kernel in KERNELS if not kernel.pulls_back):
        return None
    return CompiledKernels({}, lambda name: _load(known[name]) if name in known else None, load_or_eager)


def load_or_eager() -> Kernels:
    """The compiled kernels of this machine, or eager ones where they are not built."""
    return load() or EAGER


def build(progress: Tell = lambda done, total: None) -> CompiledKernels:
    """Build what is missing or broken, in one process per thread of torch, and load everything.

    Raises:
        UsageError: there is no compiler or it fails, the cache folder cannot be written, or a process died.
    """
    total = len(KERNELS)
    missing = [kernel.name for kernel in KERNELS if not _is_sound(kernel)]
    progress(total - len(missing), total)
    if missing:
        if not has_compiler():
            raise UsageError("warmup", "needs a C++ compiler (g++ or clang++) for torch to compile with")
        processes = min(torch.get_num_threads(), MOST_PROCESSES, len(missing))
        # longest first, so that none is left over at the end; torch's default threads, for which kernels are compiled
        pool = Processes(processes, torch_threads=None, ordered=False)
        built = pool.map(_build, missing[::-1])
        for done, _ in enumerate(built, start=total - len(missing) + 1):
            progress(done, total)
    loaded = load()
    if loaded is None:
        raise UsageError("warmup", f"the packages in {cache_folder()} do not load")
    return loaded


def _path(kernel: Kernel) -> Path:
    return cache_folder() / f"{kernel.name}.pt2"


def _mark(kernel: Kernel) -> Path:
    """Holds the hash of the package that passed."""
    return _path(kernel).with_suffix(".sound")


def _is_sound(kernel: Kernel) -> bool:
    """Whether the package gives the eager result; found out once."""
    mark = _mark(kernel)
    try:
        digest = hashlib.sha256(_path(kernel).read_bytes()).hexdigest()
        if mark.is_file() and mark.read_text() == digest:
            return True
        sound = _passes(kernel)
        if sound:
            with scratch(str(mark.parent)) as folder:
                (folder / mark.name).write_text(digest)
                os.replace(folder / mark.name, mark)
        return sound
    except FileNotFoundError:
        return False
    except OSError:  # the cache cannot be written: it is found out again
        return _passes(kernel)


def _load(kernel: Kernel) -> Package | None:
    """The package, if its result equals the eager one; else None."""
    return Package.of(_opened(kernel), kernel) if _is_sound(kernel) else None


def _opened(kernel: Kernel) -> Callable[[list[torch.Tensor]], list[torch.Tensor]]:
    # the loader inside `aoti_load_package`, whose import takes two seconds and whose calls take four times as long
    loader = torch._C._aoti.AOTIModelPackageLoader  # pyright: ignore[reportAttributeAccessIssue]
    return loader(str(_path(kernel)), "model", True, 1, -1).run


def _passes(kernel: Kernel) -> bool:
    """Whether the package's result on the example equals the eager one."""
    try:
        package = _opened(kernel)
        with torch.no_grad(), torch_threads(1):  # several threads would wait for each other
            args, twins = kernel.example(), kernel.example()
            found = [*package(list(args)), *args]  # results, and arguments updated in place
            expected = [*kernel.function(*twins), *twins]
            return all(_close(a, b) for a, b in zip(found, expected, strict=True))
    except Exception:  # a broken package can fail in any way; it is built again
        return False


def _close(found: torch.Tensor, expected: torch.Tensor) -> bool:
    found, expected = found.double(), expected.double()
    return bool((found - expected).abs().max() <= TOLERANCE * (1 + expected.abs().max()))


def _build(name: str) -> None:
    """Build one kernel, by its name, so that it can run in another process."""
    kernel = next(kernel for kernel in KERNELS if kernel.name == name)
    path = _path(kernel)
    names = {name.removesuffix(ONE_MORE) for name in kernel.sizes if name is not None}
    sizes = {name: torch.export.Dim(f"size_{name}", min=2, max=LARGEST_SIZE) for name in names}
    sizes |= {name + ONE_MORE: size + 1 for name, size in sizes.items()}
    shapes = tuple({0: sizes[name]} if name is not None else None for name in kernel.sizes)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        from torch.fx.experimental.proxy_tensor import make_fx  # takes a second

        with scratch(str(path.parent)) as folder, warnings.catch_warnings(action="ignore"), torch.no_grad():
            args = kernel.example()
            module = make_fx(kernel.function, tracing_mode="symbolic")(*args) if kernel.pulls_back else _Module(kernel)
            program = torch.export.export(module, args, dynamic_shapes=shapes if kernel.pulls_back else (shapes,))
            made = torch._inductor.aoti_compile_and_package(
                program, package_path=str(folder / "k.pt2"), inductor_configs=_configs(kernel)
            )
            os.replace(made, path)
    except OSError as error:
        raise UsageError("warmup", f"cannot write {path.parent}: {error}") from error
    except Exception as error:  # a compiler can fail in any way
        problem = f"torch {torch.__version__} cannot compile '{kernel.name}' here: {error}"
        raise UsageError("warmup", problem) from error


def _configs(kernel: Kernel) -> dict[str, Any]:
    """Inductor's settings."""
    from torch._inductor.config import cpp  # takes long

    configs = OPTIONS | {TILING_HEURISTIC: not kernel.gathers} | (CHAINED if kernel.chained else {})
    x86_linux = (sys.platform, platform.machine()) == ("linux", "x86_64")
    free = getattr(cpp, "march", "missing") is None  # known to this torch, and not set by the user
    if kernel.overlaps and x86_linux and free and Path(_compiler()).name == STANDARD_COMPILER:
        configs |= {"cpp.march": OVERLAPS[kernel.overlaps]}
    return configs


class _Module(torch.nn.Module):
    """A kernel as torch.export takes it."""

    def __init__(self, kernel: Kernel):
        super().__init__()
        self._function = kernel.function

    def forward(self, *args: torch.Tensor) -> tuple[torch.Tensor, ...]:
        return self._function(*args)
