"""The tables of examples/guides/methods.md, from every recipe on every scene.

Evaluates what `every_recipe.toml` names into the folder, except what is there already.  Each scene has a CSV file in
examples/guides/tables, with a line per recipe and scale: means over the views, and the median of their seconds.  The
short table of the page is printed.
"""

import csv
import json
import subprocess
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from statistics import mean, median
from typing import Any

from aaplug.evaluation.results import CEILING, method, scale_name

BATCH = Path(__file__).with_name("every_recipe.toml")
TABLES = Path(__file__).resolve().parents[2] / "examples" / "guides" / "tables"
MADE = TABLES / "made.json"  # by which command each table was made, and at which commit
PSNR_COLUMN = "PSNR (dB)"
COLUMNS = ("recipe", "scale", PSNR_COLUMN, "SSIM", "evaluations (M)", "seconds")
MILLION = 1e6
SHORT = (  # recipes of the short table, and the scales of each scene
    *(CEILING, "classic", "ewa", "mip", "mip-splatting", "aaa", "analytic", "sa-gs", "2dgs-matched"),
    *("gaussian-blending", "matched-blending", "matched", "auto"),
)
SCALES = {
    "chair": (0.5, 0.25, 0.125),
    "snowmiku": (0.5, 0.25, 0.125),
    "chair-eighth": (4.0,),
    "snowmiku-quarter": (4.0,),
}
Table = dict[tuple[str, float], dict[str, str]]  # a line of the CSV by recipe and scale


def main(folder: Path = Path("every_recipe")) -> None:
    """Measure, write a CSV for every scene, and print the short table."""
    subprocess.run(["aaplug", "evaluate", "--batch", str(BATCH), "-o", str(folder), "--resume"], check=True)
    for path in sorted(folder.glob("*/per_view.json")):
        keep(path.parent.name, [COLUMNS, *lines(json.loads(path.read_text()))], "python -m tests.bench method_tables")
    print(short_table())


def keep(name: str, rows: Iterable[Sequence[str]], command: str) -> None:
    """Write a table, and by which command it was made and at which commit."""
    with open(TABLES / f"{name}.csv", "w", newline="", encoding="utf-8") as file:
        csv.writer(file, lineterminator="\n").writerows(rows)
    commit = subprocess.run(["git", "rev-parse", "HEAD"], capture_output=True, text=True, check=True).stdout.strip()
    made = json.loads(MADE.read_text()) | {name: {"command": command, "commit": commit}}
    MADE.write_text(json.dumps(made, indent=1) + "\n")


def made(*names: str) -> str:
    """The command and the commit of tables, in words."""
    facts = json.loads(MADE.read_text())
    [fact] = {(facts[name]["command"], facts[name]["commit"]) for name in names}
    return f"`{fact[0]}` made at commit {fact[1][:12]}"


def lines(measured: Mapping[str, Any]) -> Iterator[tuple[str, ...]]:
    """The lines of a scene's table, from its per_view.json; a cell without a value is empty."""
    recipes = dict.fromkeys(name.rsplit("@")[0] for name in measured if "@" in name)
    for recipe in recipes:
        for scale in measured["_aaplug"]["scales"]:
            at = measured[method(recipe, scale)]
            values = {name: [v for v in column.values() if v is not None] for name, column in at.items()}
            psnr, ssim, work, seconds = (values[name] for name in ("PSNR", "SSIM", "evaluations", "seconds"))
            yield (
                *(recipe, f"{scale:g}"),
                *(f"{mean(psnr):.2f}" if psnr else "", f"{mean(ssim):.4f}" if ssim else ""),
                *(f"{mean(work) / MILLION:.1f}" if any(work) else "", f"{median(seconds):.2f}"),
            )


def table(scene: str) -> Table:
    """A scene's CSV."""
    with open(TABLES / f"{scene}.csv", newline="", encoding="utf-8") as file:
        return {(row["recipe"], float(row["scale"])): row for row in csv.DictReader(file)}


def short_table() -> str:
    """PSNR of some recipes at some scales of every scene, as Markdown."""
    tables = {scene: table(scene) for scene in SCALES}
    columns = [(scene, scale) for scene, scales in SCALES.items() for scale in scales]
    names = [f"{scene} {scale_name(scale)}" for scene, scale in columns]
    rows = [["recipe", *names], ["---"] * (len(names) + 1)]
    for recipe in SHORT:
        name = recipe if " " in recipe else f"`{recipe}`"
        rows.append([name, *(tables[scene][recipe, scale][PSNR_COLUMN] for scene, scale in columns)])
    return "\n".join(f"| {' | '.join(row)} |" for row in rows).replace(" --- ", "---")
