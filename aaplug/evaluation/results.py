"""The results of an evaluation as data and in print: tables, results.json, per_view.json, results.csv."""

import csv
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import product
from statistics import median, quantiles, stdev
from typing import Any

from rich.markup import escape
from rich.table import Table
from rich.text import Text

from aaplug.evaluation import METRICS
from aaplug.evaluation.metric import Metric, number
from aaplug.evaluation.metrics import EQUAL, PSNR, SSIM
from aaplug.system.errors import counted, printable
from aaplug.system.registry import named

CEILING = "training size, resampled"  # a row of every table: the own training-size look
NO_PHOTOGRAPH = "no photograph is this large: metrics above the photographs' own size are undefined"
TIME_DIGITS, COUNT_DIGITS = 3, 2  # decimals of seconds, and of million evaluations
MILLION = 1e6

Facts = tuple[str, list[str], list[list[str]]]  # a table of text: title, headings, rows


@dataclass(frozen=True)
class Measurement:
    """One renderer at one scale on one view.

    recipe: the renderer's name.
    values: by metric; None where undefined, for the reason in `note`.
    samples: along a pixel's side.
    evaluations: splat-pixel evaluations of compositing; None where not counted.
    """

    recipe: str
    scale: float
    view: str
    values: Mapping[str, float | None]
    samples: int
    seconds: float
    note: str = ""
    evaluations: int | None = None


@dataclass(frozen=True)
class Report:
    """Measurements and the protocol that gives them meaning (JSON-ready).

    measured: the metrics; those of `METRICS` need not be given.
    """

    measurements: tuple[Measurement, ...]
    protocol: Mapping[str, Any]
    measured: tuple[Metric, ...] = ()

    def __repr__(self) -> str:
        about = f"recipes={self.recipes}, scales={self.scales}, metrics={[metric.name for metric in self.metrics]}"
        return f"Report({counted(len(self.measurements), 'measurement')}, {about})"

    @property
    def metrics(self) -> tuple[Metric, ...]:
        """The metrics measured, in order."""
        names, measured = dict.fromkeys(name for m in self.measurements for name in m.values), named(self.measured)
        return tuple(measured.get(name) or METRICS[name] for name in names) or (PSNR, SSIM["wang"])

    @property
    def compared(self) -> tuple[Metric, ...]:
        """The metrics that compare with the truth; reports show the first of them most."""
        return tuple(metric for metric in self.metrics if metric.measure is not None)

    @property
    def recipes(self) -> tuple[str, ...]:
        """Recipes in the order of measurement."""
        return tuple(dict.fromkeys(m.recipe for m in self.measurements))

    @property
    def row_title(self) -> str:
        """The heading of its tables' rows: "recipe", or "compared scene"."""
        return self.protocol.get("rows", "recipe")

    @property
    def scales(self) -> tuple[float, ...]:
        """Scales in the order of measurement."""
        return tuple(dict.fromkeys(m.scale for m in self.measurements))

    @property
    def notes(self) -> list[str]:
        """Why values are undefined, each reason once."""
        return list(dict.fromkeys(m.note for m in self.measurements if m.note))

    def basis(self, metric: str) -> dict[str, Any]:
        """The choices behind a metric's figures, beside scene and recipe; figures of another basis do not compare."""
        parts = {"protocols": "protocol", "truths": "truth", "ways of downscaling": "downscale"}
        flavour = self.protocol.get("metrics", {}).get(metric)
        return {"flavours": flavour} | {words: self.protocol.get(key) for words, key in parts.items()}

    def select(self, recipe: str, scale: float) -> tuple[Measurement, ...]:
        """Measurements of every view."""
        return tuple(m for m in self.measurements if m.recipe == recipe and m.scale == scale)

    def once_more(self, recipe: str, name: str) -> "Report":
        """The report with a recipe's rows again, under another name."""
        again = tuple(replace(m, recipe=name) for m in self.measurements if m.recipe == recipe)
        named = {key: {name: self.protocol[key][recipe]} for key in ("recipes", "recipes_sha256")}
        return self.with_more(Report(again, named))

    def with_more(self, other: "Report") -> "Report":
        """Join two reports of the same protocol."""
        joined = {key: self.protocol[key] | other.protocol[key] for key in ("recipes", "recipes_sha256")}
        measurements, measured = self.measurements + other.measurements, self.measured + other.measured
        return Report(measurements, {**self.protocol, **joined}, measured)


@dataclass(frozen=True)
class Cell:
    """A figure of a table, as text.

    text: the mean over the views, or the median.
    best: true if it is the best of its column; the ceiling never is.
    spread: standard deviation or quartiles over the views; "" where there are fewer than two.
    worst: value and name of the worst view; None where all are equal.
    """

    text: str
    best: bool = False
    spread: str = ""
    worst: tuple[str, str] | None = None


def mean(measurements: Iterable[Measurement], metric: str) -> float | None:
    """Mean over the views where the metric is defined, None if it is nowhere."""
    return _mean(m.values.get(metric) for m in measurements)


