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

from aaplug.evaluation.coverage import Coverage
from aaplug.evaluation.image_store import TRUTHS, ImageStore
from aaplug.evaluation.metric import Metric
from aaplug.evaluation.report.pages import assembled
from aaplug.evaluation.report.plots import BOUNDS, Plot
from aaplug.evaluation.results import CEILING, Facts, Report, as_csv, cost_cells, figure_of, metric_cells, scale_name
from aaplug.io.images import encoded, image_size, read_image

LOSSLESS_BYTES = 12_000_000  # of all images; a larger page opens slowly and gets lossy ones
LOSSY_QUALITY = 90  # of WebP
TRUTH = "truth"  # the role of the true image, beside the recipes
AGAINST = {"photographs": "photographs", "self": "the scene's own supersampled look", "reference": "the first scene"}
SHOWN_ELSEWHERE = ("metrics", "view_names")  # parts of the protocol


def page(
    name: str, report: Report, bounds: Coverage, plots: list[Plot], images: ImageStore, facts: Sequence[Facts] = ()
) -> str:
    """The page's text; raises FormatError where an image that it shows is missing.  facts: further tables."""
    variants = report.protocol.get("metrics", {})
    tables = [(m.title, variants.get(m.name, m.protocol), metric_cells(report, m)) for m in report.metrics]
    tables += cost_cells(report)
    return assembled(
        __name__,
        "page.html.j2",
        ("page.css",),
        ("page.js",),
        name=name,
        kind="comparison" if facts else "evaluation",
        report=report,
        scales=[scale_name(scale) for scale in report.scales],
        ceiling=CEILING,
        headline=_headline(report),
        tables=tables,
        fact_tables=facts,
        against=AGAINST[report.protocol["truth"]],
        coverage=bounds,
        scale_name=scale_name,
        plots=[(plot, Markup(plot.inline_svg())) for plot in plots],
        bounds=BOUNDS,
        gallery=_gallery(report, images),
        facts=[(k.replace("_", " "), _text(v)) for k, v in report.protocol.items() if k not in SHOWN_ELSEWHERE],
        csv=as_csv({name: report}),
    )


def _headline(report: Report) -> dict[str, str] | None:
    """Best and worst recipe at the scale farthest below the training size; None where nothing was compared.

    A comparison's reference, which is the truth, is neither.
    """
    for metric in report.compared[:1]:
        for scale in sorted(report.scales, key=lambda s: min(s, 1 / s)):
            means = {r: figure_of(metric, report.select(r, scale)) for r in report.recipes}
            means.pop(report.protocol.get("reference", ""), None)
            ceiling = means.pop(CEILING, None)
            losses = {r: metric.loss(value) for r, value in means.items() if value is not None}
            if losses:
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
    """JSON-ready data for page.js: views, scales and roles of the viewer, and its images with their scores."""
    names, files = report.protocol["view_names"], dict[tuple[int, float], dict[str, Path]]()
    for view, scale in product(images.report_views, report.scales):
        files[view, scale] = {recipe: images.path(view, recipe, scale) for recipe in report.recipes}
        truth = images.path(view, report.recipes[-1], scale, TRUTHS)
        if truth.is_file():
            files[view, scale][TRUTH] = truth
    paths, shots = [path for roles in files.values() for path in roles.values()], []
    webps = {path: encoded(".webp", read_image(path, None)) for path in paths}
    if sum(map(len, webps.values())) > LOSSLESS_BYTES:
        webps = {path: encoded(".webp", read_image(path, None), LOSSY_QUALITY) for path in paths}
    uris = {path: "data:image/webp;base64," + base64.b64encode(webp).decode() for path, webp in webps.items()}
    scores = {  # of the report's first metric against the truth
        (m.view, m.scale, m.recipe): _with_unit(metric, value)
        for metric in report.compared[:1]
        for m in report.measurements
        if (value := m.values.get(metric.name)) is not None
    }
    for (view, scale), roles in files.items():
        width, height = image_size(roles[report.recipes[-1]])
        at, size = (names[view], scale), {"width": width, "height": height}
        pictures = {r: {"uri": uris[path], "score": scores.get((*at, r), "")} for r, path in roles.items()}
        shots.append({"view": names[view], "scale": scale_name(scale), **size, "images": pictures})
    return {
        "views": [names[view] for view in images.report_views],
        "scales": [scale_name(scale) for scale in report.scales],
        "truth": TRUTH,
        "truthName": "photograph" if report.protocol["truth"] == "photographs" else "truth",
        "ceiling": CEILING,
        "recipes": list(report.recipes),
        "shots": shots,
    }


def _with_unit(metric: Metric, value: float | None) -> str:
    """A value in words: 31.20 dB."""
    return f"{metric.text(value)} {metric.unit}".rstrip()
