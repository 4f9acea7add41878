"""Fine-tuning at test time: move the Gaussians until every scale looks like the training size."""

from typing import TYPE_CHECKING

from aaplug.system.registry import Registry

if TYPE_CHECKING:
    from aaplug.finetuning.losses import Loss
    from aaplug.finetuning.settings import Method

METHODS: Registry["Method"] = Registry(
    "method", "aaplug.finetuning.settings:Method", {"consistency": "aaplug.finetuning.settings:CONSISTENCY"}
)
LOSSES: Registry["Loss"] = Registry("loss", "aaplug.finetuning.losses:Loss", {"l2": "aaplug.finetuning.losses:l2"})
