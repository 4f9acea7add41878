"""The rules of compositing: alpha's cap and cut-off, when a pixel stops, and the near plane.

They belong to training: a scene looks right when it is composited as it was trained.
"""

import struct
from dataclasses import dataclass

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

    def __post_init__(self) -> None:
        check_fields(self)
        alphas = MIN_CUTOFF <= self.min_alpha < self.max_alpha < 1
        if not (alphas and 0 < self.min_transmittance < 1 and self.near > 0):
            ranges = f"{MIN_CUTOFF:g} <= min_alpha < max_alpha < 1, 0 < min_transmittance < 1 and near > 0"
            raise UsageError("rules", f"expected {ranges}, got {self}")
        for name in ("max_alpha", "min_transmittance"):
            object.__setattr__(self, name, float32(getattr(self, name)))


def just_below(value: float) -> float:
    """The float32 below a positive value: `cut` keeps what is above its bound, so also `value` itself."""
    [bits] = struct.unpack("I", struct.pack("f", value))
    [below] = struct.unpack("f", struct.pack("I", bits - 1))
    return below


def float32(value: float) -> float:
    """The float32 nearest to a value."""
    return struct.unpack("f", struct.pack("f", value))[0]


RULES_3DGS = Rules()
RULES_GSPLAT = Rules(max_alpha=0.999, near=0.01)  # gsplat until February 2026; since then its cap is 0.99
