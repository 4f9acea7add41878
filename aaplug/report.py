"""What an evaluation found, as data, and its three printed forms: table, results.json, per_view.json."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

from rich.markup import escape
from rich.table import Table

from aaplug.metrics import METRICS, Metric

CEILING = "training size, resampled"  # the row that every table holds


@dataclass(frozen=True)
class Measurement:
    """One recipe at one scale on one view; values by metric, None where undefined (`note` says why)."""

    recipe: str
    scale: float
    view: str
    values: Mapping[str, float | None]
    samples: int
    seconds: float
    note: str = ""


@dataclass(frozen=True)
class Report:
    """Measurements and the protocol that gives them meaning (JSON-ready)."""

    measurements: tuple[Measurement, ...]
    protocol: Mapping[str, Any]

    @property
    def recipes(self) -> tuple[str, ...]:
        """Recipes in the order of measurement."""
        return tuple(dict.fromkeys(m.recipe for m in self.measurements))

    @property
    def scales(self) -> tuple[float, ...]:
        """Scales in the order of measurement."""
        return tuple(dict.fromkeys(m.scale for m in self.measurements))

    def select(self, recipe: str, scale: float) -> tuple[Measurement, ...]:
        """Measurements of every view."""
        return tuple(m for m in self.measurements if m.recipe == recipe and m.scale == scale)


def mean(measurements: Iterable[Measurement], metric: str) -> float | None:
    """Mean over the views where the metric is defined, None if it is nowhere."""
    values = [value for m in measurements if (value := m.values.get(metric)) is not None]
    return sum(values) / len(values) if values else None


def scale_name(scale: float) -> str:
    """How people write a scale: 1/4, 1, 2×, 0.3."""
    if scale > 1:
        return f"{scale:g}×"
    fraction = Fraction(scale).limit_denominator(64)
    exact = fraction.numerator == 1 and float(fraction) == scale
    return str(fraction) if exact else f"{scale:g}"


def tables(report: Report) -> list[Table]:
    """A table a metric and one of seconds a view, recipes down and scales across; the best of a column is bold."""
    what = f"{report.protocol['truth']}, {report.protocol['views']} views"
    grids = []
    for metric in METRICS.values():
        unit = f" [{metric.unit}]" if metric.unit else ""
        best = [_best(report, metric.name, scale) for scale in report.scales]
        grid = _grid(f"{metric.name}{unit}, {what}", report)
        for recipe in report.recipes:
            cells = [
                _cell(mean(report.select(recipe, scale), metric.name), metric, top)
                for scale, top in zip(report.scales, best, strict=True)
            ]
            grid.add_row(recipe, *cells, style="italic" if recipe == CEILING else None)
        grids.append(grid)
    times = _grid("seconds a view", report)
    for recipe in report.recipes:
        times.add_row(recipe, *[f"{_seconds(report, recipe, s):.2f}" for s in report.scales])
    return [*grids, times]


def results(report: Report) -> dict[str, Any]:
    """INRIA's results.json, {method: {metric: mean}} with methods named recipe@scale, and our protocol beside it."""
    methods = {
        _method(recipe, scale): {m: mean(report.select(recipe, scale), m) for m in METRICS}
        for recipe in report.recipes
        for scale in report.scales
    }
    return methods | {"_aaplug": dict(report.protocol) | {"notes": _notes(report)}}


def per_view(report: Report) -> dict[str, Any]:
    """INRIA's per_view.json, {method: {metric: {view: value}}}, with samples a pixel's side and seconds beside."""
    methods: dict[str, Any] = {}
    for recipe in report.recipes:
        for scale in report.scales:
            views = report.select(recipe, scale)
            columns: dict[str, Any] = {m: {v.view: v.values.get(m) for v in views} for m in METRICS}
            columns["samples"] = {v.view: v.samples for v in views}
            columns["seconds"] = {v.view: round(v.seconds, 4) for v in views}
            methods[_method(recipe, scale)] = columns
    return methods | {"_aaplug": dict(report.protocol) | {"notes": _notes(report)}}


def _method(recipe: str, scale: float) -> str:
    return f"{recipe}@{scale:g}"


def _notes(report: Report) -> list[str]:
    return list(dict.fromkeys(m.note for m in report.measurements if m.note))


def _seconds(report: Report, recipe: str, scale: float) -> float:
    times = [m.seconds for m in report.select(recipe, scale)]
    return sum(times) / len(times)


def _best(report: Report, metric: str, scale: float) -> float | None:
    values = [mean(report.select(r, scale), metric) for r in report.recipes if r != CEILING]
    known = [value for value in values if value is not None]
    if not known:
        return None
    return max(known) if METRICS[metric].higher_is_better else min(known)


def _grid(title: str, report: Report) -> Table:
    grid = Table(title=escape(title), title_justify="left")
    grid.add_column("recipe", no_wrap=True)
    for scale in report.scales:
        grid.add_column(scale_name(scale), justify="right", no_wrap=True)
    return grid


def _cell(value: float | None, metric: Metric, best: float | None) -> str:
    if value is None:
        return "–"
    text = f"{value:.2f}" if metric.unit == "dB" else f"{value:.4f}"
    return f"[bold]{text}[/]" if value == best else text
