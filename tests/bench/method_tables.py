"""The tables of examples/guides/methods.md: python -m tests.bench.method_tables FOLDER.

Evaluates what `every_recipe.toml` names into the folder, except what is there already.  Each scene has a table with a
row per recipe; a cell has the figures of all scales: means over the views, and medians of their seconds.
"""

import json
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from statistics import mean, median
from typing import Any

from aaplug.evaluation.results import method, scale_name

BATCH = Path(__file__).with_name("every_recipe.toml")
HEADINGS = "| recipe | PSNR, dB | SSIM | evaluations, M | s |\n|---|---|---|---|---|"
MILLION = 1e6


def main(folder: Path) -> None:
    """Measure, and print a table for every scene."""
    evaluate = ["aaplug", "evaluate", "--batch", str(BATCH), "-o", str(folder), "--resume"]
    subprocess.run(evaluate, check=True)
    for path in sorted(folder.glob("*/per_view.json")):
        print(f"\n{path.parent.name}\n")
        print("\n".join(table(json.loads(path.read_text()))))


def table(measured: Mapping[str, Any]) -> list[str]:
    """The lines of a scene's table, from its per_view.json."""
    protocol = measured["_aaplug"]
    scales = protocol["scales"]
    recipes = dict.fromkeys(name.rsplit("@")[0] for name in measured if "@" in name)
    views = ", ".join(protocol["view_names"])
    lines = [f"At {', '.join(scale_name(s) for s in scales)}; views {views}.", "", HEADINGS]
    for recipe in recipes:
        at = [measured[method(recipe, scale)] for scale in scales]
        cells = [
            _joined(at, "PSNR", mean, lambda v: f"{v:.2f}"),
            _joined(at, "SSIM", mean, lambda v: f"{v:.4f}"),
            _joined(at, "evaluations", mean, lambda v: f"{v / MILLION:.1f}"),
            _joined(at, "seconds", median, lambda v: f"{v:.2f}"),
        ]
        name = recipe if " " in recipe else f"`{recipe}`"
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return lines


def _joined(
    at: list[Mapping[str, Any]], column: str, middle: Callable[[list[float]], float], written: Callable[[float], str]
) -> str:
    """The middle of the views at each scale; one dash where there is nothing at any."""
    cells = []
    for scale in at:
        values = [value for value in scale[column].values() if value is not None]
        cells.append(written(middle(values)) if values else "–")
    return "–" if set(cells) == {"–"} else " / ".join(cells)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
