"""Group Training: only a share of the Gaussians is drawn and moves at a time (Wang et al. 2025, arXiv 2412.07608).

Share and times are those of the published code, in proportion to the run.  There, groups are drawn anew every 500 of
iterations 1,000 to 29,000 out of 30,000, by opacity and without replacement; all Gaussians train before, from 14,500 to
15,000, and after.

n: Gaussians of the scene; k: of the group.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from aaplug.finetuning.settings import SEED_STRIDE, Method, Settings, consistency
from aaplug.finetuning.state import State, TuningJob
from aaplug.methods.viewers import FAST

SHARE = 0.6  # of the Gaussians
PERIODS = 60  # of a run, each with a group of its own: 500 of 30,000 iterations
WHOLE_PERIODS = {0, 1, 29, 58, 59}  # in which all Gaussians train: iterations 0, 500, 14,500, 29,000 and 29,500
GROUP_SEED = 9_000_000  # added to the seed for the groups


@contextmanager
def with_group(job: TuningJob, state: State) -> Iterator[None]:
    """A step after which the Gaussians outside the group, and their Adam moments, are as before."""
    regroup(state, job.settings)
    if state.group is None:
        yield
        return
    moving = [group["params"][0] for group in state.adam.param_groups]
    columns = [leaf.data for leaf in moving]
    columns += [m for leaf in moving for m in state.adam.state[leaf].values() if m.shape == leaf.shape]
    others = torch.ones(len(columns[0]), dtype=torch.bool).index_fill_(0, state.group, False).nonzero()[:, 0]
    before = [column.index_select(0, others) for column in columns]
    yield
    for column, values in zip(columns, before, strict=True):
        column.index_copy_(0, others, values)


def regroup(state: State, settings: Settings) -> None:
    """Draw the group of the step that follows, if a period begins with it."""
    period, before = (step * PERIODS // settings.steps for step in (state.step, state.step - 1))
    if period == before and state.step:
        return
    generator = torch.Generator().manual_seed(settings.seed * SEED_STRIDE + GROUP_SEED + period)
    opacities = state.leaves["logit_opacities"].detach().sigmoid()
    state.group = None if period in WHOLE_PERIODS else drawn(opacities, SHARE, generator)


def drawn(opacities: Float[Tensor, " n"], share: float, generator: torch.Generator) -> Int[Tensor, " k"]:
    """Places of a share of the Gaussians, by opacity and without replacement (Efraimidis and Spirakis 2006)."""
    count = max(1, round(share * len(opacities)))
    uniform = torch.rand(len(opacities), generator=generator, dtype=torch.float64)
    keys = uniform.log() / opacities.double().clamp(min=torch.finfo(torch.float32).tiny)
    return keys.topk(count).indices.sort().values


def group_training(scales: Sequence[float], move: Sequence[str], anchor: float) -> Settings:
    """Consistency's settings."""
    return replace(consistency(scales, move, anchor), name="group-training")


GROUP_TRAINING = Method(group_training, FAST, with_group)
