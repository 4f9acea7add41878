"""Kernels compiled ahead of time: built once, kept in the user's cache folder, loaded in milliseconds.

Each kernel becomes one package of `torch._inductor`.  Its file's name holds a hash of all that it was compiled from and
by: the kernel's own sources (`tiled.sources`), torch, its options, the compiler and the processor.  So a stale package
is never loaded, and a change of one kernel rebuilds that one.

Beside the package lies the library that was unpacked from it, once for all processes, and a mark: the hash of that
library if its results equalled the eager ones.  A library with another hash is unpacked and compared again.  A kernel
that cannot be used is left aside with a warning: images, or their gradients, are then computed eagerly.  So is one that
ended the first process that loaded it, which is most often the one that compiled it.

A bundle is a folder of packages for an instruction set instead of one processor.  `AAPLUG_KERNELS` names it on machines
that have no compiler.
"""

import gc
import hashlib
import logging
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import warnings
import zipfile
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache, partial
from os.path import isfile  # false, where `Path.is_file` raises, in a folder that this user may not look into
from pathlib import Path
from typing import Any

import platformdirs
import torch

from aaplug.core import ellipses, projection, shading
from aaplug.core.interfaces import RunsOwnKernels
from aaplug.core.kernels import EAGER, ONE_MORE, Kernel, Kernels
from aaplug.methods.pixel_kernels.absolute import ABSOLUTE_POINT
from aaplug.methods.pixel_kernels.gradients import SumsGradients
from aaplug.methods.pixel_kernels.point import FROM_SUMS, POINT, POINT_ROWS, POINT_ROWS_BACKWARD
from aaplug.methods.pixel_kernels.ray import RAY
from aaplug.methods.recipe import Recipe
from aaplug.rasterizers.tiled import backward, binning, forward, layout, order
from aaplug.rasterizers.tiled.packages import CompiledKernels, Package
from aaplug.rasterizers.tiled.sources import sources_of
from aaplug.system.digests import digest_of_files
from aaplug.system.errors import UsageError, reason
from aaplug.system.executors import Processes, given_threads, torch_threads
from aaplug.system.locks import lock, scratch
from aaplug.system.monitor import Tell

