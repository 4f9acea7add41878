"""aaplug info: what a scene is."""

from dataclasses import dataclass, field
from typing import Any

import torch
from rich.markup import escape
from rich.table import Table

from aaplug.conversion import describe
from aaplug.gaussians import Gaussians
from aaplug.interfaces import Training
from aaplug.nyquist import coverage

from .console import out, print_json
from .options import CameraOptions, SceneOptions


@dataclass(frozen=True)
class Info:
    """What a scene is: its convention and why, what was fused, and with cameras how finely they sample it."""

    scene: SceneOptions = field(default_factory=SceneOptions)
    cameras: CameraOptions = field(default_factory=CameraOptions)
    json: bool = False
    """One JSON object on stdout instead of a table."""


def info(options: Info) -> int:
    """Show what a scene is."""
    scene = options.scene.read()
    facts = _scene_facts(scene)
    if options.cameras.cameras is not None:
        cameras = options.cameras.read(options.scene)
        facts |= _sampling_facts(scene, options.cameras.learn(scene, cameras))
        facts["cameras"] = list(cameras.notes)
    if options.json:
        print_json(facts)
    else:
        _print(facts)
    return 0


def _scene_facts(scene: Gaussians) -> dict[str, Any]:
    assert scene.origin is not None
    low, high = scene.means.aminmax(dim=0) if len(scene) else (scene.means.new_zeros(3),) * 2
    return {
        "file": scene.origin.path,
        "format": scene.origin.format,
        "gaussians": len(scene),
        "sh_degree": scene.sh_degree,
        "convention": scene.convention.name,
        "evidence": scene.origin.evidence,
        "kernel_px2": scene.convention.kernel,
        "compensated": scene.convention.compensated,
        "stored_filter_3d": scene.filter_3d is not None,
        "fused": [{"method": f.method, **f.settings} for f in scene.fused],
        "fused_text": "; ".join(describe(f) for f in scene.fused) or "nothing",
        "low_corner": low.tolist(),
        "high_corner": high.tolist(),
        "median_opacity": _median(scene.opacities),
        "median_scale": _median(scene.scales.median(dim=1).values) if len(scene) else None,
    }


def _sampling_facts(scene: Gaussians, training: Training) -> dict[str, Any]:
    bounds, found = training.bounds, coverage(scene, training, ())
    return {
        "training_cameras": len(training.cameras),
        "seen_share": bounds.seen.double().mean().item(),
        "median_rate_px_per_unit": _median(bounds.highest[bounds.seen]),
        "under_sampling_bound_share": found.under,
        "aliasing_begins_at_scale": found.begins,
    }


def _median(values: torch.Tensor) -> float | None:
    return values.median().item() if len(values) else None


def _print(facts: dict[str, Any]) -> None:
    table = Table(show_header=False, box=None, pad_edge=False)
    for key, value in facts.items():
        if key == "fused":
            continue
        value = facts["fused_text"] if key == "fused_text" else value
        name = key.removesuffix("_text").replace("_px2", " (px²)").replace("_", " ")
        table.add_row(f"[dim]{name}[/]", escape(_text(value)))
    out.print(table)


def _text(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list):
        lines = any(isinstance(item, str) for item in value)
        return ("\n" if lines else "  ").join(_text(item) for item in value)
    return f"{value:,}" if isinstance(value, int) else str(value)
