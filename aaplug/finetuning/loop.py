"""The optimization loop: render a view at a scale, compare it with ground truth, take an Adam step, clamp parameters.

No Gaussian may become thinner than its sampling bound, or than it was if it was thinner: no training view could resolve
less than √0.2 px at its highest rate (Mip-Splatting, section 5.1).

Runs are reproducible: the view and scale of step t depend only on the seed and t.  A run that was stopped and resumed
therefore equals an uninterrupted one, bit for bit.
"""

import math
from collections.abc import Callable, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.cameras import Camera
from aaplug.core.sampling import SamplingBounds, sampling_bounds
from aaplug.finetuning import LOSSES
from aaplug.finetuning.settings import SEED_STRIDE, Settings
from aaplug.finetuning.state import State, TuningJob
from aaplug.methods.filters.smoothing import NYQUIST_VARIANCE
from aaplug.rendering.renderer import Drawing
from aaplug.system.cores import on_free_cores
from aaplug.system.errors import PlugInError, UsageError
from aaplug.system.monitor import Tell
from aaplug.system.plug_ins import asked, blaming

BOUNDS_EVERY = 100  # steps between computations of the sampling bounds (Mip-Splatting)
MAX_LOGIT = 9.0  # largest opacity logit: opacity 0.9999, where the sigmoid's gradient is nearly 0
MAX_BAD_STEPS = 18  # consecutive steps without finite gradients that end a run
SCALE_SEED = 3_000_000  # added for the scale of a step
EXTENT_MARGIN = 1.1  # times the training cameras' farthest distance from their mean (3DGS)


def run(
    job: TuningJob,
    state: State,
    *,
    every: int = 100,
    keep: Callable[[State], None] = lambda state: None,
    stop: Callable[[], object] = lambda: False,
    tell: Tell = lambda done, total: None,
) -> bool:
    """Step until the job is done or `stop()` is true; return True if it is done.

    state: where to begin; changed in place.
    every: steps between calls of `keep`, which is also called when the run stops.
    stop: asked before every step.  tell: called with (steps done, steps in all).

    Raises UsageError if many steps in turn have no finite gradient, or the loss breaks its interface.
    """
    tell(state.step, job.settings.steps)
    while state.step < job.settings.steps and not stop():
        advance(job, state)
        tell(state.step, job.settings.steps)
        _average(job.settings, state)
        if state.bad_steps >= MAX_BAD_STEPS:
            problem = f"has no finite gradient at step {state.step}, nor at the {MAX_BAD_STEPS - 1} before"
            raise UsageError("finetune", f"{problem}; a lower `learning_rate` may help")
        if state.step % every == 0:
            keep(state)
    if state.step % every:
        keep(state)
    return state.step >= job.settings.steps


def advance(job: TuningJob, state: State) -> None:
    """Take one step, as the method has it; if a loss or gradient is not finite, the step is only counted."""
    settings = job.settings
    with job.method.around(job, state) as drawings:
        view, weights = view_and_weights(settings, job.views, state.step)
        state.adam.zero_grad(set_to_none=True)
        losses = {}
        for scale, weight in weights.items():
            loss, drawing = loss_at(job, state, view, scale)
            with on_free_cores(), blaming(*state.renderer_of_step(job).recipe.parts, ("loss", LOSSES[settings.loss])):
                (weight * loss).backward()
            losses[scale] = loss.item()
            if drawings is not None:
                drawings.append(drawing)
        state.step += 1
        gradients = [leaf.grad for leaf in state.leaves.values() if leaf.grad is not None]
        if not all(map(math.isfinite, losses.values())) or not all(bool(g.sum().isfinite()) for g in gradients):
            state.bad_steps += 1
            return
        state.bad_steps = 0
        state.curve.append({"step": state.step, "view": view.name, "loss": losses})
        decay = settings.decay ** (state.step / settings.steps)
        for group in state.adam.param_groups:
            size = extent(job.start.training.cameras) if group["name"] == "means" else 1.0
            group["lr"] = settings.rates[group["name"]] * size * decay
        with on_free_cores():
            state.adam.step()
        _clamp_parameters(state)
        if state.step % BOUNDS_EVERY == 0 and "means" in settings.rates:
            update_bounds(job, state)