IMAGE_KERNELS: tuple[Kernel, ...] = (  # of every recipe with the pixel kernel `POINT`
    projection.PROJECT,
    *map(shading.shade_kernel, shading.COMPILED_COEFFICIENTS),
    ellipses.CULL,
    binning.TABLE,
    binning.SPANS,
    binning.PAIRS,
    layout.lines_kernel(),
    POINT_ROWS,
    forward.pass_kernel(POINT),
)
KERNELS: tuple[Kernel, ...] = (  # with those of lenses, of passes such as ids, and of gradients
    *IMAGE_KERNELS,
    forward.pass_kernel(RAY),
    order.pass_kernel(POINT),
    backward.SLOTS,
    POINT_ROWS_BACKWARD,
    FROM_SUMS,
    *map(shading.gradients_kernel, shading.COMPILED_COEFFICIENTS),
    projection.PROJECT_BACKWARD,
    forward.pass_kernel(POINT, keeps=True),
    backward.step_kernel(POINT),
)
# What a trainer asks of `aaplug.gsplat` beside these: absolute gradients, and depth as a fourth channel.
TRAINER_KERNELS: tuple[Kernel, ...] = (
    layout.lines_kernel(5),
    forward.pass_kernel(POINT, 4),
    forward.pass_kernel(POINT, 4, keeps=True),
    backward.step_kernel(POINT, 4),
    forward.pass_kernel(ABSOLUTE_POINT, keeps=True),
    backward.step_kernel(ABSOLUTE_POINT),
    forward.pass_kernel(ABSOLUTE_POINT, 4, keeps=True),
    backward.step_kernel(ABSOLUTE_POINT, 4),
)
DRAWN = [(pixel, channels) for pixel in (POINT, ABSOLUTE_POINT) for channels in (3, 4)]
SLOW = {  # to compile: how many times as long as most, which take about 10 s of a processor
    **{forward.pass_kernel(*drawn, keeps).name: 6 for drawn in DRAWN for keeps in (False, True)},
    projection.PROJECT_BACKWARD.name: 4,
    order.pass_kernel(POINT).name: 2,
    **{backward.step_kernel(*drawn).name: 3 for drawn in DRAWN},
    **{shading.gradients_kernel(n).name: 2 for n in shading.COMPILED_COEFFICIENTS[1:]},
}
OPTIONS = {
    "max_fusion_size": 1_000_000,  # a pass stays one loop, however many operations it has
    "cpp.max_horizontal_fusion_size": 1_000_000,  # and however many sums it has
    "realize_reads_threshold": 30,  # inputs are recomputed inside the loop, however much they read
    "assert_indirect_indexing": False,  # indices are our own, and checking each load is slow
    "cpp.enable_floating_point_contract_flag": "fast",  # multiply and add in one instruction
    "cpp.dynamic_threads": True,  # as many as torch has when a kernel runs, not when it was compiled
}
# By this setting inductor leaves loops that gather scattered numbers scalar.
TILING_HEURISTIC = "cpp.enable_tiling_heuristics"
# Operations up to which inductor writes a value out again for each of its readers, where kernels are chained.
CHAINED_OPTIONS = {"realize_opcount_threshold": 10}
# What only profilers read, where torch knows these settings: three quarters of a package, a tenth of compiling.
FOR_PROFILERS = ("aot_inductor.enable_frame_pointer", "aot_inductor.enable_line_tables")
# How g++ optimizes what calls a kernel, where torch knows this setting. Calls take as long as with torch's "O1", and
# half as long as with "O0"; compiling takes 9 % less than with "O1".
CALLER_LEVEL = {"aot_inductor.compile_wrapper_opt_level": "Og"}
# Inductor tries out which of the processor's instruction sets compile and load, for 8 s of a processor.  g++ knows its
# own processor, and results are compared.  What a g++ can be too old for, such as AMX, is still tried out, by itself.
TRIED_OUT = "cpp.vec_isa_ok"
# torch's headers are precompiled for each set of g++'s options: 10 s of a processor, and 3 s less for each kernel.
# By their digest, which a program of this name computes.
PRECOMPILES, DIGESTS = "aot_inductor.precompile_headers", "openssl"
THIS_PROCESSOR = "native"  # as g++ calls its architecture
# g++ orders instructions before it allocates registers, so that values overlap; with the second option it counts these.
# They follow the architecture, the only setting whose text reaches g++.
SCHEDULING = ("-fschedule-insns", "-fschedule-insns -fsched-pressure")
MANY_REGISTERS = "AVX512"  # 32 of vectors; without it there are 16, and g++ has to count them wherever it schedules
# For Intel's processors g++ copies vectors of 512 bits by halves. A load of the whole then waits until both have left
# the processor's store buffer: up to 10 % of a step with gradients.
WHOLE_VECTORS = "-mprefer-vector-width=512"
# clang 14 takes inductor's last word on mathematics for an order to keep floating-point traps, unless another word
# follows. It then neither joins a product and a sum nor moves them: passes take 1.8 times as long.
CONTRACTING = "-fno-trapping-math"
# Inductor's constants come as assembly that does not say whether the stack holds code. Many linkers then ask for an
# executable stack, which glibc 2.41 refuses to make.
PLAIN_STACK = "-Wa,--noexecstack"
# A library's symbols, of inline functions and for debuggers, which nobody reads: half of it.
FEW_SYMBOLS = "-fvisibility-inlines-hidden -s"
GNU, CLANG = "Free Software Foundation", "clang version"  # in a compiler's words about itself, whatever its file's name
BUNDLE_VARIABLE = "AAPLUG_KERNELS"  # of the environment: the folder of a bundle
MAX_SIZE = 1 << 31
TRIED = "tried "  # before a library's hash in its mark: a process is loading it for the first time, or died of that
DEADLY = "a process that loaded it died"
LIBRARY_SUFFIXES = (".so", ".pyd", ".dll", ".dylib")  # of the library in a package, by system
STANDARD_COMPILER = "clang++" if sys.platform == "darwin" else "g++"
MAX_PROCESSES = 4  # compilers side by side: each takes most of a GB
GARBAGE = (100_000, 50, 100)  # objects, and then collections, before one of garbage: torch's graphs have little of it
# Share of the largest value by which a package's result may differ from the eager one, on the example.
RESULT_TOLERANCE = 1e-4

log = logging.getLogger("aaplug")
Run = Callable[[list[torch.Tensor]], list[torch.Tensor]]


@dataclass(frozen=True)
class Target:
    """What packages are compiled for: all processors of an instruction set.

    name: as compilers know it.  capability: as torch does.  bits: in a vector.
    """

    name: str
    capability: str
    bits: int