def mean_square_error(measurements: Iterable[Measurement]) -> float:
    """The one of the mean PSNR over the views that do not equal their truth; 0 where all do."""
    psnr = mean(measurements, PSNR.name)
    return 0.0 if psnr is None else 10 ** (-psnr / 10)


def figure_of(metric: Metric, measurements: Sequence[Measurement]) -> float | None:
    """The mean as people read it: infinity where every image equals its truth and the metric is infinite there."""
    equal = measurements and metric.undefined == EQUAL and all(EQUAL in m.note for m in measurements)
    return math.inf if equal else mean(measurements, metric.name)


def million_evaluations(report: Report, recipe: str, scale: float) -> float | None:
    """Mean splat-pixel evaluations of a view, in millions; None if not counted."""
    return _mean(m.evaluations and m.evaluations / MILLION for m in report.select(recipe, scale))


def _mean(values: Iterable[float | None]) -> float | None:
    defined = [value for value in values if value is not None]
    return sum(defined) / len(defined) if defined else None


def spread_of(metric: Metric, measurements: Iterable[Measurement]) -> dict[str, Any] | None:
    """A metric over the views where it is defined, None if it is nowhere.

    Its mean, median, and view and value of the worst; as "spread" the sample's standard deviation, None of one view.
    """
    values = {m.view: value for m in measurements if (value := m.values.get(metric.name)) is not None}
    if not values:
        return None
    worst = max(values, key=lambda view: metric.loss(values[view]))
    return {
        "mean": sum(values.values()) / len(values),
        "median": median(values.values()),
        "worst": {"view": worst, "value": values[worst]},
        "spread": stdev(values.values()) if len(values) > 1 else None,
    }


def elided(text: str, most: int) -> str:
    """The text without its middle where it has more than `most` characters: names differ at their ends."""
    tail = (most - 1) // 2
    return text if len(text) <= most else f"{text[: most - 1 - tail]}…{text[len(text) - tail :]}"


def literal(text: str) -> Text:
    """A name as a cell of a table: it is no markup, nor the code of an emoji, and commands no terminal."""
    return Text(printable(text))


def scale_name(scale: float) -> str:
    """A scale in words: 1/4, 1, 2×, 0.3."""
    if scale > 1:
        return f"{scale:g}×"
    fraction = Fraction(scale).limit_denominator(64)
    exact = fraction.numerator == 1 and float(fraction) == scale
    return str(fraction) if exact else f"{scale:g}"


def method(recipe: str, scale: float) -> str:
    """The name of a recipe at a scale, where INRIA's files name a method."""
    return f"{recipe}@{scale:g}"


def tables(report: Report) -> list[Table | str]:
    """A table per metric, then seconds and evaluations per view; recipes down, scales across, the best value bold."""
    subject, grids = f"{report.protocol['truth']}, {counted(report.protocol['views'], 'view')}", list[Table | str]()
    for metric in report.metrics:
        variant, colon, _ = report.protocol.get("metrics", {}).get(metric.name, "").partition(":")
        flavour = f" {variant}" if colon and " " not in variant else ""
        title = f"{metric.name}{flavour}{metric.title.removeprefix(metric.name)}, {subject}"
        rows = metric_cells(report, metric)
        lines = [[f"[bold]{cell.text}[/]" if cell.best else cell.text for cell in row] for row in rows]
        grids += metric_grid(title, [report], metric, lines, "italic")
    for title, _, rows in cost_cells(report):
        grids.append(grid(title, report, [[cell.text for cell in row] for row in rows]))
    return grids


def metric_grid(
    title: str, reports: Sequence[Report], metric: Metric, lines: list[list[str]], ceiling: str | None = None
) -> list[Table | str]:
    """A metric's table as `grid`, unless it has no value at all, and a line that says at which scales, and why.

    reports: that the lines are means of; the first has their recipes and scales.
    """
    report = reports[0]
    columns = dict(zip(report.scales, zip(*lines, strict=True), strict=True))
    empty = [scale for scale, column in columns.items() if {*column} == {metric.text(None)}]
    table = [grid(title, report, lines, ceiling)] * (len(empty) < len(columns))
    if not empty:
        return [*table]
    small = any(m.note == NO_PHOTOGRAPH for each in reports for m in each.measurements if m.scale in empty)
    too_large = metric.smaller and max(empty) >= 1
    reasons = ["it needs a scale below the training size"] * too_large
    reasons += [metric.undefined] * (not metric.smaller or min(empty) < 1)
    why = NO_PHOTOGRAPH if small and metric.measure else "; ".join(reasons)
    if any(scale not in each.scales for each in reports for scale in empty):
        why = "some scenes have other scales"
    first, *others = (each.basis(metric.name) for each in reports)
    if differing := [part for part in first if any(other[part] != first[part] for other in others)]:
        why = f"the scenes' {' and '.join(differing)} differ"
    return [*table, f"no {metric.name} at {', '.join(map(scale_name, empty))}: {why}"]


