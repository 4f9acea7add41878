"""aaplug in the place of gsplat, for programs that import gsplat themselves."""

import importlib
import re
import sys
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

from aaplug.gsplat.on_cuda_alone import adam, compute_relocation, quat_scale_to_covar_preci, spherical_harmonics
from aaplug.gsplat.rendering import rasterization, rasterization_2dgs
from aaplug.system.errors import UsageError

REPLACED: dict[str, list[Callable[..., Any]]] = {  # by the modules that define them
    "gsplat.rendering": [rasterization, rasterization_2dgs],
    "gsplat.relocation": [compute_relocation],
    "gsplat.cuda._wrapper": [adam, quat_scale_to_covar_preci, spherical_harmonics],
}
OLDEST = [1, 5]  # version of gsplat whose strategies read a radius along each axis, as `meta` has


def patch() -> ExitStack:
    """Put aaplug's functions in the place of gsplat's, in every module of this process that holds them.

    Modules that import gsplat later find aaplug's too.  gsplat needs to be installed, as its strategies stay its own;
    importing it needs no GPU.  Called again, it changes nothing.

    Returns:
        What undoes it, by `close()` or at the end of a `with` block.

    Raises:
        UsageError: gsplat is not installed, is older than 1.5, or has no such functions.
    """
    pairs = []
    try:
        version = importlib.import_module("gsplat").__version__
        if [int(number) for number in re.findall(r"\d+", version)[:2]] < OLDEST:
            raise ImportError(f"this is {version}")
        for home, functions in REPLACED.items():
            module = importlib.import_module(home)
            pairs += [(getattr(module, ours.__name__), ours) for ours in functions]
    except (ImportError, AttributeError) as error:
        problem = f"expected gsplat 1.5 or newer (`pip install 'gsplat>=1.5'`, no GPU needed): {error}"
        raise UsageError("patch", f"{problem}; without it, import from aaplug.gsplat") from error
    undo = ExitStack()
    for module in list(sys.modules.values()):
        for name, held in list(getattr(module, "__dict__", {}).items()):
            for theirs, ours in pairs:
                if held is theirs and theirs is not ours:
                    setattr(module, name, ours)
                    undo.callback(setattr, module, name, theirs)
    return undo
