"""Compiling the rasterizer's kernels once for a machine."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from aaplug.io.atomic import AnyPath
from aaplug.methods import RECIPES
from aaplug.methods.recipe import Recipe
from aaplug.rasterizers.tiled.ahead_of_time import build, build_bundle, cache_folder, kernels_of
from aaplug.system.contracts import contract
from aaplug.system.monitor import SILENT, Monitor


class Kernels(NamedTuple):
    """Compiled kernels: their folder and their names."""

    folder: Path
    names: list[str]


@contract
def warmup(
    recipe: str | Recipe | Sequence[str | Recipe] = (), bundle: AnyPath | None = None, *, monitor: Monitor = SILENT
) -> Kernels:
    """Compile what is missing, in about three minutes on two free cores.

    Args:
        recipe: one or several whose kernels are compiled beside those that the default recipes need.
        bundle: folder to compile into instead, for other machines of the same torch version: for x86-64-v3 and, if
            this machine has it, x86-64-v4.  A machine without a compiler uses it by the environment variable
            AAPLUG_KERNELS.

    Raises:
        UsageError: a recipe is not known, there is no compiler or it fails, or the folder cannot be written.
    """
    named = [recipe] if isinstance(recipe, str | Recipe) else recipe
    recipes = [RECIPES.find(each, "recipe") if isinstance(each, str) else each for each in named]
    with monitor.progress("compiling", "%") as tell:
        if bundle is not None:
            made = build_bundle(Path(bundle), tell, recipes)
            return Kernels(Path(bundle), [f"{kernel.name} for {target.name}" for kernel, target in made])
        build(tell, recipes)
    return Kernels(cache_folder(), [kernel.name for kernel in kernels_of(recipes)])
