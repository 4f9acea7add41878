"""Curves over scale, and a histogram of sampling bounds, as matplotlib figures.

Text is drawn literally (no TeX), so that names may hold any character.  Output is the same on every run.
"""

import io
import math
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from aaplug.evaluation.metric import Metric
from aaplug.evaluation.results import CEILING, Report, mean, million_evaluations, scale_name, seconds
from aaplug.inspection.coverage import Coverage

# Distinct on white and on near-black; the markers help readers who do not see all colours.
COLOURS = ("#3b82f6", "#d97706", "#16a34a", "#db2777", "#8b5cf6", "#0d9aa8", "#a3713d", "#7b8794")
MARKERS = "osD^vPX*"
INK = "#010203"  # placeholder for the colour of the page's text, which is light or dark
PAPER_INK = "#1c2733"
SIZE = (5.2, 3.3)  # inches
DPI = 160  # of a PNG
BOUNDS = "sampling-bounds"
STYLE: dict[Any, Any] = {
    "text.parse_math": False,
    "svg.fonttype": "none",
    "svg.hashsalt": "aaplug",
    "font.size": 9.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 10.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "legend.frameon": False,
}


@dataclass(frozen=True)
class Plot:
    """A figure, drawn on demand in a given ink.  name: for its file.  says: what it shows, for a screen reader."""

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
        stream = io.BytesIO()
        with _style(ink):
            self.draw(ink).savefig(stream, format=kind, bbox_inches="tight", **settings)
        return stream.getvalue()


@contextmanager
def _style(ink: str) -> Iterator[None]:
    parts = ("text.color", "axes.labelcolor", "axes.edgecolor", "xtick.color", "ytick.color")
    with mpl.rc_context({**STYLE, **dict.fromkeys(parts, ink)}):
        yield


@dataclass(frozen=True)
class Curves:
    """One line per recipe over scale.  from_zero: whether the axis starts at 0."""

    name: str
    title: str
    value: Callable[[str, float], float | None]
    report: Report
    from_zero: bool = False

    @property
    def known(self) -> bool:
        """Whether there is anything to draw."""
        report = self.report
        return any(self.value(r, s) is not None for r in report.recipes for s in report.scales)

    @property
    def plot(self) -> Plot:
        """The curves as a figure."""
        return Plot(self.name, f"{self.title} over scale, one line per recipe", self._draw)

    def _draw(self, ink: str) -> Figure:
        figure = Figure(SIZE)
        axes = figure.add_subplot(title=self.title)
        self._lines(axes, ink)
        scales = sorted(self.report.scales)
        axes.set_xscale("log", base=2)
        axes.set_xticks(scales, [scale_name(scale) for scale in scales])
        axes.minorticks_off()
        axes.grid(axis="y", color=ink, alpha=0.12)
        axes.set_xlabel("scale against training")
        if self.from_zero:
            axes.set_ylim(bottom=0)
        axes.legend(fontsize=8.5, loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=3)
        return figure

    def _lines(self, axes: Axes, ink: str) -> None:
        scales = sorted(self.report.scales)
        for place, recipe in enumerate(name for name in self.report.recipes if name != CEILING):
            colour, marker = COLOURS[place % len(COLOURS)], MARKERS[place % len(MARKERS)]
            values = self._values(recipe)
            axes.plot(scales, values, marker=marker, ms=5, color=colour, label=recipe)
        if CEILING in self.report.recipes:
            values = self._values(CEILING)
            axes.plot(scales, values, color=ink, ls=(0, (4, 3)), lw=1, label=CEILING, zorder=1)

    def _values(self, recipe: str) -> list[float]:
        """Values by rising scale; NaN, which matplotlib leaves out, where undefined."""
        values = [self.value(recipe, scale) for scale in sorted(self.report.scales)]
        return [math.nan if value is None else value for value in values]


COSTS = (
    ("seconds", "seconds a view", seconds),
    ("evaluations", "million splat-pixel evaluations a view", million_evaluations),
)


def plots(report: Report, found: Coverage) -> list[Plot]:
    """Everything that a report draws: metrics against the truth, time and work over scale, and the sampling bounds."""
    compared = [metric for metric in report.metrics if metric.measure is not None]
    curves = [_metric_curves(metric, report) for metric in compared]
    for name, title, value in COSTS:
        curves.append(Curves(name, title, partial(value, report), report, from_zero=True))
    drawn = [curve.plot for curve in curves if curve.known]
    return [*drawn, Plot(BOUNDS, _bounds_words(found), lambda ink: _bounds(found, ink))]


def _metric_curves(metric: Metric, report: Report) -> Curves:
    return Curves(
        re.sub(r"\W+", "-", metric.name.lower()),
        metric.title,
        lambda recipe, scale: mean(report.select(recipe, scale), metric.name),
        report,
    )


def _bounds(found: Coverage, ink: str) -> Figure:
    figure = Figure(SIZE)
    axes = figure.add_subplot(title="Gaussians against their sampling bound")
    lefts, width = found.edges[:-1], found.edges[1] - found.edges[0]
    colours = [COLOURS[1] if left < 0 else COLOURS[0] for left in lefts]
    axes.bar(lefts, found.counts, width=width, align="edge", color=colours, linewidth=0)
    axes.axvline(0, color=ink, lw=1)
    top = max(*found.counts, 1)
    axes.text(-0.15, top * 1.04, "aliases  ", ha="right", va="bottom", color=COLOURS[1])
    axes.text(0.15, top * 1.04, "  sampled well", ha="left", va="bottom", color=COLOURS[0])
    axes.set_ylim(top=top * 1.15)
    axes.xaxis.set_major_formatter(FuncFormatter(lambda x, _: scale_name(2.0**x)))
    axes.set_xlabel("extent in the sharpest training view, over √0.2 px")
    axes.set_ylabel("Gaussians")
    axes.grid(axis="y", color=ink, alpha=0.12)
    return figure


def _bounds_words(found: Coverage) -> str:
    share = "" if found.under is None else f": {found.under:.0%} are under it"
    return f"Histogram of the Gaussians' extent over their sampling bound{share}"