TARGETS = (Target("x86-64-v4", "AVX512", 512), Target("x86-64-v3", "AVX2", 256))


def kernels_of(recipes: Sequence[Recipe], gradients: bool = True) -> list[Kernel]:
    """`KERNELS`, or only `IMAGE_KERNELS`, and those that drawing by these recipes needs, each once.

    A recipe needs the passes of its pixel kernel or compositor, and the kernels that either runs by itself.  A gradient
    that autograd makes, where a pixel kernel does not sum its own, is never compiled.
    """
    kernels = [*(KERNELS if gradients else IMAGE_KERNELS)]
    for recipe in recipes:
        drawn_by = recipe.compositor or recipe.pixel
        if isinstance(drawn_by, RunsOwnKernels):
            kernels += drawn_by.kernels()
        if recipe.compositor is None:
            if gradients and isinstance(recipe.pixel, SumsGradients):
                kernels += [backward.step_kernel(recipe.pixel), forward.pass_kernel(recipe.pixel, keeps=True)]
            kernels.append(forward.pass_kernel(recipe.pixel))
    return list({kernel.name: kernel for kernel in kernels}.values())


def cache_folder() -> Path:
    """The folder of all packages; raises UsageError if this user has no home."""
    try:
        return Path(platformdirs.user_cache_dir("aaplug", appauthor=False)).expanduser() / "kernels"
    except RuntimeError as error:
        problem = "names no folder to keep kernels in; set it, or XDG_CACHE_HOME"
        raise UsageError("HOME", problem) from error


def package_path(kernel: Kernel) -> Path:
    """The file of a kernel's package: the one compiled on this machine, or where there is none a bundle's."""
    path, bundle = _path_in(cache_folder(), kernel), os.environ.get(BUNDLE_VARIABLE)
    if bundle and not isfile(path):
        packages = (_path_in(Path(bundle), kernel, target) for target in targets())
        return next(filter(isfile, packages), path)
    return path


def targets() -> tuple[Target, ...]:
    """The instruction sets of this machine that bundles are made for, the best first."""
    names = [target.capability for target in TARGETS]
    best = torch.backends.cpu.get_cpu_capability()
    return TARGETS[names.index(best) :] if sys.platform == "linux" and best in names else ()


def _path_in(folder: Path, kernel: Kernel, target: Target | None = None) -> Path:
    """The file of a kernel's package for its present sources and this torch, in a folder.

    target: None for this processor and compiler.  With one, torch's builds for CPUs and for CUDA share the package.
    """
    options = (OPTIONS, TILING_HEURISTIC, CHAINED_OPTIONS, FOR_PROFILERS, CALLER_LEVEL)
    options += (SCHEDULING, MANY_REGISTERS, WHOLE_VECTORS, CONTRACTING, PLAIN_STACK, FEW_SYMBOLS)  # of compilers
    machine = (_compiler(), _compiler_version(_compiler()), _processor()) if target is None else (target.name,)
    version = torch.__version__ if target is None else torch.__version__.partition("+")[0]
    facts = (version, options, *machine, sources_of(kernel))
    key = hashlib.sha256("\0".join(map(str, facts)).encode()).hexdigest()[:16]
    return folder / f"{kernel.name}-{key}.pt2"


def is_built(kernel: Kernel) -> bool:
    """True if a package of this kernel, sound or not, is in the cache."""
    with suppress(UsageError):  # there is no cache
        return isfile(package_path(kernel))
    return False


def has_compiler() -> bool:
    """True if this machine has the compiler that torch would use."""
    return shutil.which(_compiler()) is not None


def _compiler() -> str:
    return os.environ.get("CXX", STANDARD_COMPILER)


@cache
def _compiler_version(compiler: str) -> str:
    """The compiler's words about its version; empty if it does not run."""
    with suppress(OSError, subprocess.SubprocessError):
        how = {"capture_output": True, "text": True, "errors": "replace", "timeout": 60}
        return subprocess.run([compiler, "--version"], **how).stdout
    return ""


@cache
def _processor() -> str:
    """Its name, what torch takes it for, and its flags where the system tells them."""
    flags = ""
    with suppress(OSError), open("/proc/cpuinfo", encoding="utf-8", errors="replace") as lines:
        flags = next((line for line in lines if line.lower().startswith(("flags", "features"))), "")
    return " ".join([platform.processor(), torch.backends.cpu.get_cpu_capability(), *sorted(flags.split())])


