"""PSNR over scale, from the tables of methods.md."""

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from aaplug.evaluation.report.plots import COLOURS, MARKERS, Plot
from aaplug.evaluation.results import CEILING, scale_name
from tests.bench.method_tables import PSNR_COLUMN, Table, table

TITLES = {
    "chair": "the chair, trained at 800×800",
    "snowmiku": "the capture, trained at 984×740",
    "chair-eighth": "the chair, trained at 100×100, enlarged",
    "snowmiku-quarter": "the capture, trained at 246×185, enlarged",
}
SHOWN = ("auto", "classic", "mip", "mip-splatting", "sa-gs", "matched", "gaussian-blending", "2dgs-matched")
SIZE = (10, 7.4)  # inches


def scales() -> Plot:
    """A curve per recipe, and a panel per table."""
    return Plot("scales", "PSNR over scale, one line per recipe and one panel per scene", _figure)


def _figure(ink: str) -> Figure:
    figure = Figure(SIZE, layout="constrained")
    panels = figure.subplots(2, 2).flat
    for axes, (scene, title) in zip(panels, TITLES.items(), strict=True):
        _curves(axes, table(scene), ink)
        axes.set_title(title)
        axes.set_ylabel("PSNR, dB")
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=5)
    return figure


def _curves(axes: Axes, lines: Table, ink: str) -> None:
    at = sorted({scale for _, scale in lines})
    for recipe, colour, marker in zip(SHOWN, COLOURS, MARKERS, strict=True):
        values = [float(lines[recipe, scale][PSNR_COLUMN]) for scale in at]
        width, layer = (2.4, 3) if recipe == "auto" else (1.2, 2)
        axes.plot(at, values, marker=marker, ms=5, lw=width, color=colour, label=recipe, zorder=layer)
    ceiling = [float(lines[CEILING, scale][PSNR_COLUMN]) for scale in at]
    axes.plot(at, ceiling, color=ink, ls=(0, (4, 3)), lw=1, label=CEILING, zorder=1)
    axes.set_xscale("log", base=2)
    axes.set_xticks(at, [scale_name(scale) for scale in at])
    axes.minorticks_off()
    axes.grid(axis="y", color=ink, alpha=0.12)
