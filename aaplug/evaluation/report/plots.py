"""Curves over scale, and how Gaussians sit against their sampling bounds, as matplotlib figures.

Text is drawn as it is (no TeX), so that any name may stand in it.  Drawing is the same on every run.
"""

import io
import math
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from aaplug.evaluation.metrics import PSNR, SSIM
from aaplug.evaluation.results import CEILING, Report, mean, million_pairs, scale_name, seconds
from aaplug.inspection.coverage import Coverage

# told apart on white and on near-black, by people who see few colours also by marker
COLOURS = ("#3b82f6", "#d97706", "#16a34a", "#db2777", "#8b5cf6", "#0d9aa8", "#a3713d", "#7b8794")
MARKERS = "osD^vPX*"
INK = "#010203"  # stands for the text's colour in a page that is light or dark
PAPER_INK = "#1c2733"
SIZE = (5.2, 3.3)  # inches
DPI = 160  # of a PNG
RULES: dict[Any, Any] = {
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
    """A figure that draws itself in a given ink.  name: for a file.  says: what it shows, in words."""

    name: str
    says: str
    draw: Callable[[str], Figure]

    def png(self) -> bytes:
        """A file's bytes."""
        return self._saved("png", PAPER_INK, dpi=DPI, metadata={"Software": None})

    def svg(self) -> str:
        """A file's text."""
        return self._saved("svg", PAPER_INK, metadata={"Date": None}).decode()

    def inline_svg(self) -> str:
        """An element for a page, in the colour of the text around it, that grows with its box."""
        text = self._saved("svg", INK, transparent=True, metadata={"Date": None}).decode()
        text = text[text.index("<svg") :].replace(INK, "currentColor")
        text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
        text = re.sub(r'<g id="[^"]*"', "<g", text)  # several figures share a page
        return re.sub(r'<svg ([^>]*?)width="[^"]*" height="[^"]*"', r"<svg \1", text, count=1)

    def _saved(self, kind: str, ink: str, **settings: Any) -> bytes:
        stream = io.BytesIO()
        with _style(ink):
            self.draw(ink).savefig(stream, format=kind, bbox_inches="tight", **settings)
        return stream.getvalue()


@contextmanager
def _style(ink: str) -> Iterator[None]:
    parts = ("text.color", "axes.labelcolor", "axes.edgecolor", "xtick.color", "ytick.color")
    with mpl.rc_context({**RULES, **dict.fromkeys(parts, ink)}):
        yield


def plots(report: Report, found: Coverage) -> list[Plot]:
    """Everything that a report draws: PSNR, SSIM, time and pairs over scale, and the sampling bounds."""
    curves = [
        ("psnr", "PSNR [dB]", lambda r, s: mean(report.select(r, s), PSNR.name), False),
        ("ssim", "SSIM", lambda r, s: mean(report.select(r, s), SSIM["wang"].name), False),
        ("seconds", "seconds a view", lambda r, s: seconds(report, r, s), True),
        ("pairs", "million pairs of splat and pixel a view", lambda r, s: million_pairs(report, r, s), True),
    ]  # fmt: skip
    drawn = [
        _curve_plot(name, title, value, report, from_zero)
        for name, title, value, from_zero in curves
        if any(value(r, s) is not None for r in report.recipes for s in report.scales)
    ]
    return [*drawn, Plot("sampling-bounds", _bounds_words(found), lambda ink: _bounds(found, ink))]


def colour_of(report: Report, recipe: str) -> str:
    """The colour that a recipe has in every plot."""
    place = [name for name in report.recipes if name != CEILING].index(recipe)
    return COLOURS[place % len(COLOURS)]


def _curve_plot(
    name: str,
    title: str,
    value: Callable[[str, float], float | None],
    report: Report,
    from_zero: bool,
) -> Plot:
    says = f"{title} over scale, a line a recipe"
    return Plot(name, says, lambda ink: _curves(title, value, report, from_zero, ink))


def _curves(
    title: str,
    value: Callable[[str, float], float | None],
    report: Report,
    from_zero: bool,
    ink: str,
) -> Figure:
    figure = Figure(SIZE)
    axes = figure.add_subplot(title=title)
    scales = sorted(report.scales)
    for place, recipe in enumerate(name for name in report.recipes if name != CEILING):
        ys = [_nan(value(recipe, scale)) for scale in scales]
        marker = MARKERS[place % len(MARKERS)]
        axes.plot(scales, ys, marker=marker, ms=5, color=colour_of(report, recipe), label=recipe)
    if CEILING in report.recipes:
        ys = [_nan(value(CEILING, scale)) for scale in scales]
        axes.plot(scales, ys, color=ink, ls=(0, (4, 3)), lw=1, label=CEILING, zorder=1)
    axes.set_xscale("log", base=2)
    axes.set_xticks(scales, [scale_name(scale) for scale in scales])
    axes.minorticks_off()
    axes.grid(axis="y", color=ink, alpha=0.12)
    axes.set_xlabel("scale against training")
    if from_zero:
        axes.set_ylim(bottom=0)
    axes.legend(fontsize=8.5, loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=3)
    return figure


def _nan(value: float | None) -> float:
    """matplotlib leaves out what is no number."""
    return math.nan if value is None else value


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