def load() -> CompiledKernels | None:
    """The compiled kernels, if all of `IMAGE_KERNELS` are built and sound.

    Others are used where they are built.  Each loads when it is first needed; a broken one is replaced by its eager
    function.
    """
    packages = {}
    for kernel in IMAGE_KERNELS:
        packages[kernel.name] = package_of(kernel)
        if packages[kernel.name] is None:
            return None
    return CompiledKernels(lambda kernel: packages.get(kernel.name) or package_of(kernel), KERNELS, load_or_eager)


def load_or_eager() -> Kernels:
    """The compiled kernels of this machine, or eager ones where they are not built."""
    return load() or EAGER


def build(
    progress: Tell = lambda done, total: None,
    recipes: Sequence[Recipe] = (),
    gradients: bool = True,
    names: Collection[str] | None = None,
) -> CompiledKernels:
    """Build what is missing or broken, and load everything.

    progress: told the percentage of the time for all that has been spent.
    recipes, gradients: see `kernels_of`.  names: of the kernels to build, instead.

    Raises UsageError if there is no compiler or it fails, the cache folder cannot be written, or a process died.
    """
    kernels = kernels_of(recipes, gradients)
    if names is not None:
        kernels = [kernel for kernel in (*kernels, *TRAINER_KERNELS) if kernel.name in names]
    _build_all([(kernel, None) for kernel in kernels], cache_folder(), progress, recipes)
    loaded = load()
    if loaded is None and names is None:
        raise UsageError("warmup", f"the packages in {cache_folder()} do not load")
    return loaded or CompiledKernels(package_of, KERNELS, load_or_eager)


def build_bundle(
    folder: Path, progress: Tell = lambda done, total: None, recipes: Sequence[Recipe] = ()
) -> list[tuple[Kernel, Target]]:
    """Build what is missing of a bundle: all kernels, trainers' too, for each of `targets`.

    Raises UsageError as `build`; also, this machine has none of the instruction sets.
    """
    if not targets():
        names = " or ".join(target.name for target in TARGETS)
        raise UsageError("bundle", f"needs Linux and a processor of {names} to compile for them")
    wanted = [(kernel, target) for target in targets() for kernel in (*kernels_of(recipes), *TRAINER_KERNELS)]
    _build_all(wanted, folder, progress, recipes)
    return wanted


def _build_all(
    wanted: Sequence[tuple[Kernel, Target | None]], folder: Path, progress: Tell, recipes: Sequence[Recipe]
) -> None:
    """Build what is missing or broken of these packages, in one process per thread of torch.

    A kernel that torch cannot compile leaves no other unbuilt.  One that ends a process ends all, and is the last to be
    built next time.
    """
    costs = [SLOW.get(kernel.name, 1) for kernel, _ in wanted]
    left = {
        (kernel.name, target): cost
        for (kernel, target), cost in zip(wanted, costs, strict=True)
        if not _is_sound(kernel, package_path(kernel) if target is None else _path_in(folder, kernel, target))
    }
    paths = {(kernel.name, target): _path_in(folder, kernel, target) for kernel, target in wanted}
    tried = _trials(paths)
    # the longest come first, so that none is left over at the end
    left = dict(sorted(left.items(), key=lambda item: (item[0] in tried, -item[1])))

    def tell(at_work: int) -> None:
        rest = sum(left.values()) - sum([*left.values()][:at_work]) / 2  # they are half done
        progress(round(100 - 100 * rest / sum(costs)), 100)

    tell(0)
    if left:
        if not has_compiler():
            raise UsageError("warmup", f"needs a C++ compiler for torch: {_compiler()} is not here; CXX names another")
        _check_execution(cache_folder())
        processes = min(given_threads(), MAX_PROCESSES, len(left))
        pool = Processes(processes, ordered=False)
        problems: dict[str, str] = {}
        with scratch() as temporary:
            build_one = partial(_build, folder, tuple(recipes), str(temporary))
            try:
                for package, problem in pool.map(build_one, tuple(left)):
                    del left[package]
                    tell(processes)
                    if problem:
                        problems[package[0]] = problem
            except UsageError:  # a process died, perhaps of what it built
                died = dict(_trials(paths).items() - tried.items())
                if not died:
                    raise
                problems |= {name: DEADLY for name, _ in died}
        if problems:
            names, problem = ", ".join(sorted(problems)), next(iter(problems.values()))
            raise UsageError("warmup", f"torch {torch.__version__} cannot compile {names} here: {problem}")


