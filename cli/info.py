"""aaplug info: what a scene is."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from rich.markup import escape
from rich.table import Table

from aaplug.core.cameras import CameraSet
from aaplug.core.gaussians import MAX_LOG_SCALE
from aaplug.inspection.coverage import aliasing_begins
from aaplug.io.limits import LIMITS, limit, memory_of_machine
from aaplug.io.scenes.ply import Document
from aaplug.io.scenes.scene_file import SceneFile
from aaplug.methods.viewers import describe
from aaplug.verbs.in_parts import Survey, check_frame_of, survey

from .console import out, print_json, progress
from .options import CameraOptions, SceneOptions
from .render import MAX_SIDE

HIDDEN = ("fused", "comments")  # keys for programs; the table has words for the first
EXPONENTIATED = 20.0  # log-scales above this are taken for scales
FEW_STEPS = 1e4  # float32 steps across the scene's extent: fewer, and positions are coarse
ULP = 2.0**-23  # of float32, relative


@dataclass(frozen=True)
class Info:
    """What a scene is: its convention and why, what was fused, and with cameras how finely they sample it."""

    scene: SceneOptions = field(default_factory=SceneOptions)
    cameras: CameraOptions = field(default_factory=CameraOptions)
    limits: bool = False
    """Show every limit on files instead, and the environment variable that changes it."""
    json: bool = False
    """One JSON object on stdout instead of a table."""


def info(options: Info) -> int:
    """Show what a scene is."""
    if options.limits:
        return _show_limits(options.json)
    opened = options.scene.open()
    cameras = None
    if options.cameras.cameras is not None:
        cameras = options.cameras.read(options.scene)
        check_frame_of(opened, cameras.train, options.cameras.min_seen)
    with progress("reading", "Gaussians") as tell:
        found = survey(opened, cameras.train if cameras else (), tell)
    facts = _scene_facts(opened, found)
    if cameras:
        facts |= _sampling_facts(found, cameras, opened.convention.kernel)
    facts["problems"] = list(_problems(opened, found))
    if options.json:
        print_json(facts)
    else:
        _print(facts)
    return 0


def _scene_facts(opened: SceneFile, found: Survey) -> dict[str, Any]:
    scale = found.scales.quantile(0.5)
    return {
        "file": str(opened.path),
        "format": opened.format,
        "bytes": opened.path.stat().st_size,
        "gaussians": opened.count,
        "unusable_gaussians": opened.count - found.count,
        "sh_degree": opened.sh_degree,
        "convention": opened.convention.name,
        "evidence": opened.evidence,
        "kernel_px2": opened.convention.kernel,
        "compensated": opened.convention.compensated,
        "two_dimensional": opened.flat,
        "stored_filter_3d": found.filtered,
        "fused": [{"method": f.method, **f.settings} for f in opened.fused],
        "fused_text": "; ".join(describe(f) for f in opened.fused) or "nothing",
        "notes": list(opened.notes),
        "comments": _comments(opened),
        "low_corner": found.low.tolist() if found.count else None,
        "high_corner": found.high.tolist() if found.count else None,
        "median_opacity": found.opacities.quantile(0.5),
        "median_scale": None if scale is None else math.exp(scale),
    }


def _comments(opened: SceneFile) -> list[str]:
    document = opened.document
    return document.header.comments if isinstance(document, Document) else []


def _sampling_facts(found: Survey, cameras: CameraSet, kernel: float) -> dict[str, Any]:
    rate, multiple = found.rates.quantile(0.5), found.multiples.quantile(0.5)
    return {
        "training_cameras": len(cameras.train),
        "seen_share": found.seen / max(1, found.count),
        "median_rate_px_per_unit": None if rate is None else math.exp(rate),
        "under_sampling_bound_share": found.under / max(1, found.seen),
        "aliasing_begins_at_scale": None
        if multiple is None
        else aliasing_begins(math.exp(multiple), kernel),
        "cameras": list(cameras.notes),
    }


def _problems(opened: SceneFile, found: Survey) -> Iterator[str]:
    """What is odd about the scene, each with what to do."""
    for text, number in found.faults.items():
        yield f"{number:,} Gaussians with {text}: --drop-bad leaves them out"
    if not opened.count:
        yield "the scene is empty: is it the right file?"
    if not found.count:
        return
    if found.largest > EXPONENTIATED or found.above_zero == found.count:
        yield "scales look already exponentiated (they should be logarithms): export the scene again"
    elif found.activated == found.count:
        yield "opacities all lie in [0, 1] as if activated (they should be logits): export the scene again"
    if found.filtered:
        yield "its filter_3D is not fused, and viewers do not know it: aaplug convert fuses it"
    if opened.flat:
        yield "2D Gaussians: drawn by 3DGS's rule here, and not converted; 2DGS's own renderer differs"
    reach = max(found.low.abs().max().item(), found.high.abs().max().item())
    extent = (found.high - found.low).max().item()
    if 0 < extent < FEW_STEPS * ULP * reach:
        yield f"lies {reach:.3g} from the origin, where float32 steps are coarse: move it to the origin before training"
    modes = [c for c in _comments(opened) if c.lower().startswith("splatrendermode")]
    if len({mode.lower() for mode in modes}) > 1:
        yield f"its comments contradict each other ({'; '.join(modes)}): the last one counts, --convention overrules"


def _print(facts: dict[str, Any]) -> None:
    table = Table(show_header=False, box=None, pad_edge=False)
    for key, value in facts.items():
        if key in HIDDEN or value == []:
            continue
        name = key.removesuffix("_text").replace("_px2", " (px²)").replace("_", " ")
        table.add_row(f"[dim]{name}[/]", escape(_text(value)))
    out.print(table)


def _text(value: Any) -> str:
    if value is None:
        return "unknown"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list):
        lines = any(isinstance(item, str) for item in value)
        return ("\n" if lines else "  ").join(_text(item) for item in value)
    return f"{value:,}" if isinstance(value, int) else str(value)


def _show_limits(as_json: bool) -> int:
    values = {name: limit(name) for name in LIMITS}
    fixed = {
        "LOG_SCALE": (MAX_LOG_SCALE, "", "a log-scale's size, clamped on use"),
        "RENDER_SIDE": (MAX_SIDE, "px", "a side of a rendered image"),
    }
    if as_json:
        print_json(values | {name: value for name, (value, *_) in fixed.items()})
        return 0
    table = Table("limit", "value", "unit", "of", "set by", box=None, pad_edge=False)
    for name, value in values.items():
        row = LIMITS[name]
        table.add_row(name, f"{value:,}", row.unit, row.what, f"AAPLUG_{name}")
    for name, (value, unit, what) in fixed.items():
        table.add_row(name, f"{value:,}", unit, what, "fixed")
    out.print(table)
    memory = memory_of_machine()
    if memory is not None:
        out.print(f"This machine has {memory / 1e9:.1f} GB of memory.")
    return 0
