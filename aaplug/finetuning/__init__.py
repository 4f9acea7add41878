"""Fine-tuning at test time: move the Gaussians until every scale shows what the training size shows."""

from aaplug.finetuning.checkpoints import load, save
from aaplug.finetuning.comparison import Candidate, compare
from aaplug.finetuning.parameters import between
from aaplug.finetuning.settings import OURS, QUICK, Settings, balanced, mipmap_gs
from aaplug.finetuning.state import Job, State, begin
from aaplug.finetuning.truth import Truth
from aaplug.finetuning.tuning import advance, loss_at, run
from aaplug.finetuning.upsamplers import find_upsampler

__all__ = [
    "OURS",
    "QUICK",
    "Candidate",
    "Job",
    "Settings",
    "State",
    "Truth",
    "advance",
    "balanced",
    "begin",
    "between",
    "compare",
    "find_upsampler",
    "load",
    "loss_at",
    "mipmap_gs",
    "run",
    "save",
]