def grid(title: str, report: Report, lines: list[list[str]], ceiling: str | None = None) -> Table:
    """A table of one line per recipe; ceiling: style of that row."""
    grid = Table(title=escape(title), title_justify="left")
    grid.add_column(report.row_title, overflow="fold")
    for scale in report.scales:
        grid.add_column(scale_name(scale), justify="right", no_wrap=True)
    for recipe, cells in zip(report.recipes, lines, strict=True):
        grid.add_row(literal(recipe), *cells, style=ceiling if recipe == CEILING else None)
    return grid


def metric_cells(report: Report, metric: Metric) -> list[list[Cell]]:
    """A metric's table, recipes down and scales across."""
    columns = []
    for scale in report.scales:
        views = {recipe: report.select(recipe, scale) for recipe in report.recipes}
        spreads = {recipe: spread_of(metric, measurements) for recipe, measurements in views.items()}
        means = {recipe: figure_of(metric, measurements) for recipe, measurements in views.items()}
        contenders = [value for recipe, value in means.items() if recipe != CEILING and value is not None]
        best, cells = min(contenders, key=metric.loss, default=math.nan), list[Cell]()
        for recipe, spread in spreads.items():
            value, deviation, worst = means[recipe], "", None
            if spread is not None and spread["spread"] is not None:
                deviation = f"± {metric.text(spread['spread'])}"
                worst = (metric.text(spread["worst"]["value"]), spread["worst"]["view"]) if spread["spread"] else None
            cells.append(Cell(metric.text(value), recipe != CEILING and value == best, deviation, worst))
        columns.append(cells)
    return [list(row) for row in zip(*columns, strict=True)]


def cost_cells(report: Report) -> list[tuple[str, str, list[list[Cell]]]]:
    """Tables of a view's cost, recipes down and scales across, as (title, meaning, rows)."""

    def time(views: Sequence[Measurement]) -> Cell:
        times = [m.seconds for m in views]
        if len(times) < 2:
            return Cell(number(_mean(times), TIME_DIGITS))
        low, middle, high = (number(time, TIME_DIGITS) for time in quantiles(times, n=4, method="inclusive"))
        return Cell(middle, spread=f"{low} to {high}")

    def evaluations(views: Sequence[Measurement]) -> Cell:
        millions = [m.evaluations / MILLION for m in views if m.evaluations is not None]
        spread = f"± {number(stdev(millions), COUNT_DIGITS)}" if len(millions) > 1 else ""
        return Cell(number(_mean(millions), COUNT_DIGITS), spread=spread)

    several = report.protocol["views"] > 1
    quartiles, deviation = (f"; below, the {of} over the views" * several for of in ("quartiles", "standard deviation"))
    about = f"rendering alone, on the machine that the protocol names{quartiles}"
    columns = [("seconds per view" + ", median" * several, about, time)]
    if any(m.evaluations is not None for m in report.measurements):
        about = f"splat-pixel evaluations of compositing{deviation}"
        columns.append(("million evaluations per view", about, evaluations))
    views = [[report.select(recipe, scale) for scale in report.scales] for recipe in report.recipes]
    return [(title, about, [[cell(each) for each in row] for row in views]) for title, about, cell in columns]


def results(report: Report) -> dict[str, Any]:
    """INRIA's results.json, {method: {metric: mean}}, methods named recipe@scale; the protocol is "_aaplug"."""
    cases = {method(r, s): report.select(r, s) for r in report.recipes for s in report.scales}
    means = {name: {m.name: mean(views, m.name) for m in report.metrics} for name, views in cases.items()}
    return means | {"_aaplug": dict(report.protocol) | {"notes": report.notes}}


def per_view(report: Report) -> dict[str, Any]:
    """INRIA's per_view.json, {method: {metric: {view: value}}}, and samples per pixel side, seconds, evaluations."""
    content = dict[str, Any]()
    for recipe, scale in product(report.recipes, report.scales):
        views = report.select(recipe, scale)
        content[method(recipe, scale)] = {
            **{m.name: {v.view: v.values.get(m.name) for v in views} for m in report.metrics},
            "samples": {v.view: v.samples for v in views},
            "seconds": {v.view: round(v.seconds, 4) for v in views},
            "evaluations": {v.view: v.evaluations for v in views},
        }
    return content | {"_aaplug": dict(report.protocol) | {"notes": report.notes}}


def as_csv(reports: Mapping[str, Report]) -> str:
    """One line per measurement, of all scenes by name; empty where undefined."""
    metrics = list(dict.fromkeys(m.name for report in reports.values() for m in report.metrics))
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    fixed = ("samples", "evaluations", "seconds", "note")
    row_title = next((report.row_title for report in reports.values()), "recipe")
    table.writerow(["scene", "protocol", row_title, "scale", "view", *metrics, *fixed])
    for scene, report in reports.items():
        name = report.protocol.get("protocol", {}).get("name", "")
        for m in report.measurements:
            values = [m.values.get(metric) for metric in metrics]
            extra = (m.samples, m.evaluations, round(m.seconds, 4), m.note)
            table.writerow([scene, name, m.recipe, f"{m.scale:g}", m.view, *values, *extra])
    return text.getvalue()
