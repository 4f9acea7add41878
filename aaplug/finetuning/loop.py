"""The optimization loop: render a view at a scale, compare it with ground truth, take an Adam step, clamp parameters.

Runs are reproducible: the view and scale of step t depend only on the seed and t.  A run that was stopped and resumed
therefore equals an uninterrupted one, bit for bit.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.cameras import Camera
from aaplug.core.errors import UsageError
from aaplug.core.sampling import sampling_bounds
from aaplug.finetuning.densification import ScreenGradients, carried, densify
from aaplug.finetuning.losses import LOSSES
from aaplug.finetuning.parameters import Leaves, extent, least_log_scales, leaves_of
from aaplug.finetuning.settings import Settings
from aaplug.finetuning.state import State, TuningJob, optimizer, packed, unpacked
from aaplug.rendering.renderer import Drawing

BOUNDS_EVERY = 100  # steps between computations of the sampling bounds (Mip-Splatting)
MAX_LOGIT = 9.0  # largest opacity logit: opacity 0.9999, where the sigmoid's gradient is nearly 0
MAX_BAD_STEPS = 3  # consecutive steps without finite gradients before the run rolls back
BACK_OFF = 0.5  # factor on all learning rates per rollback
MAX_ROLLBACKS = 5
SEEDS, SCALE_SEEDS, SPLIT_SEEDS = 10_000_019, 3_000_000, 6_000_000  # stride of user seeds; offsets for scales, splits


def run(
    job: TuningJob,
    state: State,
    good: Mapping[str, Any] | None = None,
    *,
    every: int = 100,
    keep: Callable[[State, Mapping[str, Any]], None] = lambda state, good: None,
    stop: Callable[[], bool] = lambda: False,
    say: Callable[[str], None] = lambda text: None,
) -> bool:
    """Step until the job is done or `stop()` is true; return whether it is done.

    state: where to begin; changed in place.
    good: the state to return to, packed; None for the given one.
    every: steps between calls of `keep`.
    keep: called with the state and the last good one, also when the run stops.
    stop: asked before every step.  say: called when the run rolls back.

    Raises UsageError if no step has a finite gradient, at any learning rate.
    """
    good = good or packed(state)
    while state.step < job.settings.steps and not stop():
        advance(job, state)
        if state.bad_steps >= MAX_BAD_STEPS:
            _roll_back(job, state, good, say)
        if state.step % every == 0 and not state.bad_steps:
            good = packed(state)
            keep(state, good)
    if state.step % every or state.bad_steps:
        keep(state, good)
    return state.step >= job.settings.steps


def advance(job: TuningJob, state: State) -> None:
    """Take one step; if a loss or gradient is not finite, only the step is counted."""
    settings, dense = job.settings, job.settings.densify_every
    view, terms = _drawn(settings, job.views, state.step)
    state.adam.zero_grad(set_to_none=True)
    losses, drawings = {}, []
    for scale, weight in terms.items():
        loss, drawing = loss_at(job, state, view, scale)
        (weight * loss).backward()
        losses[scale] = loss.item()
        drawings += [drawing] if dense else []
    state.step += 1
    if not _finite(losses, state.leaves):
        state.bad_steps += 1
        return
    state.bad_steps = 0
    for drawing in drawings:
        state.gradients.add(drawing)
    state.curve.append({"step": state.step, "view": view.name, "loss": losses})
    _set_learning_rates(job, state)
    state.adam.step()
    _clamp_parameters(state)
    if dense and state.step % dense == 0 and state.step < settings.steps:
        _densify(job, state)
    elif state.step % BOUNDS_EVERY == 0 and "means" in settings.rates:
        _update_bounds(job, state)


def loss_at(job: TuningJob, state: State, view: Camera, scale: float) -> tuple[Float[Tensor, ""], Drawing]:
    """Loss of one view at one scale, and its drawing, whose screen-space means retain their gradients."""
    truth = job.truth(view, scale)
    drawing = state.renderer(job).draw(view.scaled(scale))
    if drawing.splats.means.requires_grad:
        drawing.splats.means.retain_grad()
    image = drawing.render.rgb
    return LOSSES[job.settings.loss](image, truth.to(image)), drawing


def _roll_back(job: TuningJob, state: State, good: Mapping[str, Any], say: Callable[[str], None]) -> None:
    """Restore the last good state and halve the learning rates; the step count continues, so other views follow."""
    step, rollbacks = state.step, state.rollbacks + 1
    if rollbacks > MAX_ROLLBACKS:
        raise UsageError("finetune", f"has no finite gradient at step {step}, after {MAX_ROLLBACKS} rollbacks")
    vars(state).update(vars(unpacked(good, job)))
    state.step, state.bad_steps, state.rollbacks = step, 0, rollbacks
    back = f"back to step {good['step']}, at half the learning rates"
    say(f"step {step}: {MAX_BAD_STEPS} steps without a finite gradient; {back}")


def _drawn(settings: Settings, views: Sequence[Camera], step: int) -> tuple[Camera, dict[float, float]]:
    """View of a step, and weight by scale; a random permutation per epoch uses every view once before any repeats."""
    count = len(views)
    epoch = torch.Generator().manual_seed(settings.seed * SEEDS + step // count)
    view = views[int(torch.randperm(count, generator=epoch)[step % count])]
    own = torch.Generator().manual_seed(settings.seed * SEEDS + SCALE_SEEDS + step)
    place = int(torch.randint(len(settings.weights), (), generator=own))
    terms = dict([list(settings.weights.items())[place]])
    if settings.anchor:
        terms[1.0] = terms.get(1.0, 0.0) + settings.anchor
    return view, terms


def _finite(losses: Mapping[float, float], leaves: Leaves) -> bool:
    grads = (leaf.grad for leaf in leaves.values() if leaf.grad is not None)
    return all(map(math.isfinite, losses.values())) and all(bool(grad.sum().isfinite()) for grad in grads)


def _set_learning_rates(job: TuningJob, state: State) -> None:
    share = job.settings.decay ** (state.step / job.settings.steps) * BACK_OFF**state.rollbacks
    for group in state.adam.param_groups:
        size = extent(job.start.training.cameras) if group["name"] == "means" else 1.0
        group["lr"] = job.settings.rates[group["name"]] * size * share


@torch.no_grad()
def _clamp_parameters(state: State) -> None:
    """Clamp scales from below by their sampling bound, and opacity logits from above."""
    scales, logits = state.leaves["log_scales"], state.leaves["logit_opacities"]
    if scales.requires_grad:
        least = least_log_scales(state.first_log_scales, state.bounds)
        torch.maximum(scales, least, out=scales.data)
    if logits.requires_grad:
        logits.data.clamp_(max=MAX_LOGIT)


def _densify(job: TuningJob, state: State) -> None:
    """Change the number of Gaussians; those that stay keep their Adam moments."""
    generator = torch.Generator().manual_seed(job.settings.seed * SEEDS + SPLIT_SEEDS + state.step)
    with torch.no_grad():
        densified = densify(state.scene(job), state.gradients.mean, extent(job.start.training.cameras), generator)
        moments = {g["name"]: carried(state.adam.state[g["params"][0]], densified) for g in state.adam.param_groups}
    state.leaves = leaves_of(densified.scene)
    state.adam = optimizer(state.leaves, job.settings)
    for group in state.adam.param_groups:
        state.adam.state[group["params"][0]] = moments[group["name"]]
    first = state.first_log_scales[densified.sources]
    state.first_log_scales = torch.where(densified.new[:, None], densified.scene.log_scales, first)
    _update_bounds(job, state)
    state.gradients = ScreenGradients.none_of(len(first))


@torch.no_grad()
def _update_bounds(job: TuningJob, state: State) -> None:
    """Compute the sampling bounds where the Gaussians are now, and keep them."""
    state.bounds = sampling_bounds(state.leaves["means"].detach(), job.start.training.cameras)
    _clamp_parameters(state)
