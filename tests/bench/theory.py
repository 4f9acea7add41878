"""The figure of theory.md, which `pictures` draws: the light that each rule keeps, and the error of merging."""

import math

import numpy as np
from matplotlib.figure import Figure

from aaplug.evaluation.report.plots import COLOURS, Plot
from aaplug.evaluation.results import scale_name

KAPPA = 0.3  # px²: what 3DGS adds
VARIANCE = 0.1  # px² of training, of the round splat
RATES = 2.0 ** np.arange(-4, 3)
MERGED = 8  # Gaussians of a cell
CELLS = 2.0 ** np.arange(-4, 2)  # sizes against the filter's deviation
LARGEST_THIRD = 1.38  # of |g'''| of exp(-x²/2), at x = 0.74


def laws() -> Plot:
    """Statements 2 and 6."""
    says = (
        "Above: light against training's over the rate; classic grows to 48 times at 1/8, compensated rules stay at a "
        "quarter, matched stays at one. Below: the error of merging over the cell's size, 8 times less for half a cell"
    )
    return Plot("theory", says, _figure)


def _figure(ink: str) -> Figure:
    figure = Figure((5.2, 6.2), layout="constrained")
    light, merging = figure.subplots(2)
    shares = {
        "classic": (RATES**2 * VARIANCE + KAPPA) / (RATES**2 * (VARIANCE + KAPPA)),
        "compensated against C": np.full(len(RATES), VARIANCE / (VARIANCE + KAPPA)),
        "matched, sa-gs": np.ones(len(RATES)),
    }
    for (name, share), colour in zip(shares.items(), COLOURS, strict=False):
        light.plot(RATES, share, marker="o", ms=4, color=colour, label=name)
    light.set(xlabel="rate r", ylabel="light against training's", title="Statement 2")
    errors = [error(cell) for cell in CELLS]
    merging.plot(CELLS, errors, marker="o", ms=4, color=COLOURS[0], label="largest of 40 random cells")
    merging.plot(CELLS, LARGEST_THIRD * CELLS**3 / 6, color=ink, ls=(0, (4, 3)), lw=1, label="a₃ (h/s)³ / 6")
    merging.set(xlabel="cell h against filter s", ylabel="error of the light, over its peak", title="Statement 6")
    for axes, places in ((light, RATES), (merging, CELLS)):
        axes.set(xscale="log", yscale="log")
        axes.set_xticks(places, [scale_name(place) for place in places])
        axes.minorticks_off()
        axes.yaxis.set_major_formatter("{x:g}")
        axes.grid(color=ink, alpha=0.12)
        axes.legend()
    return figure


def error(cell: float) -> float:
    """Largest error of merging points in a cell, along one axis, through a filter of deviation 1."""
    random, worst = np.random.default_rng(0), 0.0
    x = np.linspace(-4.0, 4.0, 401)
    for _ in range(40):
        weights, places = random.dirichlet(np.ones(MERGED)), cell * (random.random(MERGED) - 0.5)
        mean = float(weights @ places)
        variance = 1 + float(weights @ (places - mean) ** 2)
        seen = np.exp(-((x[:, None] - places) ** 2) / 2) @ weights
        worst = max(
            worst, float(np.abs(seen - np.exp(-((x - mean) ** 2) / (2 * variance)) / math.sqrt(variance)).max())
        )
    return worst
