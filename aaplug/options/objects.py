"""Types of what options take beside names; the type checker alone knows those whose modules import torch."""

from os import PathLike
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from aaplug.core.executors import Executor
    from aaplug.core.interfaces import Rasterizer
    from aaplug.evaluation.protocols import Protocol
    from aaplug.methods.recipe import Recipe
    from aaplug.methods.viewers import Viewer
else:
    Executor = Rasterizer = Protocol = Recipe = Viewer = Any

AnyPath = str | PathLike[str]
