"""How to fine-tune: aaplug's method and Mipmap-GS's."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

from aaplug.core.choices import ANCHOR, WEIGHTS
from aaplug.core.errors import UsageError, not_one_of
from aaplug.core.registry import Registry
from aaplug.finetuning.losses import LOSSES
from aaplug.finetuning.parameters import RATES
from aaplug.methods.viewers import CLASSIC_VIEWER, FAST, Viewer


@dataclass(frozen=True)
class Settings:
    """Everything that a run depends on beside its scene and cameras.

    weights: of the loss, by scale against the training size; each step draws one of the scales.
    anchor: weight of the loss at the training size, which every step adds.
    rates: learning rate by parameter; a parameter without one stays fixed.
    decay: factor that the learning rates have reached at the end.
    loss: a name in `losses.LOSSES`.
    densify_every: steps between densifications, 0 for none.
    """

    name: str
    steps: int
    weights: Mapping[float, float]
    rates: Mapping[str, float]
    anchor: float = 0.0
    decay: float = 1.0
    loss: str = "l2"
    densify_every: int = 0
    seed: int = 0


OURS = Settings("consistency", 1000, WEIGHTS, RATES, anchor=ANCHOR, decay=0.03)
# 3DGS's rates worsen a scene that is nearly right, and 300 steps are too few to recover
GENTLE = {name: 0.3 * rate for name, rate in RATES.items()}
# for conversion, a few minutes; `balanced` divides its weights by the scene's errors
QUICK = replace(OURS, name="quick", steps=300, weights=dict.fromkeys(OURS.weights, 1.0), anchor=4.0, rates=GENTLE)


def balanced(settings: Settings, errors: Mapping[float, float]) -> Settings:
    """Divide the weight of every scale by the root of the mean square error found there; errors[1.0] is the anchor's.

    Undivided losses would sacrifice scales with small errors to those with large ones; losses as shares of the errors
    would leave the large ones where they are.
    """
    weights = {scale: weight / errors[scale] ** 0.5 for scale, weight in settings.weights.items()}
    return replace(settings, weights=weights, anchor=settings.anchor / errors[1.0] ** 0.5)


def consistency(scales: Sequence[float], move: Sequence[str], anchor: float) -> Settings:
    """One model for all scales and the training size."""
    weights = {scale: OURS.weights.get(scale, 1.0) for scale in scales}
    return replace(OURS, weights=weights, rates={name: RATES[name] for name in move}, anchor=anchor)


def mipmap_gs(scales: Sequence[float], move: Sequence[str] = (), anchor: float = 0.0) -> Settings:
    """Mipmap-GS (Li et al. 2024), one model for one scale: all parameters at 3DGS's rates, 1000 steps of L2.

    Its truth is a bilinear resize at the test poses; here it is the box average at the training poses.  It moves every
    parameter and has no anchor.  More than one scale raises UsageError.
    """
    if len(scales) != 1:
        raise UsageError("scale", "mipmap-gs makes one model for one scale; give one")
    return Settings("mipmap-gs", 1000, {scales[0]: 1.0}, RATES, densify_every=100)


@dataclass(frozen=True)
class Method:
    """A way to fine-tune: settings, from the scales, the parameters that move and the anchor; and the usual viewer."""

    settings: Callable[[Sequence[float], Sequence[str], float], Settings]
    viewer: Viewer


METHODS: Registry[Method] = Registry(
    "method",
    {"consistency": Method(consistency, FAST), "mipmap-gs": Method(mipmap_gs, CLASSIC_VIEWER)},
    check=lambda value: isinstance(value, Method),
)


def settings_of(
    method: Method,
    *,
    scale: Sequence[float],
    steps: int | None,
    loss: str,
    anchor: float,
    move: Sequence[str],
    learning_rate: float,
    densify_every: int | None,
    seed: int,
) -> Settings:
    """A method's settings with the user's choices; None takes the method's own.

    Raises UsageError if a name is not known, or a choice does not fit the method.
    """
    if not move or any(name not in RATES for name in move):
        raise UsageError("move", f"needs parameters out of {', '.join(RATES)}")
    if loss not in LOSSES:
        raise UsageError("loss", not_one_of(loss, LOSSES))
    own, counts = method.settings(scale, move, anchor), {"steps": steps, "densify_every": densify_every}
    given = {name: value for name, value in counts.items() if value is not None}
    rates = {name: rate * learning_rate for name, rate in own.rates.items()}
    return replace(own, rates=rates, loss=loss, seed=seed, **given)
