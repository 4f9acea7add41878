"""How to fine-tune: the settings of a run, aaplug's method of choosing them, and the loss that a step minimises."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from typing import Any, Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from aaplug.methods.viewers import FAST, Viewer
from aaplug.options.verbs import ANCHOR_WEIGHT, LOSS_WEIGHTS, FinetuneOptions
from aaplug.system.errors import UsageError

ROUNDING_ERROR = (1 / 255) ** 2 / 12  # mean square error of rounding to 8 bits
SEED_STRIDE = 10_000_019  # from one of the user's seeds to the next
LEARNED_COLUMNS = "learned"  # leaf of the extras that hold learned filters, if the scene has any
RATES: Mapping[str, float] = {  # 3DGS's, per step; that of the means is a share of the scene's extent
    "means": 1.6e-4,
    "quats": 1e-3,
    "log_scales": 5e-3,
    "logit_opacities": 5e-2,
    "dc": 2.5e-3,
    "rest": 2.5e-3 / 20,
}


@dataclass(frozen=True)
class Settings:
    """Everything that a run depends on beside its scene and cameras.

    weights: of the loss, by scale against the training size; each step draws one of the scales.
    anchor: weight of the loss at the training size, which every step adds.
    rates: learning rate by parameter; a parameter without one stays fixed.
    decay: factor that the learning rates have reached at the end.
    averaged: share of the steps, the last ones, whose mean is the result.
    usual_error: root mean square error of colours in [0, 1], from which on `slowed` leaves the rates as they are.
    loss: a name in `LOSSES`.
    """

    name: str
    steps: int
    weights: Mapping[float, float]
    rates: Mapping[str, float]
    anchor: float = 0.0
    decay: float = 1.0
    averaged: float = 0.0
    usual_error: float = 0.0
    loss: str = "l2"
    seed: int = 0


# For scenes that are nearly right, as multiples of 3DGS's rates: means stay about where they are
TUNING_FACTORS = {"means": 0.1, "quats": 1.0, "log_scales": 3.6, "logit_opacities": 3.0, "dc": 3.6, "rest": 1.5}
TUNING_RATES = {name: factor * RATES[name] for name, factor in TUNING_FACTORS.items()}
CONSISTENCY_SETTINGS = Settings(
    "consistency", 1000, LOSS_WEIGHTS, TUNING_RATES, anchor=ANCHOR_WEIGHT, decay=0.3, averaged=0.5, usual_error=0.01
)
# Conversion takes a few minutes by these; `balance` divides the weights by the scene's errors
QUICK_SETTINGS = replace(
    CONSISTENCY_SETTINGS, name="quick", steps=300, weights=dict.fromkeys(LOSS_WEIGHTS, 1.0), anchor=4.0
)
# For a file that several programs show by rules without compensation: it cannot be right at all sizes
SHARED_SETTINGS = replace(QUICK_SETTINGS, weights=LOSS_WEIGHTS, anchor=1.0)


def balance(settings: Settings, errors: Mapping[float, float]) -> Settings:
    """Divide the weight of every scale by the root of the mean square error found there; errors[1.0] is the anchor's.

    Errors below that of rounding to 8 bits count as that.  Undivided losses would sacrifice scales with small errors to
    those with large ones; losses as shares of the errors would leave the large ones where they are.
    """
    roots = {scale: max(ROUNDING_ERROR, error) ** 0.5 for scale, error in errors.items()}
    weights = {scale: weight / roots[scale] for scale, weight in settings.weights.items()}
    return replace(settings, weights=weights, anchor=settings.anchor / roots[1.0])


def slowed(settings: Settings, errors: Mapping[float, float]) -> Settings:
    """Lower the learning rates of a start that is close, since a step leaves noise in proportion to its length.

    errors: mean square error of the start by scale; errors[1.0] is the anchor's.
    """
    weights = {scale: weight / len(settings.weights) for scale, weight in settings.weights.items()}
    weights[1.0] = weights.get(1.0, 0.0) + settings.anchor
    error = sum(weight * errors[scale] for scale, weight in weights.items()) / sum(weights.values())
    share = min(1.0, error**0.5 / settings.usual_error) if settings.usual_error else 1.0
    return replace(settings, rates={name: share * rate for name, rate in settings.rates.items()})


def consistency(scales: Sequence[float], move: Sequence[str], anchor: float) -> Settings:
    """One model for all scales and the training size."""
    weights = {scale: LOSS_WEIGHTS.get(scale, 1.0) for scale in scales}
    rates = {name: CONSISTENCY_SETTINGS.rates[name] for name in move}
    return replace(CONSISTENCY_SETTINGS, weights=weights, rates=rates, anchor=anchor)


@dataclass(frozen=True)
class Method:
    """A way to fine-tune.

    settings: of a run, from its scales, the parameters that move and the anchor.
    viewer: the usual one.
    around: a context for each step, given the `TuningJob` and the `State`, which it may change.  It yields None, or a
        list to which the step adds its drawings, whose screen-space means retain their gradients.
    """

    settings: Callable[[Sequence[float], Sequence[str], float], Settings]
    viewer: Viewer
    around: Callable[..., AbstractContextManager[list[Any] | None]] = lambda job, state: nullcontext()


CONSISTENCY = Method(consistency, FAST)


def settings_of(method: Method, options: FinetuneOptions) -> Settings:
    """A method's settings with the user's choices; None takes the method's own.

    Raises UsageError if a name is not known, or a choice does not fit the method.
    """
    if not options.move or any(name not in RATES for name in options.move):
        raise UsageError("move", f"needs parameters out of {', '.join(RATES)}")
    settings = method.settings(options.scale, options.move, options.anchor)
    return replace(
        settings,
        steps=settings.steps if options.steps is None else options.steps,
        rates={name: rate * options.learning_rate for name, rate in settings.rates.items()},
        loss=options.loss,
        seed=options.seed,
    )


@runtime_checkable
class Loss(Protocol):
    """How far an image is from what it should show: 0 for equal images, and differentiable in the first."""

    def __call__(self, image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"]) -> Float[Tensor, ""]: ...  # noqa: D102


def l2(image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"]) -> Float[Tensor, ""]:
    """Mean squared error (Mipmap-GS)."""
    return (image - truth).square().mean()
