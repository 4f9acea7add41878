"""The loop: draw a view and a scale, compare the render with what it should be, move the leaves, keep the bounds.

A run is a function of its job alone: what step t draws depends on the seed and t, so that a run that was stopped and
resumed is, bit for bit, one that never was.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.cameras import Camera
from aaplug.core.errors import UsageError
from aaplug.core.sampling import sampling_bounds
from aaplug.core.splats import Splats2D
from aaplug.finetuning.checkpoints import packed, unpacked
from aaplug.finetuning.densification import Pulls, carried, densify
from aaplug.finetuning.losses import LOSSES
from aaplug.finetuning.parameters import Leaves, extent, leaves_of, scene_of, thinnest
from aaplug.finetuning.settings import Settings
from aaplug.finetuning.state import Job, State, optimizer
from aaplug.rasterizers import averaged
from aaplug.rendering.renderer import sampled, splats_of

BOUNDS_EVERY = 100  # steps between computations of the sampling bounds (Mip-Splatting)
MAX_LOGIT = 9.0  # of an opacity: 0.9999, where its gradient has all but gone
MAX_BAD = 3  # steps in a row without a finite gradient, after which the run goes back
BACK_OFF = 0.5  # of the learning rates after going back
MAX_BACK_OFFS = 5
SEEDS, SCALE_SEEDS, SPLIT_SEEDS = 10_000_019, 3_000_000, 6_000_000  # keep the draws apart


def run(
    job: Job,
    state: State,
    good: Mapping[str, Any] | None = None,
    *,
    every: int = 100,
    keep: Callable[[State, Mapping[str, Any]], None] = lambda state, good: None,
    stop: Callable[[], bool] = lambda: False,
    say: Callable[[str], None] = lambda text: None,
) -> bool:
    """Step until the job is done, or `stop` says so; whether it is done.

    good: the state to go back to, if the run is resumed.  keep: told the state and the one to go back to, every
    `every` steps and when it stops.

    Raises:
        UsageError: no finite gradient comes, however small the steps.
    """
    good = packed(state) if good is None else good
    while state.step < job.settings.steps and not stop():
        advance(job, state)
        if state.bad >= MAX_BAD:
            _go_back(job, state, good, say)
        if state.step % every == 0 and not state.bad:
            good = packed(state)
            keep(state, good)
    if state.step % every or state.bad:
        keep(state, good)
    return state.step >= job.settings.steps


def advance(job: Job, state: State) -> None:
    """One step; one without a finite gradient changes nothing but the count of those."""
    settings, dense = job.settings, job.settings.densify_every
    view, terms = _drawn(settings, job.views, state.step)
    state.adam.zero_grad(set_to_none=True)
    losses = {}
    for scale, weight in terms.items():
        loss, splats, hw = loss_at(job, state, view, scale)
        (weight * loss).backward()
        losses[scale] = loss.item()
        if dense:
            state.pulls.add(splats, hw)
    state.step += 1
    if not _finite(losses, state.leaves):
        state.bad += 1
        return
    state.bad = 0
    state.curve.append({"step": state.step, "view": view.name, "loss": losses})
    _set_rates(job, state)
    state.adam.step()
    _hold(state)
    if dense and state.step % dense == 0 and state.step < settings.steps:
        _densify(job, state)
    elif state.step % BOUNDS_EVERY == 0 and "means" in settings.rates:
        _bound(job, state)


def _go_back(job: Job, state: State, good: Mapping[str, Any], say: Callable[[str], None]) -> None:
    """Take up the last good state, at half the learning rates; the steps that led away are not drawn again."""
    step, back_offs = state.step, state.back_offs + 1
    if back_offs > MAX_BACK_OFFS:
        raise UsageError(
            "finetune", f"finds no finite gradient, at step {step} and {MAX_BACK_OFFS} times before"
        )
    restored = unpacked(good, job)
    vars(state).update(vars(restored))
    state.step, state.bad, state.back_offs = step, 0, back_offs
    say(
        f"step {step}: {MAX_BAD} steps without a finite gradient; back to step {good['step']}, at half the rates"
    )


def loss_at(
    job: Job, state: State, view: Camera, scale: float
) -> tuple[Float[Tensor, ""], Splats2D, tuple[int, int]]:
    """The loss of one view at one scale, the splats that it drew, and the size they were drawn at."""
    truth, camera = job.truth(view, scale), view.scaled(scale)
    scene = scene_of(state.leaves, job.start)
    training = replace(job.training, bounds=state.bounds)
    fine, samples = sampled(scene, camera, job.recipe, training)
    splats = splats_of(scene, fine, job.recipe, training, job.rasterizer)
    if splats.means.requires_grad:
        splats.means.retain_grad()
    image = averaged(job.rasterizer(splats, fine.hw, job.background, job.recipe.pixel), samples).rgb
    return LOSSES[job.settings.loss](image, truth.to(image)), splats, fine.hw


def _drawn(
    settings: Settings, views: Sequence[Camera], step: int
) -> tuple[Camera, dict[float, float]]:
    """The view of a step, each once before any comes again, and its scales with their weights."""
    count = len(views)
    epoch = torch.Generator().manual_seed(settings.seed * SEEDS + step // count)
    view = views[int(torch.randperm(count, generator=epoch)[step % count])]
    scales = list(settings.weights)
    own = torch.Generator().manual_seed(settings.seed * SEEDS + SCALE_SEEDS + step)
    scale = scales[int(torch.randint(len(scales), (), generator=own))]
    terms = {scale: settings.weights[scale]}
    if settings.anchor:
        terms[1.0] = terms.get(1.0, 0.0) + settings.anchor
    return view, terms


def _finite(losses: Mapping[float, float], leaves: Leaves) -> bool:
    grads = [leaf.grad for leaf in leaves.values() if leaf.grad is not None]
    found = [math.isfinite(loss) for loss in losses.values()]
    return all(found) and all(bool(grad.sum().isfinite()) for grad in grads)


def _set_rates(job: Job, state: State) -> None:
    share = job.settings.decay ** (state.step / job.settings.steps) * BACK_OFF**state.back_offs
    for group in state.adam.param_groups:
        rate = job.settings.rates[group["name"]]
        size = extent(tuple(job.training.cameras)) if group["name"] == "means" else 1.0
        group["lr"] = rate * size * share


@torch.no_grad()
def _hold(state: State) -> None:
    """Keep the bounds."""
    scales, logits = state.leaves["log_scales"], state.leaves["logit_opacities"]
    if scales.requires_grad:
        torch.maximum(scales, thinnest(state.born, state.bounds), out=scales.data)
    if logits.requires_grad:
        logits.data.clamp_(max=MAX_LOGIT)


def _densify(job: Job, state: State) -> None:
    """Change the Gaussians, and carry over what the optimizer knows of them."""
    generator = torch.Generator().manual_seed(job.settings.seed * SEEDS + SPLIT_SEEDS + state.step)
    with torch.no_grad():
        scene = scene_of(state.leaves, job.start)
        change = densify(scene, state.pulls.mean, extent(tuple(job.training.cameras)), generator)
        moments = {
            group["name"]: carried(state.adam.state[group["params"][0]], change)
            for group in state.adam.param_groups
        }
    state.leaves = leaves_of(change.scene)
    state.adam = optimizer(state.leaves, job.settings)
    for group in state.adam.param_groups:
        state.adam.state[group["params"][0]] = moments[group["name"]]
    own = state.leaves["log_scales"].detach().clone()
    state.born = torch.where(change.new[:, None], own, state.born[change.sources])
    _bound(job, state)
    state.pulls = Pulls.none(len(own))


@torch.no_grad()
def _bound(job: Job, state: State) -> None:
    """Find the bounds anew where the Gaussians are now, and keep them."""
    state.bounds = sampling_bounds(state.leaves["means"].detach(), job.training.cameras)
    _hold(state)