def _check_execution(folder: Path) -> None:
    """Refuse a cache from which the system loads no library, before minutes of compiling."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        refused = hasattr(os, "ST_NOEXEC") and os.statvfs(folder).f_flag & os.ST_NOEXEC  # Linux tells
    except OSError as error:
        raise UsageError("warmup", f"cannot write {folder}: {reason(error)}") from error
    if refused:
        raise UsageError("warmup", f"{folder} is mounted without execution (noexec); XDG_CACHE_HOME names another")


@cache
def _warn(where: str, problem: str) -> None:
    log.warning("%s: %s; images are drawn eagerly, and slower; `aaplug warmup` builds it again", where, problem)


def package_of(kernel: Kernel) -> Package | None:
    """The package of a kernel; None if it is not built or, with a warning, if it cannot be used."""
    path = None
    try:
        path = package_path(kernel)
        return Package.of(_compared(kernel, path), kernel)
    except UsageError as error:
        if path is None or isfile(path):
            _warn(str(path or error.where), error.problem)
        return None


def _library_and_mark(package: Path) -> tuple[Path, Path]:
    return cache_folder() / f"{package.stem}.so", cache_folder() / f"{package.stem}.so.sha256"


def _trials(paths: Mapping[tuple[str, Target | None], Path]) -> dict[tuple[str, Target | None], int]:
    """Those packages whose trial has not ended, or ended with its process, and when it began, in ns."""
    begun = {}
    for package, path in paths.items():
        _, mark = _library_and_mark(path)
        with suppress(OSError, UnicodeError):  # there is none
            if mark.read_text().startswith(TRIED):
                begun[package] = mark.stat().st_mtime_ns
    return begun


def _is_sound(kernel: Kernel, package: Path) -> bool:
    with suppress(UsageError):
        return bool(_compared(kernel, package))
    return False


def _compared(kernel: Kernel, package: Path) -> Run:
    """The function in a kernel's library, whose results were compared with the eager ones once.

    Raises UsageError if it is not built, cannot be unpacked or loaded, or has other results.
    """
    library, mark = _library_and_mark(package)
    try:
        if mark.is_file() and library.is_file() and mark.read_text() == digest_of_files([library]):
            return _opened(library)
        library.parent.mkdir(parents=True, exist_ok=True)
        with zipfile.ZipFile(package) as members, scratch(str(library.parent)) as folder:
            [name] = [name for name in members.namelist() if name.endswith(LIBRARY_SUFFIXES)]
            (folder / library.name).write_bytes(members.read(name))
            digest = digest_of_files([folder / library.name])
            os.replace(folder / library.name, library)
        with _trial(mark, digest) as first, torch.no_grad(), torch_threads(1):  # more threads would wait for each other
            run = _opened(library)
            if first:
                args, twins = kernel.example(), kernel.example()
                results = [*run(list(args)), *args]  # with the arguments that are updated in place
                expected = [*kernel.function(*twins), *twins]
                if not all(_close(a, b) for a, b in zip(results, expected, strict=True)):
                    raise ValueError("its results differ from those of eager code")
        return run
    except UsageError:
        raise
    except Exception as error:  # a broken library can fail in any way
        [problem, *_] = reason(error).splitlines() or [type(error).__name__]
        file = getattr(error, "filename", None)  # most often in the cache, which a bundle's user may not write to
        raise UsageError(f"kernel {kernel.name}", f"cannot be used: {f'{file}: ' * bool(file)}{problem}") from error


@contextmanager
def _trial(mark: Path, digest: str) -> Iterator[bool]:
    """Mark a library as tried for the time of the block, then as sound; false if another process did so meanwhile.

    Raises UsageError if a process died inside the block: loading the library would end this one, too.  Where nothing
    locks, that process may be alive, and the library is tried again.
    """
    with open(mark, "a+", encoding="ascii") as file:
        waits = lock(file.fileno()) is False  # another process is trying it
        locked = lock(file.fileno(), wait=True)
        file.seek(0)
        known = file.read()
        if waits and known == digest:
            yield False
            return
        if locked and known == TRIED + digest:
            raise UsageError("kernel", f"cannot be used: {DEADLY}; if it was killed, delete {mark}")
        file.truncate(0)
        print(TRIED + digest, end="", file=file, flush=True)
        outcome = ""
        try:
            yield True
            outcome = digest
        finally:
            file.truncate(0)
            file.write(outcome)


def _opened(library: Path) -> Run:
    # This is the runner inside `aoti_load_package`, whose import takes 2 s and whose calls take four times as long.
    return torch._C._aoti.AOTIModelContainerRunnerCpu(str(library), 1).run  # pyright: ignore[reportAttributeAccessIssue]


def _close(result: torch.Tensor, expected: torch.Tensor) -> bool:
    result, expected = result.double(), expected.double()
    return bool((result - expected).abs().max() <= RESULT_TOLERANCE * (1 + expected.abs().max()))


def _build(
    folder: Path, recipes: Sequence[Recipe], temporary: str, package: tuple[str, Target | None]
) -> tuple[tuple[str, Target | None], str]:
    """Build one package, by its kernel's name, in a process that does nothing else.

    temporary: a folder for what torch would leave among the system's temporary files: 600 MB of precompiled headers.
    Returns the package, and torch's words if it cannot compile it.
    """
    tempfile.tempdir = temporary
    gc.set_threshold(*GARBAGE)
    name, target = package
    kernel = next(kernel for kernel in (*kernels_of(recipes), *TRAINER_KERNELS) if kernel.name == name)
    path = _path_in(folder, kernel, target)
    names = {name.removesuffix(ONE_MORE) for name in kernel.sizes if name is not None}
    sizes = {name: torch.export.Dim(f"size_{name}", min=2, max=MAX_SIZE) for name in names}
    sizes |= {name + ONE_MORE: size + 1 for name, size in sizes.items()}
    shapes = tuple({0: sizes[name]} if name is not None else None for name in kernel.sizes)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        from torch.fx.experimental.proxy_tensor import make_fx  # takes a second

        with scratch(str(path.parent)) as scratched, warnings.catch_warnings(action="ignore"), torch.no_grad():
            args = kernel.example()
            module = make_fx(kernel.function, tracing_mode="symbolic")(*args) if kernel.pulls_back else _Module(kernel)
            program = torch.export.export(module, args, dynamic_shapes=shapes if kernel.pulls_back else (shapes,))
            made = torch._inductor.aoti_compile_and_package(
                program, package_path=str(scratched / "k.pt2"), inductor_configs=_configs(kernel, target)
            )
            for each in _library_and_mark(path):  # of the package that is replaced
                each.unlink(missing_ok=True)
            os.replace(made, path)
        _compared(kernel, path)
        return package, ""
    except OSError as error:
        raise UsageError("warmup", f"cannot write {path.parent}: {reason(error)}") from error
    except Exception as error:  # a compiler can fail in any way
        return package, str(error) or type(error).__name__


def _configs(kernel: Kernel, target: Target | None = None) -> dict[str, Any]:
    """Inductor's settings; raises UsageError if this torch or the compiler takes no target."""
    from torch._inductor.config import cpp  # takes long

    configs = OPTIONS | {TILING_HEURISTIC: not kernel.gathers} | (CHAINED_OPTIONS if kernel.chained else {})
    where_known = dict.fromkeys(FOR_PROFILERS, False) | CALLER_LEVEL
    where_known |= {} if shutil.which(DIGESTS) else {PRECOMPILES: False}
    x86_linux = (sys.platform, platform.machine()) == ("linux", "x86_64")
    free = getattr(cpp, "march", "missing") is None  # known to this torch, and not set by the user
    words = _compiler_version(_compiler())
    if x86_linux and free and (GNU in words or (CLANG in words and target is None)):
        capability = target.capability if target else torch.backends.cpu.get_cpu_capability()
        wide = capability == MANY_REGISTERS
        options = SCHEDULING[kernel.keeps_sums or not wide] if GNU in words else CONTRACTING
        processor = target.name if target else THIS_PROCESSOR
        march = " ".join([processor, options, PLAIN_STACK, FEW_SYMBOLS, *[WHOLE_VECTORS] * wide])
        configs |= {"cpp.march": march} | ({"cpp.simdlen": target.bits} if target else {})
        where_known |= {TRIED_OUT: True} | ({PRECOMPILES: False} if kernel.keeps_sums and wide else {})
    elif target is not None:
        raise UsageError("bundle", f"needs {STANDARD_COMPILER} and a torch that tells it the architecture")
    known = torch._inductor.list_options()
    return configs | {name: value for name, value in where_known.items() if name in known}


class _Module(torch.nn.Module):
    """A kernel as torch.export takes it."""

    def __init__(self, kernel: Kernel):
        super().__init__()
        self.function = kernel.function

    def forward(self, *args: torch.Tensor) -> tuple[torch.Tensor, ...]:
        return self.function(*args)
