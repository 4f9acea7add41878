"""Plots of the site's pages, drawn when it is built from the result files in examples/guides/tables.

A guide says where: a line `<!-- plot: NAME -->`.  Each plot names its files, their command and their commit.
"""

import re
from collections.abc import Callable, Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from aaplug.evaluation.report.plots import COLOURS, Plot
from tests.bench.claims import CLAIMS, pair
from tests.bench.method_tables import SCALES, made, table
from tests.bench.pictures import TITLES, curves
from tests.bench.viewers import results

WIDTH = 5.2  # inches: a phone shows text of this width
SIZES = {0: "800 px, the training size", 2: "200 px, 1/4 of it"}  # columns of viewers.csv
MARKER = re.compile(r"^<!-- plot: (\w+) -->$", re.M)


def drawn(markdown: str) -> str:
    """A page with its plots."""
    return MARKER.sub(lambda found: figure(found[1]), markdown)


def figure(name: str) -> str:
    """A plot as HTML without empty lines, which Markdown leaves as it is."""
    draw, says, files = PLOTS[name]
    links = ", ".join(f'<a href="tables/{file}.csv">{file}.csv</a>' for file in files)
    source = re.sub(r"`(.+?)`", r"<code>\1</code>", made(*files))
    svg = re.sub(r"\n\s*\n", "\n", Plot(name, says, draw).inline_svg().strip())
    svg = svg.replace("<svg ", f'<svg role="img" aria-label="{says}" ', 1)
    return f'<figure class="plot">\n{svg}\n<figcaption>{says}. From {links}, which {source}.</figcaption>\n</figure>'


def _results(ink: str) -> Figure:
    scenes = ("chair", "snowmiku", "chair-eighth")
    page = Figure((WIDTH, 2.6 * len(scenes) + 0.9), layout="constrained")
    for axes, scene in zip(page.subplots(len(scenes)), scenes, strict=True):
        curves(axes, table(scene), ink)
        axes.set(title=TITLES[scene], ylabel="PSNR, dB")
    page.legend(*page.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return page


def _claims(ink: str) -> Figure:
    found = [(f"{number}  {claim.paper.split(' (')[0]}", pair(claim)) for number, claim in enumerate(CLAIMS, 1)]
    gains = {number for number, claim in enumerate(CLAIMS, 1) if claim.ours and claim.ours().startswith(("+", "-"))}
    pairs = [(name, both, int(name.split()[0]) in gains) for name, both in found if both]
    page = Figure((WIDTH, 0.24 * len(pairs) + 1.9), layout="constrained")
    counts = [sum(gain == wanted for _, _, gain in pairs) for wanted in (False, True)]
    for axes, wanted, title in zip(
        page.subplots(2, height_ratios=counts), (False, True), ("mean over scales", "gain"), strict=True
    ):
        lines = [(name, both) for name, both, gain in pairs if gain == wanted]
        _dumbbells(axes, lines, ("the paper", "here, another scene"), ink)
        axes.set(title=title, xlabel="PSNR, dB")
    page.legend(*page.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return page


def _viewers(ink: str) -> Figure:
    cells = {(name, shown): [float(cell.split()[0]) for cell in line] for name, shown, *line in results()}
    names = [name for name, shown in cells if shown == "converted"]
    page = Figure((WIDTH, 0.48 * len(names) + 1.9), layout="constrained")
    for axes, (column, title) in zip(page.subplots(len(SIZES)), SIZES.items(), strict=True):
        lines = [(n, (cells[n, "original"][column], cells[n, "converted"][column])) for n in names]
        _dumbbells(axes, lines, ("original", "converted"), ink)
        axes.set(title=title, xlabel="PSNR, dB")
    page.legend(*page.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return page


def _dumbbells(axes: Axes, lines: Sequence[tuple[str, tuple[float, float]]], labels: Sequence[str], ink: str) -> None:
    """A line of two points for each name."""
    places = range(len(lines))
    for at, (_, both) in zip(places, lines, strict=True):
        axes.plot(both, (at, at), color=ink, lw=1, alpha=0.4, zorder=1)
    for i, (label, colour, marker) in enumerate(zip(labels, COLOURS[1::-1], "os", strict=True)):
        axes.scatter([both[i] for _, both in lines], places, color=colour, marker=marker, s=26, label=label, zorder=2)
    axes.set_yticks(places, [name for name, _ in lines])
    axes.invert_yaxis()
    axes.grid(axis="x", color=ink, alpha=0.12)


PLOTS: dict[str, tuple[Callable[[str], Figure], str, Sequence[str]]] = {
    "results": (_results, "PSNR over scale, one line per recipe and one panel per scene", list(SCALES)[:3]),
    "claims": (_claims, "Figures of the papers beside ours, by the rows of the table", list(SCALES)),
    "viewers": (_viewers, "PSNR against photographs in each program, before and after conversion", ["viewers"]),
}
