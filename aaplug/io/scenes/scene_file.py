"""A scene on disk, whatever its format: what the file says, and its Gaussians whole or part by part.

A format decodes rows; this module checks their values, names those that no renderer can use, and joins parts.  Rows
are counted from 0.  Nothing of the size of the scene is held unless the whole is asked for.
"""

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from aaplug.core.errors import AaplugError, FormatError, listing
from aaplug.core.gaussians import (
    CLASSIC,
    MAX_LOG_SCALE,
    MIN_OPACITY,
    Convention,
    Fusion,
    Gaussians,
    Origin,
)
from aaplug.io.limits import limit, memory_of_machine, whole_limit

SHORTEST_QUATERNION = 1e-12  # below this torch's `normalize` gives no unit quaternion
PART = 1 << 16  # Gaussians read at once: 15 MB of degree 3
C0 = 0.28209479177387814  # 1/(2√π): the harmonic of degree 0
FLOAT = 4  # bytes
MAX_REASON = 200  # letters of a library's message
FILTER_COLUMN = "filter_3D"  # Mip-Splatting's smoothing, a standard deviation in world units

log = logging.getLogger("aaplug")


@dataclass(frozen=True)
class Fault:
    """Rows of a column that no renderer can use."""

    text: str
    rows: Bool[Tensor, " n"]


@dataclass(frozen=True)
class SceneFile:
    """An opened scene.

    load: the rows from start up to stop, exactly as stored, without convention or origin.
    document: what the format's writer needs to give everything back.
    flat: see `Gaussians`.  notes: what a user should know of how the file was understood, a line each.
    """

    path: Path
    format: str
    count: int
    sh_degree: int
    load: Callable[[int, int], Gaussians]
    evidence: str
    convention: Convention = CLASSIC
    fused: tuple[Fusion, ...] = ()
    flat: bool = False
    document: Any = None
    notes: tuple[str, ...] = field(default=())

    def stated(self, convention: Convention | None) -> "SceneFile":
        """The same file, of the convention that the user states, if any."""
        if convention is None:
            return self
        return replace(self, convention=convention, evidence="given by --convention")

    def raw(self, start: int, stop: int) -> Gaussians:
        """Rows with all that the file says of them, their values not yet checked."""
        origin = Origin(
            str(self.path), self.format, self.evidence, self.document, torch.arange(start, stop)
        )
        with library_errors(self.path):
            rows = self.load(start, stop)
        return replace(
            rows,
            convention=self.convention,
            fused=self.fused,
            flat=self.flat,
            origin=origin,
        )

    def parts(
        self, drop_bad: bool = False, size: int = PART, found: dict[str, int] | None = None
    ) -> Iterator[Gaussians]:
        """The scene part by part, at least one, checked.

        found: to be given what was wrong with rows left out, and how many they are, instead of the log.

        Raises:
            FormatError: a row cannot be used and not `drop_bad`, or the file cannot be read.
        """
        dropped: dict[str, int] = {} if found is None else found
        left_out = 0
        for start in range(0, max(self.count, 1), size):
            part = self.raw(start, min(start + size, self.count))
            bad = _check(part, self.path, drop_bad, dropped)
            left_out += 0 if bad is None else int(bad.sum())
            yield part if bad is None else part[~bad]
        if left_out and found is None:
            counts = listing([f"{text}: {number:,}" for text, number in dropped.items()])
            log.warning("%s: left out %d of %d Gaussians (%s)", self.path, left_out, self.count, counts)  # fmt: skip

    def whole(self, drop_bad: bool = False) -> Gaussians:
        """The whole scene.

        Raises:
            FormatError: it cannot be used, or would take more than its share of the machine's memory.
        """
        self._check_memory()
        (scene,) = self.parts(drop_bad, max(1, self.count))
        return scene

    def _check_memory(self) -> None:
        needed = self.count * FLOAT * (11 + 3 * (self.sh_degree + 1) ** 2)
        memory, share = memory_of_machine(), limit("MEMORY_SHARE")
        if memory is not None and needed > share * memory:
            raise FormatError(
                self.path,
                f"its {self.count:,} Gaussians take {needed / 1e9:.1f} GB, more than {share:.0%} of this machine's "
                f"{memory / 1e9:.0f} GB; info and convert read it in parts, AAPLUG_MEMORY_SHARE=1 allows all",
            )


