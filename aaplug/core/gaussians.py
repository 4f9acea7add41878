"""The scene: 3D Gaussians exactly as their file stores them.

n: Gaussians; k: spherical-harmonics coefficients per channel, (degree + 1)².  Lengths are in world units.  Stored
values (log-scales, opacity logits, quaternions of any length) stay, so that reading and writing loses nothing.
Activated values (scales, opacities, unit quaternions) are properties.
"""

import hashlib
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor

from aaplug.core.conventions import CLASSIC, Convention
from aaplug.core.spherical_harmonics import COLOUR_OFFSET, SH_C0
from aaplug.system.contracts import check_fields, contract, described
from aaplug.system.errors import UsageError

MAX_LOG_SCALE = 30.0  # larger |ln s| overflow float32 once squared; values are clamped on use
COEFFICIENTS = (1, 4, 9, 16, 25)  # per channel, of degree 0 to 4
LEARNED_COLUMN = re.compile(r"filter_(scale|opacity)_\d+")  # name of an extra that fine-tuning learns
MIN_OPACITY = 1e-7  # keeps the logit finite in float32


@dataclass(frozen=True)
class Fusion:
    """A change that was fused into the stored scales and opacities; the file records it."""

    method: str
    settings: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_fields(self)


@dataclass(frozen=True, eq=False)
class Origin:
    """The file that a scene came from, with everything in it that is not a parameter of a Gaussian.

    document: everything that the format's writer restores (column order, unknown columns, comments).
    rows: index of each Gaussian in the document.
    """

    path: str
    format: str
    evidence: str
    document: Any = field(repr=False)
    rows: Int[Tensor, " n"]


