"""Fine-tuning at test time: move the Gaussians until every scale looks like the training size."""

from collections.abc import Callable
from typing import TYPE_CHECKING

from aaplug.system.registry import Registry

if TYPE_CHECKING:
    from torch import Tensor

    from aaplug.finetuning.settings import Method

METHODS: Registry["Method"] = Registry(
    "method", "aaplug.finetuning.settings:Method", {"consistency": "aaplug.finetuning.settings:CONSISTENCY"}
)
LOSSES: Registry[Callable[["Tensor", "Tensor"], "Tensor"]] = Registry(
    "loss", "collections.abc:Callable", {"l2": "aaplug.finetuning.losses:l2"}
)
