"""The report as one self-contained page: no network, no file beside it, no foreign script.

Every name passes through jinja2's escaping or, in the page's script, through textContent.  The page's
content security policy allows only what the page holds, and names its one script by hash.
"""

import base64
import json
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

from markupsafe import Markup

from aaplug.evaluation.image_store import TRUTHS, ImageStore
from aaplug.evaluation.metric import Metric
from aaplug.evaluation.report.plots import BOUNDS, Plot
from aaplug.evaluation.results import CEILING, Facts, Report, as_csv, mean, rows, scale_name, work
from aaplug.inspection.coverage import Coverage
from aaplug.io.images import encode_webp, image_size, read_image
from aaplug.pages import assembled

COSTS = (  # what the tables of `work` mean
    "rendering alone, on the machine that the protocol names; below, the quartiles over the views",
    "splat-pixel evaluations of compositing; below, the standard deviation over the views",
)
BUDGET = 12_000_000  # bytes of lossless images; a larger page opens slowly and gets lossy ones
LOSSY = 90  # WebP quality above the budget
TRUTH = "truth"  # the role of the true image, beside the recipes
AGAINST = {"photographs": "photographs", "self": "the scene's own supersampled look", "reference": "the first scene"}
HIDDEN = ("metrics", "view_names")  # parts of the protocol that the page shows elsewhere

Key = tuple[int, float, str]  # view, scale, and a recipe or TRUTH


def page(
    name: str, report: Report, found: Coverage, drawn: list[Plot], images: ImageStore, facts: Sequence[Facts] = ()
) -> str:
    """The page's text; raises FormatError where an image that it shows is missing.  facts: further tables."""
    return assembled(
        __name__,
        "page.html.j2",
        ("page.css",),
        ("page.js",),
        name=name,
        report=report,
        protocol=dict(report.protocol),
        scales=[scale_name(scale) for scale in report.scales],
        ceiling=CEILING,
        headline=_headline(report),
        tables=_tables(report),
        fact_tables=facts,
        against=AGAINST[report.protocol["truth"]],
        notes=report.notes,
        coverage=found,
        scale_name=scale_name,
        plots=[(plot, Markup(plot.inline_svg())) for plot in drawn],
        bounds=BOUNDS,
        gallery=_gallery(report, images),
        facts=[(k.replace("_", " "), _text(v)) for k, v in report.protocol.items() if k not in HIDDEN],
        csv=as_csv({name: report}),
    )


def _headline(report: Report) -> dict[str, str] | None:
    """Best and worst recipe at the scale farthest below the training size; None where nothing was compared."""
    metric = next(iter(report.compared), None)
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
                "best_value": _with_unit(metric, means[best]),
                "worst": worst,
                "worst_value": _with_unit(metric, means[worst]),
                "ceiling_value": "" if ceiling is None else _with_unit(metric, ceiling),
            }
    return None


def _tables(report: Report) -> list[dict[str, Any]]:
    """Title, what it means, and rows of (recipe, cells)."""
    variants = report.protocol.get("metrics", {})
    tables = [
        (metric.title, variants.get(metric.name, metric.protocol), rows(report, metric)) for metric in report.metrics
    ]
    tables += [(title, about, cells) for about, (title, cells) in zip(COSTS, work(report), strict=False)]
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


def _gallery(report: Report, images: ImageStore) -> dict[str, Any]:
    """JSON-ready data for page.js: what the before/after viewer shows."""
    names = report.protocol["view_names"]
    return {
        "views": [names[view] for view in images.shown],
        "scales": [scale_name(scale) for scale in report.scales],
        "truth": TRUTH,
        "truthName": "photograph" if report.protocol["truth"] == "photographs" else "truth",
        "ceiling": CEILING,
        "recipes": list(report.recipes),
        "shots": _shots(report, images),
    }


def _with_unit(metric: Metric, value: float | None) -> str:
    """A value in words: 31.20 dB."""
    return f"{metric.text(value)} {metric.unit}".rstrip()


def _shots(report: Report, images: ImageStore) -> list[dict[str, Any]]:
    """The images of every view at every scale, with their scores."""
    files, scores, shots = _files(report, images), _scores(report), []
    uris = _uris(files)
    for view, scale in product(images.shown, report.scales):
        name = report.protocol["view_names"][view]
        width, height = image_size(files[view, scale, report.recipes[-1]])
        shown = {
            role: {"uri": uri, "score": scores.get((name, scale, role), "")}
            for (of, at, role), uri in uris.items()
            if (of, at) == (view, scale)
        }
        size = {"width": width, "height": height}
        shots.append({"view": name, "scale": scale_name(scale), **size, "images": shown})
    return shots


def _files(report: Report, images: ImageStore) -> dict[Key, Path]:
    files: dict[Key, Path] = {}
    for view, scale in product(images.shown, report.scales):
        files |= {(view, scale, recipe): images.path(view, recipe, scale) for recipe in report.recipes}
        truth = images.path(view, report.recipes[-1], scale, TRUTHS)
        if truth.is_file():
            files[view, scale, TRUTH] = truth
    return files


def _uris(files: dict[Key, Path]) -> dict[Key, str]:
    """Lossless images, or lossy ones where those would exceed the budget."""

    def encoded_at(quality: int | None) -> dict[Key, bytes]:
        return {key: encode_webp(read_image(path, None), quality) for key, path in files.items()}

    encoded = encoded_at(None)
    if sum(map(len, encoded.values())) > BUDGET:
        encoded = encoded_at(LOSSY)
    prefix = "data:image/webp;base64,"
    return {key: prefix + base64.b64encode(webp).decode() for key, webp in encoded.items()}


def _scores(report: Report) -> dict[tuple[str, float, str], str]:
    """By view, scale and recipe: the value of the report's first metric against the truth, as text."""
    metric = next(iter(report.compared), None)
    return {
        (m.view, m.scale, m.recipe): _with_unit(metric, value)
        for m in report.measurements
        if metric is not None and (value := m.values.get(metric.name)) is not None
    }