@contextmanager
def library_errors(path: Path) -> Iterator[None]:
    """Whatever a library raises over a damaged file, in one line for the user."""
    try:
        with np.errstate(all="ignore"):  # numbers that are none are found and counted later
            yield
    except AaplugError:
        raise
    except MemoryError as error:
        raise FormatError(path, "does not fit into memory") from error
    except OSError as error:
        raise FormatError(
            path, f"cannot be read: {(error.strerror or str(error)).lower()}"
        ) from error
    except Exception as error:  # plyfile, numpy, zlib, zipfile, Pillow and torch raise all kinds
        reason = " ".join(str(error).split())[:MAX_REASON]
        raise FormatError(path, f"is damaged and cannot be read: {reason}") from error


def check_count(path: Path, count: int) -> None:
    """Refuse a scene of more Gaussians than the limit.

    Raises:
        FormatError: it has more.
    """
    most = whole_limit("GAUSSIANS")
    if count > most:
        raise FormatError(
            path, f"holds {count:,} Gaussians and the limit is {most:,}; AAPLUG_GAUSSIANS raises it"
        )


def empty(n: int, degree: int, filtered: bool = False, flat: bool = False) -> Gaussians:
    """Room for n Gaussians, to be filled; flat ones have no thickness."""
    return Gaussians(
        means=torch.empty(n, 3),
        quats=torch.empty(n, 4),
        log_scales=torch.full((n, 3), -MAX_LOG_SCALE),
        logit_opacities=torch.empty(n),
        sh=torch.empty(n, (degree + 1) ** 2, 3),
        filter_3d=torch.empty(n) if filtered else None,
        flat=flat,
    )


def columns(scene: Gaussians) -> dict[str, Float[Tensor, " n"]]:
    """A view of each parameter under its name in a .ply: the one place that knows that layout.

    f_rest is channel-major: f_rest_(c·(k − 1) + j) is coefficient 1 + j of channel c.  A flat scene has two scales.
    """
    k = scene.sh.shape[1]
    named = {axis: scene.means[:, i] for i, axis in enumerate("xyz")}
    named |= {f"f_dc_{c}": scene.sh[:, 0, c] for c in range(3)}
    named |= {
        f"f_rest_{c * (k - 1) + j}": scene.sh[:, 1 + j, c] for c in range(3) for j in range(k - 1)
    }
    named |= {"opacity": scene.logit_opacities}
    named |= {f"scale_{i}": scene.log_scales[:, i] for i in range(2 if scene.flat else 3)}
    named |= {f"rot_{i}": scene.quats[:, i] for i in range(4)}
    return named if scene.filter_3d is None else named | {FILTER_COLUMN: scene.filter_3d}


def matrix_of(scene: Gaussians) -> tuple[list[str], Float[Tensor, "n p"]]:
    """The same as `columns`, names and values side by side in one matrix, which is faster to take apart."""
    rest = scene.sh[:, 1:].transpose(1, 2).flatten(1)
    scales = scene.log_scales[:, : 2 if scene.flat else 3]
    parts = [scene.means, scene.sh[:, 0], rest, scene.logit_opacities[:, None], scales, scene.quats]
    if scene.filter_3d is not None:
        parts.append(scene.filter_3d[:, None])
    return list(columns(scene[:0])), torch.cat(parts, dim=1)


