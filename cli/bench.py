"""aaplug bench: how fast this machine renders, stage by stage."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated

import torch
from rich.box import SIMPLE_HEAD
from rich.table import Table

from aaplug.rendering.benchmark import Figures
from aaplug.verbs import bench as verb

from .console import TERMINAL, out, print_json
from .options import CameraOptions, Flat, SceneOptions


@dataclass(frozen=True)
class Bench:
    """Time the rasterizer on synthetic scenes, or on SCENE with --cameras (its first training view)."""

    scene: SceneOptions = field(default_factory=SceneOptions)
    cameras: CameraOptions = field(default_factory=CameraOptions)
    how: Annotated[verb.BenchOptions, Flat] = field(default_factory=verb.BenchOptions)
    json: bool = False
    """Print one JSON object on stdout: the figures, or {"runs": [...]} of several."""


def bench(options: Bench) -> int:
    """Time every rasterizer on every scene."""
    scene = cameras = None
    if options.scene.scene is not None or options.scene.model_path is not None:
        scene, cameras = options.scene.read(), options.cameras.read(options.scene)
    runs, exponents = verb.bench(scene, cameras, monitor=TERMINAL, **vars(options.how))
    if options.json:
        several = {"runs": [run.as_json() for run in runs], "exponents": exponents}
        print_json(runs[0].as_json() if len(runs) == 1 else several)
        return 0
    out.print(_table(runs, options.how.threads or torch.get_num_threads()), _stages(runs))
    for name, value in exponents.items():
        out.print(f"time grows as {name}^{value:.2f}")
    return 0


def _scene(run: Figures) -> str:
    """Sizes of the scene and of the image, short."""
    for unit, mark in ((1e6, "M"), (1e3, "k")):
        if run.gaussians >= 10 * unit or run.gaussians % unit == 0:
            return f"{run.gaussians / unit:.0f}{mark} {run.width}x{run.height}"
    return f"{run.gaussians} {run.width}x{run.height}"


def _table(runs: Sequence[Figures], threads: int) -> Table:
    title = f"medians, ms; matmul is a 2048³ float32 product, {threads} threads"
    table = Table(title=title, box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    names = ("scene", "", "forward", "+ back", "matmul", "share", "Mevals", "ns/eval", "GB")
    for name in names:
        table.add_column(name, justify="right" if name else "left", no_wrap=True)
    for run in runs:
        table.add_row(
            _scene(run),
            run.rasterizer,
            f"{run.forward_ms:.0f}",
            "" if run.forward_backward_ms is None else f"{run.forward_backward_ms:.0f}",
            f"{run.matmul_ms:.0f}",
            f"{run.share:.2f}",
            f"{run.evaluations / 1e6:.0f}",
            f"{run.ns_per_evaluation:.2f}",
            f"{run.peak_bytes / 1e9:.1f}",
        )
    return table


def _stages(runs: Sequence[Figures]) -> Table:
    table = Table(title="stages, ms", box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    names = list(runs[0].stages_ms)
    for name in ("scene", "", *names):
        table.add_column(name, justify="right" if name else "left", no_wrap=True)
    for run in runs:
        stages = [f"{run.stages_ms[name]:.0f}" for name in names]
        table.add_row(_scene(run), run.rasterizer, *stages)
    return table
