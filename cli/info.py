"""aaplug info: what a scene is."""

from dataclasses import dataclass, field
from typing import Annotated, Any

from rich.markup import escape
from rich.table import Table

import aaplug
from aaplug.core.errors import printable
from aaplug.options.shared import MAX_SIDE, FrameOptions

from .console import TERMINAL, out, print_json
from .options import CameraOptions, Flat, SceneOptions

HIDDEN = ("fused", "comments")  # keys for programs; the table has words for the first


@dataclass(frozen=True)
class Info:
    """What a scene is: its convention and why, what is fused, what is odd; with cameras, how finely they sample it."""

    scene: SceneOptions = field(default_factory=SceneOptions)
    cameras: CameraOptions = field(default_factory=CameraOptions)
    how: Annotated[FrameOptions, Flat] = field(default_factory=FrameOptions)
    limits: bool = False
    """Show every limit on files instead, and the environment variable that changes it."""
    json: bool = False
    """Print one JSON object on stdout instead of a table."""

    def __call__(self) -> int:
        """Show what a scene is."""
        if self.limits:
            _show_limits(self.json)
            return 0
        opened = self.scene.open()
        cameras = self.cameras.around if self.cameras.cameras is None else self.cameras.read(self.scene.path)
        facts = aaplug.info(opened, cameras, monitor=TERMINAL, **vars(self.how))
        if self.json:
            print_json(facts)
            return 0
        table = Table(show_header=False, box=None, pad_edge=False)
        for key, value in facts.items():
            if key not in HIDDEN and value != []:
                name = key.removesuffix("_text").replace("_px2", " (px²)").replace("_", " ")
                table.add_row(f"[dim]{name}[/]", escape(_text(value)))
        out.print(table)
        return 0


def _text(value: Any) -> str:
    if value is None or isinstance(value, bool):
        return {None: "unknown", True: "yes", False: "no"}[value]
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list):
        lines = any(isinstance(item, str) for item in value)
        return ("\n" if lines else "  ").join(_text(item) for item in value)
    if isinstance(value, dict):
        return "  ".join(f"{name} px: {_text(share)}" for name, share in value.items())
    return f"{value:,}" if isinstance(value, int) else printable(str(value))


def _show_limits(as_json: bool) -> None:
    from aaplug.core.gaussians import MAX_LOG_SCALE
    from aaplug.io.limits import LIMITS, limit, memory_of_machine

    values = {name: limit(name) for name in LIMITS}
    fixed = {
        "LOG_SCALE": (MAX_LOG_SCALE, "", "a log-scale's absolute value, clamped on use"),
        "RENDER_SIDE": (MAX_SIDE, "px", "a side of a rendered image"),
    }
    if as_json:
        return print_json(values | {name: value for name, (value, *_) in fixed.items()})
    table = Table("limit", "value", "unit", "of", "set by", box=None, pad_edge=False)
    for name, value in values.items():
        row = LIMITS[name]
        table.add_row(name, f"{value:,}", row.unit, row.what, f"AAPLUG_{name}")
    for name, (value, unit, what) in fixed.items():
        table.add_row(name, f"{value:,}", unit, what, "fixed")
    out.print(table)
    if (memory := memory_of_machine()) is not None:
        out.print(f"This machine has {memory / 1e9:.1f} GB of memory.")