@dataclass(frozen=True, eq=False)
class Gaussians:
    """n Gaussians and how they were trained.

    flat: 2D Gaussians (2DGS, Huang et al. 2024), discs across the third axis.  Their file has two scales; the third
        log-scale here is -MAX_LOG_SCALE, no thickness, so that renderers need no special case.
    filter_3d: standard deviation of Mip-Splatting's 3D filter, stored beside the scales and not yet fused.
    extras: further columns of the file by name, for methods that know them.

    Raises:
        UsageError: columns differ in length, precision or device, or are no tensors of these shapes; or the origin has
            another number of rows.
    """

    means: Float[Tensor, "n 3"]
    quats: Float[Tensor, "n 4"]  # wxyz, of any length but zero
    log_scales: Float[Tensor, "n 3"]
    logit_opacities: Float[Tensor, " n"]
    sh: Float[Tensor, "n k 3"]
    convention: Convention = CLASSIC
    filter_3d: Float[Tensor, " n"] | None = None
    fused: tuple[Fusion, ...] = ()
    origin: Origin | None = None
    flat: bool = False
    extras: Mapping[str, Shaped[Tensor, " n"]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_fields(self)
        if self.sh.shape[1] not in COEFFICIENTS:
            raise UsageError("sh", f"expected {COEFFICIENTS} coefficients per channel, got {self.sh.shape[1]}")
        for name, column in self.columns.items():
            if column.dtype != self.means.dtype or column.device != self.means.device:
                means = f"{self.means.dtype} on {self.means.device}, as the means are"
                raise UsageError(name, f"expected {means}, got {column.dtype} on {column.device}")
        if self.origin is not None and len(self.origin.rows) != len(self):
            rows = f"a row of the file for each of {len(self):,} Gaussians, got {len(self.origin.rows):,}"
            raise UsageError("origin", f"expected {rows} (origin=None forgets the file)")

    def __repr__(self) -> str:
        facts = (f"{name}={getattr(self, name)}" for name in ("sh_degree", "flat", "fused", "convention"))
        return f"Gaussians(count={len(self)}, name={self.name!r}, extras={[*self.extras]}, {', '.join(facts)})"

    def __len__(self) -> int:
        return self.means.shape[0]

    @property
    def name(self) -> str:
        """For messages: the file it came from, or "scene"."""
        return self.origin.path if self.origin else "scene"

    @property
    def scales(self) -> Float[Tensor, "n 3"]:
        """Standard deviations along the Gaussian's own axes."""
        return self.log_scales.clamp(-MAX_LOG_SCALE, MAX_LOG_SCALE).exp()

    @property
    def opacities(self) -> Float[Tensor, " n"]:
        """Opacity at the centre, in [0, 1]."""
        return self.logit_opacities.sigmoid()

    @property
    def base_colours(self) -> Float[Tensor, "n 3"]:
        """Colours without what depends on the view; those that training fitted may leave [0, 1]."""
        return COLOUR_OFFSET + SH_C0 * self.sh[:, 0]

    @property
    def unit_quats(self) -> Float[Tensor, "n 4"]:
        """Quaternions of length one, wxyz."""
        return torch.nn.functional.normalize(self.quats, dim=-1)

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics, 0 to 4."""
        return round(self.sh.shape[1] ** 0.5) - 1

    @contract
    def __getitem__(self, index: Tensor | slice) -> "Gaussians":
        """The Gaussians at `index` (a mask, indices or a slice), in that order."""
        rows = index.cpu() if isinstance(index, Tensor) else index  # the file's rows stay on the CPU
        try:
            origin = self.origin and replace(self.origin, rows=self.origin.rows[rows])
            columns = {name: column[index] for name, column in self.columns.items()}
            extras = {name: column[index] for name, column in self.extras.items()}
        except (IndexError, RuntimeError, TypeError, ValueError) as error:
            raise UsageError("index", f"expected places of {len(self)} Gaussians, got {described(index)}") from error
        return replace(self, **columns, extras=extras, origin=origin)

    @contract
    def to(self, dtype: torch.dtype) -> "Gaussians":
        """The same Gaussians in another precision; extras keep theirs."""
        return replace(self, **{name: column.to(dtype) for name, column in self.columns.items()})

    @property
    def columns(self) -> dict[str, Tensor]:
        """Every parameter that is present, by name."""
        return {name: value for name, value in vars(self).items() if isinstance(value, Tensor)}

    @property
    def learned(self) -> tuple[str, ...]:
        """Names of the extras that hold learned filters."""
        return tuple(name for name in self.extras if LEARNED_COLUMN.fullmatch(name))

    @property
    def tracked(self) -> bool:
        """True if a parameter takes gradients.  Projection in chunks would make each one as large as the scene."""
        return torch.is_grad_enabled() and any(column.requires_grad for column in self.columns.values())


def joined(parts: Sequence[Gaussians]) -> Gaussians:
    """The Gaussians of several parts of one scene, at least one part, each with the same columns."""
    first = parts[0]
    if len(parts) == 1:
        return first
    for part in parts:
        kinds = [(*p.columns, *p.extras, p.means.dtype, p.sh.shape[1]) for p in (first, part)]
        if kinds[0] != kinds[1]:
            raise UsageError("scenes", f"expected the same columns in each, got {kinds[0]} and {kinds[1]}")
    columns = {name: torch.cat([getattr(part, name) for part in parts]) for name in first.columns}
    extras = {name: torch.cat([part.extras[name] for part in parts]) for name in first.extras}
    rows = [part.origin.rows for part in parts if part.origin is not None]
    return replace(first, **columns, extras=extras, origin=first.origin and replace(first.origin, rows=torch.cat(rows)))


def scale_opacities(
    logit_opacities: Float[Tensor, " n"], log_factor: Float[Tensor, " n"], max_opacity: float = 1 - MIN_OPACITY
) -> Float[Tensor, " n"]:
    """Logits of o·c from the logits of o and ln c: exact for o near 0 or 1, the identity for c = 1.

    With L = ln o + ln c the logit of e^L is L - ln(1 - e^L).  For c ≠ 1 the opacity is clamped to
    [MIN_OPACITY, max_opacity].
    """
    log_opacity = torch.nn.functional.logsigmoid(logit_opacities) + log_factor
    log_opacity = log_opacity.clamp(math.log(MIN_OPACITY), math.log(max_opacity))
    logits = log_opacity - torch.log(-torch.expm1(log_opacity))
    return torch.where(log_factor == 0, logit_opacities, logits)


def digest_of_scene(scene: Gaussians) -> str:
    """Hash (SHA-256, in hex) of the Gaussians and of everything that changes their images."""
    digest = hashlib.sha256(repr((scene.convention, scene.fused, scene.flat)).encode())
    for name, column in {**scene.columns, **scene.extras}.items():
        digest.update(f"{name} {tuple(column.shape)} {column.dtype}".encode())
        digest.update(column.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()
