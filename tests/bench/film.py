"""Passes, files and frame sequences: how true, how fast, how safe; and every pass of the sample as a picture."""

import time
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

import aaplug
from aaplug.core.passes import PASSES
from aaplug.evaluation.report.contact_sheet import labelled
from aaplug.io.images import write_png
from tests.bench import heading, row
from tests.conftest import SAMPLE

COLUMNS = 5  # of the contact sheet
PRIME = 7919  # scatters the colours of neighbouring ids


def shown(name: str, drawn: dict[str, Tensor]) -> Tensor:
    """A pass as colours, for looking at it: gray from its 2nd to its 98th percentile, axes as red, green and blue."""
    layer, covered = drawn[name].double(), drawn["alpha"] > 0.5
    if name in ("rgb", "alpha"):
        return drawn[name].float() if name == "rgb" else drawn[name][..., None].expand(-1, -1, 3)
    if name == "normal":
        return ((layer + 1) / 2 * covered[..., None]).float()
    if name == "id":
        layer = torch.stack([(layer * PRIME * k) % 256 for k in (1, 3, 7)], dim=2) / 255
        return (layer * (drawn["id"] >= 0)[..., None]).float()
    layer = layer if layer.ndim == 3 else layer[..., None].expand(-1, -1, 3)
    inside = layer[covered]
    low, high = (inside.quantile(q, dim=0) for q in (0.02, 0.98))
    gray = (layer - low) / (high - low).clamp(min=1e-9)
    return (gray.clamp(0, 1) * (covered if name != "samples" else torch.ones_like(covered))[..., None]).float()


def contact_sheet(scale: float = 0.5) -> Tensor:
    """Every pass of a view of the sample, with its name."""
    cameras = aaplug.read_cameras(SAMPLE)
    drawn = aaplug.Renderer.of(SAMPLE / "chair.ply", cameras).passes(cameras.test[0].scaled(scale), list(PASSES))
    panes = [labelled(shown(name, drawn).contiguous(), name) for name in PASSES]
    rows = [torch.cat(panes[start : start + COLUMNS], dim=1) for start in range(0, len(panes), COLUMNS)]
    return torch.cat(rows)


def cost_of_passes() -> None:
    """The time of each pass, over that of rgb alone."""
    cameras = aaplug.read_cameras(SAMPLE)
    renderer, view = aaplug.Renderer.of(SAMPLE / "chair.ply", cameras), cameras.test[0]
    heading(
        f"Time of passes over rgb, the sample at {view.width}x{view.height} px ({renderer.rasterizer.name})",
        "passes",
        "times rgb",
    )

    def seconds(names: list[str]) -> float:
        times = []
        for _ in range(3):
            start = time.perf_counter()
            renderer.passes(view, names)
            times.append(time.perf_counter() - start)
        return min(times)

    renderer(view)
    alone = seconds(["rgb"])
    for names in (["rgb", "alpha"], *([name] for name in PASSES if name not in ("rgb", "alpha")), list(PASSES)):
        row(" ".join(names) if len(names) < len(PASSES) else "all", seconds(names) / alone)


LINES: list[Callable[[], None]] = [cost_of_passes]


def main(pictures: Path | None = None) -> None:
    """Run every line of the table.

    Args:
        pictures: folder for the contact sheet.
    """
    if pictures is not None:
        write_png(pictures / "passes.png", contact_sheet(), overwrite=True)
    for line in LINES:
        line()