@torch.no_grad()
def _average(settings: Settings, state: State) -> None:
    """Take the parameters into their mean over the last steps, which they become at the end (Polyak and Juditsky 1992).

    Each step leaves noise, as it sees one view; the mean has less.
    """
    if state.step <= (1 - settings.averaged) * settings.steps:
        return
    state.averaged += 1
    for name in settings.rates:
        leaf = state.leaves[name].data
        if state.averaged == 1:
            state.averages[name] = leaf.clone()
        mean = state.averages[name].lerp_(leaf, 1 / state.averaged)
        if state.step == settings.steps:
            leaf.copy_(mean)


def loss_at(job: TuningJob, state: State, view: Camera, scale: float) -> tuple[Float[Tensor, ""], Drawing]:
    """Loss of one view at one scale, and its drawing, whose screen-space means retain their gradients."""
    truth = job.truth(view, scale)
    drawing = state.renderer_of_step(job).draw(view.scaled(scale))
    if drawing.splats.means.requires_grad:
        drawing.splats.means.retain_grad()
    image = drawing.render.rgb
    name = job.settings.loss
    loss = asked("loss", LOSSES[name], "__call__", image, truth.to(image))
    if image.requires_grad and not loss.requires_grad:
        raise PlugInError(f"loss {name}", "should have a gradient in the image, got none")
    if not loss.isfinite() and image.isfinite().all():
        problem = f"at step {state.step + 1}: expected a finite number, got {loss.item()}"
        raise PlugInError(f"loss {name}", problem)
    return loss, drawing


@torch.no_grad()
def update_bounds(job: TuningJob, state: State) -> None:
    """Compute the sampling bounds where the Gaussians are now, and clamp the parameters by them."""
    state.bounds = sampling_bounds(state.leaves["means"].detach(), job.start.training.cameras)
    _clamp_parameters(state)


def view_and_weights(settings: Settings, views: Sequence[Camera], step: int) -> tuple[Camera, dict[float, float]]:
    """View of a step, and weight by scale; a random permutation per epoch uses every view once before any repeats."""
    count = len(views)
    of_epoch = torch.Generator().manual_seed(settings.seed * SEED_STRIDE + step // count)
    view = views[int(torch.randperm(count, generator=of_epoch)[step % count])]
    of_step = torch.Generator().manual_seed(settings.seed * SEED_STRIDE + SCALE_SEED + step)
    place = int(torch.randint(len(settings.weights), (), generator=of_step))
    weights = dict([list(settings.weights.items())[place]])
    if settings.anchor:
        weights[1.0] = weights.get(1.0, 0.0) + settings.anchor
    return view, weights


def extent(cameras: Sequence[Camera]) -> float:
    """The scene's size in world units, from the spread of its training cameras (3DGS)."""
    centres = torch.stack([camera.centre for camera in cameras])
    spread = (centres - centres.mean(dim=0)).norm(dim=1).max().item()
    return EXTENT_MARGIN * spread if spread > 0 else 1.0


def least_log_scales(first: Float[Tensor, "n 3"], bounds: SamplingBounds) -> Float[Tensor, "n 3"]:
    """ln of the least standard deviation that each axis may take, given the one it had at first."""
    floor = 0.5 * torch.log(torch.tensor(NYQUIST_VARIANCE)) - bounds.highest_or_coarsest.log()
    return torch.minimum(first, floor.to(first)[:, None])


@torch.no_grad()
def _clamp_parameters(state: State) -> None:
    """Clamp scales from below by their sampling bound, and opacity logits from above."""
    scales, logits = state.leaves["log_scales"], state.leaves["logit_opacities"]
    if scales.requires_grad:
        least = least_log_scales(state.first_log_scales, state.bounds)
        torch.maximum(scales, least, out=scales.data)
    if logits.requires_grad:
        logits.data.clamp_(max=MAX_LOGIT)
