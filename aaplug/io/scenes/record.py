"""Facts about a scene that a format has no place for: in a record of ours where other programs keep it, or told.

The one rule of all formats: what would change the picture is refused, what was only said about it is kept, in the
format's own tag or in the record, and a warning names what reading the file again will not give.
"""

import logging
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

from jaxtyping import Float
from torch import Tensor

from aaplug.core.chunks import curve, squeezed
from aaplug.core.conventions import CLASSIC, CONVENTIONS, Convention
from aaplug.core.gaussians import Fusion, Gaussians, joined
from aaplug.io.values import Entry, Place, entries, text
from aaplug.system.errors import OutputError, counted

KEY = "aaplug"  # of the record in a JSON document
MOVED_SHARE = 0.01  # of the Gaussians: fewer, the smallest, are moved by their size in any scene

log = logging.getLogger("aaplug")


class Facts(NamedTuple):
    """A file's facts about its scene; evidence: where, for the user.  flat: see `Gaussians`."""

    evidence: str
    convention: Convention = CLASSIC
    fused: tuple[Fusion, ...] = ()
    flat: bool = False


def record_of(scene: Gaussians) -> dict[str, Any]:
    """The record of a scene, as JSON holds it."""
    fused = [{"method": fusion.method, "settings": fusion.settings} for fusion in scene.fused]
    return {"convention": scene.convention.name, **({"fused": fused} if fused else {})}


def read_record(path: Path, holder: dict[str, Any], otherwise: Facts) -> Facts:
    """The facts in a record among the keys of a JSON object, or `otherwise`; raises FormatError if it is damaged."""
    if KEY not in holder:
        return otherwise
    record = Entry(Place(path, "its object"), holder).entry(KEY)
    name = record.get("convention", text)
    record.place.expect(name in CONVENTIONS, "convention", f"one of {', '.join(CONVENTIONS)}", name)
    fused = list[Fusion]()
    for fusion in entries(path, "fusion", record.value("fused")) if "fused" in record else ():
        settings = fusion.entry("settings").fields
        pairs = {text(k, fusion.place, "a setting"): text(v, fusion.place, "a setting") for k, v in settings.items()}
        fused.append(Fusion(fusion.get("method", text), pairs))
    return Facts(f"aaplug's record in the file: {name}", CONVENTIONS[name], tuple(fused), otherwise.flat)


def holdable(path: Path, part: Gaussians, format: str, degree: int, flat: bool = False) -> Gaussians:
    """The part; raises OutputError for what the format cannot hold and would change the picture."""
    if part.flat and not flat:
        raise OutputError(path, f"a .{format} cannot hold 2D Gaussians; write a .ply")
    if part.filter_3d is not None:
        raise OutputError(path, f"a .{format} cannot hold a filter_3D; aaplug convert fuses it")
    if part.sh_degree > degree:
        degrees = f"harmonics of degree {part.sh_degree}, only up to {degree}"
        raise OutputError(path, f"a .{format} cannot hold {degrees}; write a .ply")
    return part


def whole(path: Path, parts: Iterable[Gaussians], format: str, degree: int, flat: bool = False) -> Gaussians:
    """All parts as one scene; raises OutputError as `holdable`, and if there are no Gaussians."""
    scene = joined([holdable(path, part, format, degree, flat) for part in parts])
    if not len(scene):
        raise OutputError(path, f"a .{format} cannot hold a scene without Gaussians; write a .ply")
    return scene


def along_curve(scene: Gaussians) -> Gaussians:
    """The scene along a curve that keeps neighbours together: images compress, and bounds of chunks are narrow."""
    return scene[curve(squeezed(scene.means.double())).argsort(stable=True)]


def warn_of_moves(path: Path, format: str, scene: Gaussians, moves: Float[Tensor, "n 3"]) -> None:
    """Warn where a format's steps move centres by more than their Gaussians' size, as some far away make them do.

    moves: how far rounding moves each centre, in world units.
    """
    far = int((moves.norm(dim=1) > scene.scales.amax(dim=1)).sum())
    if far > MOVED_SHARE * len(scene):
        what = f"move {far:,} of {counted(len(scene), 'Gaussian')} by more than their size"
        log.warning("%s: the steps of a .%s, as wide as the scene, %s; a .ply has none", path, format, what)


def warn_of_sizes(path: Path, format: str, scene: Gaussians, least: float, most: float) -> None:
    """Warn where Gaussians are smaller or larger than a format holds; least, most: of its log-scales."""
    sizes, ends = scene.log_scales.amax(dim=1), (math.exp(least), math.exp(most))
    odd = int(((sizes < least) | (sizes > most)).sum())
    if odd > MOVED_SHARE * len(sizes):
        what = f"{odd:,} of {counted(len(sizes), 'Gaussian')} of another size than {ends[0]:.3g} to {ends[1]:.3g} units"
        log.warning("%s: a .%s cannot hold %s; scale the scene by aaplug merge, or write a .ply", path, format, what)
