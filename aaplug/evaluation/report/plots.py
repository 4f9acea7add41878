"""Curves over scale, and a histogram of sampling bounds, as matplotlib figures.

Text is drawn literally (no TeX), so that names may hold any character.  Output is the same on every run.
"""

import io
import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import cycle
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from aaplug.evaluation.coverage import Coverage
from aaplug.evaluation.results import CEILING, Report, elided, mean, million_evaluations, scale_name

# Distinct on white and on near-black; the markers help readers who do not see all colours.
COLOURS = ("#3b82f6", "#d97706", "#16a34a", "#db2777", "#8b5cf6", "#0d9aa8", "#a3713d", "#7b8794")
MARKERS = "osD^vPX*p"  # one more than colours, so that pairs repeat after 72
INK = "#010203"  # placeholder for the colour of the page's text, which is light or dark
PAPER_INK = "#1c2733"
FIGURE_INCHES = (5.2, 3.3)
DPI = 160  # of a PNG
LEGEND_CHARACTERS = 60  # of a name: about the width of the plot
EVALUATIONS, ABOVE_NYQUIST, BOUNDS = "evaluations", "above-nyquist", "sampling-bounds"  # names of plots
INK_SETTINGS = ("text.color", "axes.labelcolor", "axes.edgecolor", "xtick.color", "ytick.color")
STYLE: dict[Any, Any] = {
    "text.parse_math": False,
    "svg.fonttype": "none",
    "font.size": 9.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 10.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "legend.frameon": False,
}
Value = Callable[[str, float], float | None]  # by recipe and scale


@dataclass(frozen=True)
class Plot:
    """A figure, drawn on demand in a given ink.  name: for its file.  says: its content, for a screen reader."""

    name: str
    says: str
    draw: Callable[[str], Figure]

    def png(self) -> bytes:
        """Content of a PNG file."""
        return self._saved("png", PAPER_INK, dpi=DPI, metadata={"Software": None})

    def svg(self) -> str:
        """Content of an SVG file."""
        return self._saved("svg", PAPER_INK, metadata={"Date": None}).decode()

    def inline_svg(self) -> str:
        """An SVG element for a page: it has the colour of the text around it and fills the width of its box."""
        text = self._saved("svg", INK, transparent=True, metadata={"Date": None}).decode()
        text = text[text.index("<svg") :].replace(INK, "currentColor")
        text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
        text = re.sub(r'<g id="[^"]*"', "<g", text)  # ids would clash with those of other figures
        return re.sub(r'<svg ([^>]*?)width="[^"]*" height="[^"]*"', r"<svg \1", text, count=1)

    def _saved(self, kind: str, ink: str, **settings: Any) -> bytes:
        stream, parts = io.BytesIO(), dict.fromkeys(INK_SETTINGS, ink)
        with mpl.rc_context({**STYLE, **parts, "svg.hashsalt": self.name}):  # ids of several figures differ in a page
            self.draw(ink).savefig(stream, format=kind, bbox_inches="tight", **settings)
        return stream.getvalue()


def plots(report: Report, bounds: Coverage) -> list[Plot]:
    """The plots of a report: metrics against the truth and work over scale, and the sampling bounds."""
    curves = [
        _curves(plot_name(m.name), m.title, lambda *at, name=m.name: mean(report.select(*at), name), report)
        for m in report.compared
    ]
    title = "million splat-pixel evaluations per view"
    curves.append(_curves(EVALUATIONS, title, partial(million_evaluations, report), report, from_zero=True))
    title = "share of the splats' energy above the Nyquist rate"
    curves.append(_curves(ABOVE_NYQUIST, title, lambda *at: bounds.above_nyquist.get(at), report, from_zero=True))
    share = "" if bounds.under is None else f": {bounds.under:.0%} are under it"
    words = f"Histogram of the Gaussians' extent over their sampling bound{share}"
    return [*filter(None, curves), Plot(BOUNDS, words, partial(_histogram, bounds))]


def plot_name(metric: str) -> str:
    """The name of a metric's plot."""
    return re.sub(r"\W+", "-", metric.lower())


def _curves(name: str, title: str, value: Value, report: Report, from_zero: bool = False) -> Plot | None:
    """One line per recipe over scale, from 0 if `from_zero`; None if there is nothing to draw.

    Lines have gaps where a value is undefined; the ceiling's is dashed and lies behind the others.
    """
    scales = sorted(report.scales)
    values = {recipe: [value(recipe, scale) for scale in scales] for recipe in report.recipes}
    if all(v is None for line in values.values() for v in line):
        return None

    def draw(ink: str) -> Figure:
        lines = {recipe: [math.nan if v is None else v for v in line] for recipe, line in values.items()}
        figure, ceiling = Figure(FIGURE_INCHES), lines.pop(CEILING, None)
        axes = figure.add_subplot(title=title)
        for (recipe, line), colour, marker in zip(lines.items(), cycle(COLOURS), cycle(MARKERS), strict=False):
            if not all(map(math.isnan, line)):
                axes.plot(scales, line, marker=marker, ms=5, color=colour, label=recipe)
        if ceiling is not None and not all(map(math.isnan, ceiling)):
            axes.plot(scales, ceiling, color=ink, ls=(0, (4, 3)), lw=1, label=CEILING, zorder=1)
        axes.set_xscale("log", base=2)
        axes.set_xticks(scales, [scale_name(scale) for scale in scales])
        axes.minorticks_off()
        axes.grid(axis="y", color=ink, alpha=0.12)
        axes.set_xlabel("scale against training")
        if from_zero:
            axes.set_ylim(bottom=0)
        columns = 3 if max(map(len, lines)) <= len(CEILING) else 1
        labels = [elided(str(line.get_label()), LEGEND_CHARACTERS) for line in axes.lines]
        axes.legend(axes.lines, labels, fontsize=8.5, loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=columns)
        return figure

    return Plot(name, f"{title} over scale, one line per recipe", draw)


def _histogram(bounds: Coverage, ink: str) -> Figure:
    figure = Figure(FIGURE_INCHES)
    axes = figure.add_subplot(title="Gaussians against their sampling bound")
    lefts, width = bounds.edges[:-1], bounds.edges[1] - bounds.edges[0]
    colours = [COLOURS[1] if left < 0 else COLOURS[0] for left in lefts]
    axes.bar(lefts, bounds.counts, width=width, align="edge", color=colours, linewidth=0)
    axes.axvline(0, color=ink, lw=1)
    top = max(*bounds.counts, 1)
    axes.text(-0.15, top * 1.04, "aliases  ", ha="right", va="bottom", color=COLOURS[1])
    axes.text(0.15, top * 1.04, "  sampled well", ha="left", va="bottom", color=COLOURS[0])
    axes.set_ylim(top=top * 1.15)
    axes.xaxis.set_major_formatter(FuncFormatter(lambda x, _: scale_name(2.0**x)))
    axes.set_xlabel("extent in the sharpest training view, over √0.2 px")
    axes.set_ylabel("Gaussians")
    axes.grid(axis="y", color=ink, alpha=0.12)
    return figure
