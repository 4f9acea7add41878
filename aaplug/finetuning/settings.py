"""How to fine-tune: ours and Mipmap-GS's."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

from aaplug.finetuning.parameters import RATES

MIPMAP_STEPS = 1000
MIPMAP_EVERY = 100  # steps between densifications


@dataclass(frozen=True)
class Settings:
    """Everything that a run depends on beside its scene and cameras.

    weights: of the loss, by scale against training's size; each step draws one of the scales.
    anchor: weight of the training size's loss, which is added to every step.
    rates: learning rate by leaf; a leaf without one stays.  decay: share of them that is left at the end.
    loss: a name of `losses.LOSSES`.
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


OURS = Settings(
    "consistency",
    1000,
    {0.5: 1.0, 0.25: 2.0, 0.125: 1.0},  # these, and that all parameters move, were measured
    RATES,
    anchor=3.0,
    decay=0.03,
)
GENTLE = (
    0.3  # of the rates: 3DGS's own shake a scene that is nearly right, and 300 steps do not calm it
)
QUICK = replace(  # a conversion's: a few minutes; its weights are against the original's own errors
    OURS,
    name="quick",
    steps=300,
    weights={0.5: 1.0, 0.25: 1.0, 0.125: 1.0},
    anchor=4.0,
    rates={name: GENTLE * rate for name, rate in RATES.items()},
)


def balanced(settings: Settings, errors: Mapping[float, float]) -> Settings:
    """The same with every scale's loss over the root of a mean square error found there, the training size's (1.0) too.

    Half way between errors as they are, where scales with little wrong would pay for those with much, and shares of
    errors, where those would gain nothing.
    """
    weights = {scale: weight / errors[scale] ** 0.5 for scale, weight in settings.weights.items()}
    return replace(settings, weights=weights, anchor=settings.anchor / errors[1.0] ** 0.5)


def mipmap_gs(scale: float) -> Settings:
    """Mipmap-GS (Li et al. 2024), one model for one scale: all parameters at 3DGS's rates, 1000 steps of L2.

    Its truth is a bilinear resize, of the poses to be tested; here it is the box average, of the training poses.
    """
    weights = {scale: 1.0}
    return Settings("mipmap-gs", MIPMAP_STEPS, weights, RATES, densify_every=MIPMAP_EVERY)
