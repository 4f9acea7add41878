"""Kernels that are compiled while a program draws: a trainer or a live page needs no `aaplug warmup`.

Until they are ready, the program draws eagerly.  Another process compiles them, and ends with the program; what is
ready by then is kept.
"""

import atexit
import logging
import math
import os
import subprocess
import sys
import threading
import time

from torch import Tensor

from aaplug.core.kernels import Kernel, Runner
from aaplug.rasterizers.tiled.ahead_of_time import KERNELS, TRAINER_KERNELS, has_compiler, load_or_eager, package_of
from aaplug.rasterizers.tiled.packages import CompiledKernels, Package

PATIENCE_SECONDS = 20.0  # from the first kernel that is missing until it is compiled: a short program has ended by then
LOOK_SECONDS = 1.0  # between looks at the process that compiles
COMPILER = """
import os, sys
from aaplug.rasterizers.tiled.ahead_of_time import build
from aaplug.system.signals import end_as_worker
end_as_worker()
getattr(os, "nice", int)(10)
build(names=sys.argv[1:])
"""

BUILT_BY_NAME = frozenset(kernel.name for kernel in (*KERNELS, *TRAINER_KERNELS))

log = logging.getLogger("aaplug")


class OnDemandKernels(CompiledKernels):
    """Runs compiled packages where they are built, and has those that are missing built."""

    def __init__(self) -> None:
        """A kernel that cannot be built stays eager."""
        super().__init__(package_of, KERNELS, load_or_eager)
        self._missing: set[str] = set()
        self._tried: set[str] = set()
        self._compiler: subprocess.Popen[str] | None = None
        self._listener, self._errors = threading.Thread(), ""  # a pipe that nobody reads would stop the compiler
        self._can_build, self._next_look = has_compiler(), math.inf

    def runner(self, kernel: Kernel, args: tuple[Tensor, ...]) -> Runner:
        """The function that runs one stage for such arguments."""
        if time.monotonic() > self._next_look:
            self._look()
        runner = super().runner(kernel, args)
        if self._missing and self._next_look == math.inf:
            self._next_look = time.monotonic() + PATIENCE_SECONDS
            known = self._missing <= {kernel.name for kernel in KERNELS}
            when = f"beside this program after {PATIENCE_SECONDS:.0f} s{', or before it by `aaplug warmup`' * known}"
            log.warning("this program is slower, some of it several times, until its kernels are compiled: %s", when)
        return runner

    def _package(self, kernel: Kernel) -> Package | None:
        package = super()._package(kernel)
        if package is None and kernel.name in BUILT_BY_NAME - self._tried and self._can_build:
            self._missing.add(kernel.name)
        return package

    def _look(self) -> None:
        """Start the process that compiles what is missing, or take up what it has built."""
        self._next_look = time.monotonic() + LOOK_SECONDS
        if self._compiler is None:
            names = sorted(self._missing)
            self._tried |= self._missing
            environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
            command = [sys.executable, "-c", COMPILER, *names]
            how = {"stderr": subprocess.PIPE, "text": True, "errors": "replace", "env": environment}
            self._compiler = subprocess.Popen(command, **how)
            self._listener = threading.Thread(target=self._listen, args=(self._compiler,), daemon=True)
            self._listener.start()
            atexit.register(self._compiler.terminate)
        elif self._compiler.poll() is not None:
            self._listener.join()
            if self._compiler.returncode:
                log.warning("kernels are not compiled, and run eagerly: %s", self._errors.strip().rpartition("\n")[2])
            for name in self._tried:
                self._packages.pop(name, None)
            self._missing -= self._tried
            atexit.unregister(self._compiler.terminate)
            self._compiler, self._next_look = None, math.inf

    def _listen(self, compiler: "subprocess.Popen[str]") -> None:
        _, self._errors = compiler.communicate()
