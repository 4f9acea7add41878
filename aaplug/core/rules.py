"""The rules of compositing: alpha's cap and cut-off, when a pixel stops, and the near plane.

They belong to training: a scene looks right when it is composited as it was trained.
"""

import math
import struct
from dataclasses import dataclass, field

from aaplug.system.contracts import check_fields
from aaplug.system.errors import UsageError

NEAR = 0.2  # world units of depth: nearer Gaussians are neither drawn nor counted as seen (3DGS)
MIN_CUTOFF = 1 / 500  # the compiled exp2 is a polynomial that ends at 2^-9


@dataclass(frozen=True)
class Rules:
    """The constants of compositing.  Values are rounded to float32, as renderers hold them.

    max_alpha: cap of one splat's alpha at a pixel.
    min_alpha: a smaller alpha is skipped.
    min_transmittance: a pixel stops before the splat that would bring its transmittance below this.
    near: world units; only what lies deeper is drawn.

    Raises:
        UsageError: a value is outside of its range.
    """

    # 3DGS (Kerbl et al. 2023).  In float32 (1 - 0.99)^2 is just below 1e-4, so two splats at the cap end a pixel.
    max_alpha: float = 0.99
    min_alpha: float = 1 / 255
    min_transmittance: float = 1e-4
    near: float = NEAR
    # These are computed once, because kernels are traced and must not create tensors.
    below_min_alpha: float = field(init=False, repr=False, compare=False)
    log2_min_alpha: float = field(init=False, repr=False, compare=False)
    below_min_transmittance: float = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        check_fields(self)
        alphas = MIN_CUTOFF <= self.min_alpha < self.max_alpha < 1
        if not (alphas and 0 < self.min_transmittance < 1 and self.near > 0):
            ranges = f"{MIN_CUTOFF:g} <= min_alpha < max_alpha < 1, 0 < min_transmittance < 1 and near > 0"
            raise UsageError("rules", f"expected {ranges}, got {self}")
        for name in ("max_alpha", "min_transmittance"):
            object.__setattr__(self, name, float32(getattr(self, name)))
        object.__setattr__(self, "below_min_alpha", just_below(self.min_alpha))
        object.__setattr__(self, "log2_min_alpha", float32(math.log2(float32(self.min_alpha))))
        object.__setattr__(self, "below_min_transmittance", just_below(self.min_transmittance))

    @property
    def tag(self) -> str:
        """Suffix of a compositing kernel's name, empty for 3DGS's rules: a kernel is compiled for one set of rules."""
        values, usual = ((r.max_alpha, r.min_alpha, r.min_transmittance) for r in (self, RULES_3DGS))
        return variant(values, usual)


def variant(values: tuple[float, ...], defaults: tuple[float, ...]) -> str:
    """Suffix of a kernel's name for the constants built into it; empty for the defaults."""
    return "" if values == defaults else "".join(f"-{value:.7g}" for value in values)


def just_below(value: float) -> float:
    """The float32 below a positive value: `torch.threshold` keeps what is above its bound, so also `value` itself."""
    [bits] = struct.unpack("I", struct.pack("f", value))
    [below] = struct.unpack("f", struct.pack("I", bits - 1))
    return below


def float32(value: float) -> float:
    """The float32 nearest to a value."""
    return struct.unpack("f", struct.pack("f", value))[0]


RULES_3DGS = Rules()
RULES_GSPLAT = Rules(max_alpha=0.999, near=0.01)  # gsplat until February 2026; since then its cap is 0.99
