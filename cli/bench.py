"""aaplug bench: how fast this machine renders, stage by stage."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Annotated

from rich.box import SIMPLE_HEAD
from rich.table import Table

import aaplug
from aaplug.options.bench import BenchOptions

from .console import TERMINAL, out, print_json
from .options import CameraOptions, Flat, SceneOptions, read_inputs

if TYPE_CHECKING:
    from aaplug.rendering.benchmark import Figures


@dataclass(frozen=True)
class Bench:
    """Time the rasterizer on synthetic scenes, or on SCENE with --cameras (its first training view)."""

    scene: SceneOptions = field(default_factory=SceneOptions)
    cameras: CameraOptions = field(default_factory=CameraOptions)
    how: Annotated[BenchOptions, Flat] = field(default_factory=BenchOptions)
    json: bool = False
    """Print one JSON object on stdout: the figures, or {"runs": [...]} of several."""

    def __call__(self) -> int:
        """Time every rasterizer on every scene."""
        scene = cameras = None
        if self.scene.scene is not None or self.scene.model_path is not None:
            scene, cameras = read_inputs(self.scene, self.cameras)
        runs, exponents = aaplug.bench(scene, cameras, monitor=TERMINAL, **vars(self.how))
        if self.json:
            several = {"runs": [run.as_json() for run in runs], "exponents": exponents}
            print_json(runs[0].as_json() if len(runs) == 1 else several)
            return 0
        import torch

        threads = self.how.threads or torch.get_num_threads()
        figures = _table(f"medians, ms; matmul is a 2048³ float32 product, {threads} threads", FIGURES, runs)
        stages = {name: partial(_stage, name) for name in runs[0].stages_ms}
        out.print(figures, _table("stages, ms", stages, runs))
        for name, value in exponents.items():
            out.print(f"time grows as {name}^{value:.2f}")
        return 0


def _scene(run: "Figures") -> str:
    """Sizes of the scene and of the image, short."""
    for unit, mark in ((1e6, "M"), (1e3, "k")):
        if run.gaussians >= 10 * unit or run.gaussians % unit == 0:
            return f"{run.gaussians / unit:.0f}{mark} {run.width}x{run.height}"
    return f"{run.gaussians} {run.width}x{run.height}"


def _stage(name: str, run: "Figures") -> str:
    return f"{run.stages_ms[name]:.0f}"


Columns = Mapping[str, Callable[["Figures"], str]]
FIGURES: Columns = {
    "forward": lambda run: f"{run.forward_ms:.0f}",
    "+ back": lambda run: "" if run.forward_backward_ms is None else f"{run.forward_backward_ms:.0f}",
    "matmul": lambda run: f"{run.matmul_ms:.0f}",
    "share": lambda run: f"{run.share:.2f}",
    "Mevals": lambda run: f"{run.evaluations / 1e6:.0f}",
    "ns/eval": lambda run: f"{run.ns_per_evaluation:.2f}",
    "GB": lambda run: f"{run.peak_bytes / 1e9:.1f}",
}


def _table(title: str, columns: Columns, runs: Sequence["Figures"]) -> Table:
    table = Table(title=title, box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for name in ("scene", "", *columns):
        table.add_column(name, justify="right" if name else "left", no_wrap=True)
    for run in runs:
        table.add_row(_scene(run), run.rasterizer, *(text(run) for text in columns.values()))
    return table
