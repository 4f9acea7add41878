"""aaplug bench: how fast this machine renders, stage by stage."""

import re
from dataclasses import dataclass, field
from typing import Annotated, Literal

import torch
import tyro
from rich.box import SIMPLE_HEAD
from rich.table import Table

from aaplug.core.cameras import Camera
from aaplug.core.errors import UsageError
from aaplug.core.gaussians import Gaussians
from aaplug.rasterizers import Tiled
from aaplug.rasterizers.tiled.ahead_of_time import choose, load
from aaplug.rendering.benchmark import Figures, exponent, measure, synthetic_camera, synthetic_scene

from .console import out, print_json, say
from .options import CameraOptions, SceneOptions, flag

SIZES = ("800x800", "1600x1060")  # of images


@dataclass(frozen=True)
class Bench:
    """Time the rasterizer on synthetic scenes, or on SCENE with --cameras (its first training view)."""

    scene: SceneOptions = field(default_factory=SceneOptions)
    cameras: CameraOptions = field(default_factory=CameraOptions)
    gaussians: Annotated[tuple[int, ...], tyro.conf.arg(metavar="N ...")] = (
        10_000,
        100_000,
        1_000_000,
    )
    """Sizes of the synthetic scenes."""
    resolution: Annotated[tuple[str, ...] | None, flag("WxH ...")] = None
    """Sizes of the synthetic scenes' image: all scenes are timed at the first, the middle one at every (default:
    800x800, and 1600x1060 where there are several scenes)."""
    rasterizer: Literal["all", "compiled", "eager"] = "all"
    """Which to time; all is compiled, if `aaplug warmup` has run, and eager."""
    repeats: int = 5
    """Runs that each median is of."""
    threads: Annotated[int | None, flag("N")] = None
    """Processor threads (default: all)."""
    forward_only: bool = False
    """Leave out the backward pass."""
    json: bool = False
    """Print one JSON object on stdout: the figures, or {"runs": [...]} of several."""


def bench(options: Bench) -> int:
    """Time every rasterizer on every scene."""
    if options.threads is not None:
        torch.set_num_threads(max(1, options.threads))
    rasterizers = _rasterizers(options.rasterizer)
    runs: list[Figures] = []
    for scene, camera in _work(options):
        for rasterizer in rasterizers:
            run = measure(scene, camera, rasterizer, options.repeats, not options.forward_only)
            say(
                f"{run.gaussians:,} Gaussians, {run.width}x{run.height}, {run.rasterizer}: {run.forward_ms:.0f} ms"
            )
            runs.append(run)
    exponents = _exponents(runs)
    if options.json:
        several = {"runs": [run.as_json() for run in runs], "exponents": exponents}
        print_json(runs[0].as_json() if len(runs) == 1 else several)
        return 0
    out.print(_table(runs))
    out.print(_stages(runs))
    for name, value in exponents.items():
        out.print(f"time grows as {name}^{value:.2f}")
    return 0


def _rasterizers(name: str) -> list[Tiled]:
    if name == "eager":
        return [Tiled()]
    if name == "compiled":
        chosen = choose(name, 1, say)
        assert isinstance(chosen, Tiled)
        return [chosen]
    compiled = load()
    if compiled is None:
        say("rasterizer: eager alone; `aaplug warmup` compiles the fast one")
    return [*([Tiled(compiled)] if compiled else []), Tiled()]


def _work(options: Bench) -> list[tuple[Gaussians, Camera]]:
    if options.repeats < 1:
        raise UsageError("--repeats", f"must be 1 or more, got {options.repeats}")
    if options.scene.scene is not None or options.scene.model_path is not None:
        scene = options.scene.read()
        return [(scene, options.cameras.read(options.scene).train[0])]
    several = len(options.gaussians) > 1
    given = options.resolution or (SIZES if several else SIZES[:1])
    sizes = [re.fullmatch(r"(\d+)x(\d+)", text) for text in given]
    if not all(sizes) or min(options.gaussians, default=0) < 1:
        raise UsageError("bench", "--gaussians takes numbers, --resolution sizes such as 800x800")
    first, *others = [synthetic_camera(int(size[1]), int(size[2])) for size in sizes if size]
    scenes = [synthetic_scene(n) for n in options.gaussians]
    middle = scenes[len(scenes) // 2]
    return [*((scene, first) for scene in scenes), *((middle, camera) for camera in others)]


def _exponents(runs: list[Figures]) -> dict[str, float]:
    """How forward time grows with Gaussians at one size, and with pixels for one scene."""
    found: dict[str, float] = {}
    for name in dict.fromkeys(run.rasterizer for run in runs):
        own = [run for run in runs if run.rasterizer == name]
        first, last = own[0], own[-1]
        same_size = [r for r in own if (r.width, r.height) == (first.width, first.height)]
        same_scene = [r for r in own if r.gaussians == last.gaussians]
        if len(same_size) > 1:
            counts = [float(r.gaussians) for r in same_size]
            found[f"{name}: Gaussians"] = exponent(counts, [r.forward_ms for r in same_size])
        if len(same_scene) > 1:
            pixels = [float(r.width * r.height) for r in same_scene]
            found[f"{name}: pixels"] = exponent(pixels, [r.forward_ms for r in same_scene])
    return found


def _scene(run: Figures) -> str:
    """Size of the scene and of the image, in little room."""
    for unit, mark in ((1e6, "M"), (1e3, "k")):
        if run.gaussians >= 10 * unit or run.gaussians % unit == 0:
            return f"{run.gaussians / unit:.0f}{mark} {run.width}x{run.height}"
    return f"{run.gaussians} {run.width}x{run.height}"


def _table(runs: list[Figures]) -> Table:
    threads = torch.get_num_threads()
    title = f"medians, ms; matmul is a 2048³ float32 product, {threads} threads"
    table = Table(title=title, box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    names = ("scene", "", "forward", "+ back", "matmul", "share", "Mpairs", "ns/pair", "GB")
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
            f"{run.pairs / 1e6:.0f}",
            f"{run.ns_per_pair:.2f}",
            f"{run.peak_bytes / 1e9:.1f}",
        )
    return table


def _stages(runs: list[Figures]) -> Table:
    table = Table(title="stages, ms", box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    names = list(runs[0].stages_ms)
    for name in ("scene", "", *names):
        table.add_column(name, justify="right" if name else "left", no_wrap=True)
    for run in runs:
        stages = [f"{run.stages_ms[name]:.0f}" for name in names]
        table.add_row(_scene(run), run.rasterizer, *stages)
    return table
