"""Fine-tuning at test time: move the Gaussians until every scale looks like the training size."""

from typing import TYPE_CHECKING

from aaplug.system.registry import Registry

if TYPE_CHECKING:
    from aaplug.finetuning.settings import Loss, Method

METHODS: Registry["Method"] = Registry(
    "method", "aaplug.finetuning.settings:Method", {"consistency": "aaplug.finetuning.settings:CONSISTENCY"}
)
LOSSES: Registry["Loss"] = Registry("loss", "aaplug.finetuning.settings:Loss", {"l2": "aaplug.finetuning.settings:l2"})
