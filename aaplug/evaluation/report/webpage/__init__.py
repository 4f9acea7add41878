"""The report as one self-contained page: no network, no file beside it, no foreign script.

Every name passes through jinja2's escaping or, in the page's script, through textContent.  The page's
content security policy allows only what the page holds, and names its one script by hash.
"""

import base64
import hashlib
import json
from collections.abc import Mapping
from importlib.resources import files
from typing import Any

from jinja2 import Environment, StrictUndefined
from markupsafe import Markup

from aaplug.evaluation.image_store import ImageStore
from aaplug.evaluation.report.plots import BOUNDS, Plot
from aaplug.evaluation.report.webpage.gallery import first_compared, gallery, with_unit
from aaplug.evaluation.results import CEILING, Report, as_csv, mean, rows, scale_name, work
from aaplug.inspection.coverage import Coverage

COSTS = (  # what the tables of `work` mean
    "rendering alone, on the machine that the protocol names",
    "splat-pixel evaluations of compositing",
)
HIDDEN = ("metrics", "view_names")  # parts of the protocol that the page shows elsewhere


def page(name: str, report: Report, found: Coverage, drawn: list[Plot], images: ImageStore) -> str:
    """The page's text.

    Raises:
        FormatError: an image that the page shows is missing.
    """
    template, style, script = map(_source, ("page.html.j2", "page.css", "page.js"))
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    return environment.from_string(template).render(
        name=name,
        report=report,
        protocol=dict(report.protocol),
        scales=[scale_name(scale) for scale in report.scales],
        ceiling=CEILING,
        headline=_headline(report),
        tables=_tables(report),
        notes=list(dict.fromkeys(m.note for m in report.measurements if m.note)),
        coverage=found,
        scale_name=scale_name,
        plots=[(plot, Markup(plot.inline_svg())) for plot in drawn],
        bounds=BOUNDS,
        gallery=gallery(report, images),
        facts=[(k.replace("_", " "), _text(v)) for k, v in report.protocol.items() if k not in HIDDEN],
        csv=as_csv({name: report}),
        style=Markup(style),
        script=Markup(script),
        script_hash=base64.b64encode(hashlib.sha256(script.encode()).digest()).decode(),
    )


def _source(name: str) -> str:
    return files("aaplug.evaluation.report.webpage").joinpath(name).read_text(encoding="utf-8")


def _headline(report: Report) -> dict[str, str] | None:
    """Best and worst recipe at the scale farthest below the training size; None where nothing was compared."""
    metric = first_compared(report)
    if metric is None:
        return None
    for scale in sorted(report.scales, key=lambda s: min(s, 1 / s)):
        means = {r: mean(report.select(r, scale), metric.name) for r in report.recipes}
        ceiling = means.pop(CEILING, None)
        losses = {r: metric.loss(value) for r, value in means.items() if value is not None}
        if len(losses) > 1:
            best, worst = min(losses, key=losses.__getitem__), max(losses, key=losses.__getitem__)
            return {
                "scale": scale_name(scale),
                "best": best,
                "best_value": with_unit(metric, means[best]),
                "worst": worst,
                "worst_value": with_unit(metric, means[worst]),
                "ceiling_value": "" if ceiling is None else with_unit(metric, ceiling),
            }
    return None


def _tables(report: Report) -> list[dict[str, Any]]:
    """Title, what it means, and rows of (recipe, cells of (text, whether it is the best))."""
    variants = report.protocol.get("metrics", {})
    tables = [
        (metric.title, variants.get(metric.name, metric.protocol), rows(report, metric)) for metric in report.metrics
    ]
    for about, (title, lines) in zip(COSTS, work(report), strict=False):
        tables.append((title, about, [[(text, False) for text in line] for line in lines]))
    return [
        {"title": title, "about": about, "rows": list(zip(report.recipes, cells, strict=True))}
        for title, about, cells in tables
    ]


def _text(value: Any) -> str:
    """A value of the protocol as lines of text."""
    if isinstance(value, Mapping):
        return "\n".join(f"{key}: {_text(item)}" for key, item in value.items())
    if isinstance(value, list | tuple):
        return "; ".join(_text(item) for item in value)
    if value is None:
        return "none"
    return value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