def scene_of(
    names: Sequence[str], values: Float[Tensor, "n c"], degree: int, flat: bool
) -> Gaussians:
    """The inverse: the scene in a matrix that has at least a scene's columns, in any order."""
    at = {name: i for i, name in enumerate(names)}
    k = (degree + 1) ** 2

    def chosen(*wanted: str) -> Tensor:
        return values.index_select(1, torch.tensor([at[name] for name in wanted]))

    rest = [f"f_rest_{c * (k - 1) + j}" for j in range(k - 1) for c in range(3)]
    scales = chosen(*(f"scale_{i}" for i in range(2 if flat else 3)))
    if flat:
        scales = torch.nn.functional.pad(scales, (0, 1), value=-MAX_LOG_SCALE)
    return Gaussians(
        means=chosen("x", "y", "z"),
        quats=chosen(*(f"rot_{i}" for i in range(4))),
        log_scales=scales,
        logit_opacities=chosen("opacity")[:, 0],
        sh=chosen(*(f"f_dc_{c}" for c in range(3)), *rest).reshape(-1, k, 3),
        filter_3d=chosen(FILTER_COLUMN)[:, 0] if FILTER_COLUMN in at else None,
        flat=flat,
    )


def logit_of(opacity: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
    """Logits of stored opacities, finite where they are 0 or 1."""
    return opacity.clamp(MIN_OPACITY, 1 - MIN_OPACITY).logit()


def sh_of_colour(rgb: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
    """Coefficients of degree 0 from colours in [0, 1]."""
    return (rgb - 0.5) / C0


def faults_of(scene: Gaussians) -> list[Fault]:
    """What no renderer can use: NaN, infinities, quaternions without a direction, negative filters.

    A log-scale of -inf (no thickness) and a logit of +inf (opaque) have a meaning and are none.
    """
    faults = []
    suspects = {} if _finite(scene) else columns(scene)
    for name, values in suspects.items():
        if bool(values.isfinite().all()):
            continue
        allowed = {"opacity": torch.inf, "scale": -torch.inf}.get(name.split("_")[0])
        infinite = values.isinf() if allowed is None else values.isinf() & (values != allowed)
        faults.append(Fault(f"NaN in {name}", values.isnan()))
        faults.append(Fault(f"Inf in {name}", infinite))
    faults.sort(key=lambda fault: fault.text.startswith("Inf"))
    length = torch.linalg.vector_norm(scene.quats, dim=-1)
    finite = scene.quats.isfinite().all(dim=-1)
    faults.append(Fault("a quaternion of length zero", length <= SHORTEST_QUATERNION))
    faults.append(Fault("a quaternion too long for float32", length.isinf() & finite))
    if scene.filter_3d is not None:
        faults.append(Fault(f"a negative {FILTER_COLUMN}", scene.filter_3d < 0))
    return [fault for fault in faults if fault.rows.any()]


def _finite(scene: Gaussians) -> bool:
    fields = (scene.means, scene.quats, scene.log_scales, scene.logit_opacities, scene.sh)
    values = fields if scene.filter_3d is None else (*fields, scene.filter_3d)
    return all(bool(v.sum().isfinite()) or bool(v.isfinite().all()) for v in values)


def _check(
    part: Gaussians, path: Path, drop_bad: bool, dropped: dict[str, int]
) -> Bool[Tensor, " n"] | None:
    """Unusable rows, if there are any; counts them by what is wrong."""
    faults = faults_of(part)
    if not faults:
        return None
    assert part.origin is not None
    if not drop_bad:
        what = listing([_described(fault, part.origin.rows) for fault in faults])
        raise FormatError(path, f"{what}; pass --drop-bad to leave such rows out")
    for fault in faults:
        dropped[fault.text] = dropped.get(fault.text, 0) + int(fault.rows.sum())
    return torch.stack([fault.rows for fault in faults]).any(dim=0)


def _described(fault: Fault, rows: Tensor) -> str:
    bad = rows[fault.rows]
    more = f" (and {len(bad) - 1} more)" if len(bad) > 1 else ""
    return f"row {int(bad[0])}{more} has {fault.text}"
