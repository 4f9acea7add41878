"""How two scenes with the same number of Gaussians differ, Gaussian by Gaussian.

Some programs sort the Gaussians.  Where rows are not the same Gaussians, those are paired that are each other's nearest
neighbours (positions that a format rounded to the same place lose their partners).

n: Gaussians, m: pairs.
"""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, Int
from scipy.spatial import KDTree
from torch import Tensor

from aaplug.core.gaussians import MAX_LOG_SCALE, Gaussians

ROWS = 0.01  # of the scene's size: the median distance within which rows are the same Gaussians


@dataclass(frozen=True)
class Change:
    """Absolute differences of one quantity over the pairs: root mean square, median and largest."""

    rms: float
    median: float
    largest: float

    @classmethod
    def of(cls, values: Float[Tensor, "*m"]) -> "Change":
        """Of differences, or of their lengths; 0 of none."""
        if not values.numel():
            return cls(0.0, 0.0, 0.0)
        sizes = values.double().abs().flatten()
        return cls(float(sizes.square().mean().sqrt()), float(sizes.median()), float(sizes.max()))


@dataclass(frozen=True)
class Differences:
    """What changed.

    paired: share of the Gaussians that have a partner.  sorted: whether the order changed.
    positions: world units.  scales: of ln σ, axis by axis from the thinnest.  opacities: of values in [0, 1].
    harmonics: of the coefficients, by degree; what one of the scenes does not have counts as 0.
    """

    paired: float
    sorted: bool
    positions: Change
    scales: Change
    opacities: Change
    harmonics: tuple[Change, ...]

    @property
    def named(self) -> dict[str, Change]:
        """By what they are of."""
        degrees = {f"SH {degree}": change for degree, change in enumerate(self.harmonics)}
        return {"positions": self.positions, "scales": self.scales, "opacities": self.opacities, **degrees}

    def as_json(self) -> dict[str, Any]:
        """JSON-ready."""
        return {"paired": self.paired, "sorted": self.sorted} | {k: vars(v) for k, v in self.named.items()}


def differences(reference: Gaussians, other: Gaussians) -> Differences | None:
    """How the other scene differs from the reference; None where their counts do or there is no Gaussian."""
    if len(reference) != len(other) or not len(reference):
        return None
    rows = _same_rows(reference, other)
    first, second = (reference, other) if rows else _paired(reference, other)
    a, b = (scene.log_scales.clamp(-MAX_LOG_SCALE, MAX_LOG_SCALE).sort(dim=1).values for scene in (first, second))
    most = max(first.sh.shape[1], second.sh.shape[1])
    change = _padded(first.sh, most) - _padded(second.sh, most)
    degrees = [change[:, d * d : (d + 1) ** 2] for d in range(round(most**0.5))]
    return Differences(
        paired=len(first) / len(reference),
        sorted=not rows,
        positions=Change.of((first.means.double() - second.means.double()).norm(dim=1)),
        scales=Change.of(a.double() - b.double()),
        opacities=Change.of(first.opacities.double() - second.opacities.double()),
        harmonics=tuple(Change.of(degree) for degree in degrees),
    )


def _same_rows(reference: Gaussians, other: Gaussians) -> bool:
    away = (reference.means.double() - reference.means.double().median(dim=0).values).norm(dim=1)
    moved = (reference.means.double() - other.means.double()).norm(dim=1)
    return float(moved.median()) <= ROWS * float(away.median())


def _paired(reference: Gaussians, other: Gaussians) -> tuple[Gaussians, Gaussians]:
    """The Gaussians that are each other's nearest, in the reference's order."""
    there, back = _nearest(reference, other), _nearest(other, reference)
    mutual = (back[there] == torch.arange(len(reference))).nonzero()[:, 0]
    return reference[mutual], other[there[mutual]]


def _nearest(scene: Gaussians, among: Gaussians) -> Int[Tensor, " n"]:
    """Row of the nearest of the others, for each Gaussian."""
    tree = KDTree(among.means.detach().double().numpy())
    return torch.from_numpy(tree.query(scene.means.detach().double().numpy())[1]).long()


def _padded(sh: Float[Tensor, "m k 3"], coefficients: int) -> Float[Tensor, "m c 3"]:
    return torch.nn.functional.pad(sh, (0, 0, 0, coefficients - sh.shape[1]))
