"""What the page's before/after viewer shows: names, scores, and every image as a data URI."""

import base64
from pathlib import Path
from typing import Any

from aaplug.evaluation.image_store import TRUTHS, ImageStore
from aaplug.evaluation.metric import Metric
from aaplug.evaluation.results import CEILING, Report, scale_name
from aaplug.io.images import encode_webp, image_size, read_image

BUDGET = 12_000_000  # bytes of lossless images; a larger page opens slowly and gets lossy ones
LOSSY = 90  # WebP quality above the budget
TRUTH = "truth"  # the role of the true image, beside the recipes

Key = tuple[int, float, str]  # view, scale, and a recipe or TRUTH


def gallery(report: Report, images: ImageStore) -> dict[str, Any]:
    """JSON-ready data for page.js.

    Raises:
        FormatError: an image is missing.
    """
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


def first_compared(report: Report) -> Metric | None:
    """The first of the report's metrics that compares with the truth: the headline and the viewer show it."""
    return next((metric for metric in report.metrics if metric.measure is not None), None)


def with_unit(metric: Metric, value: float | None) -> str:
    """A value in words: 31.20 dB."""
    return f"{metric.text(value)} {metric.unit}".rstrip()


def _shots(report: Report, images: ImageStore) -> list[dict[str, Any]]:
    """The images of every view at every scale."""
    files = _files(report, images)
    uris, scores = _uris(files), _scores(report)
    names = report.protocol["view_names"]
    shots = []
    for view in images.shown:
        for scale in report.scales:
            width, height = image_size(files[view, scale, report.recipes[-1]])
            roles = [key[2] for key in files if key[:2] == (view, scale)]
            shown = {
                role: {"uri": uris[view, scale, role], "score": scores.get((names[view], scale, role), "")}
                for role in roles
            }
            shot = {"view": names[view], "scale": scale_name(scale)}
            shots.append({**shot, "width": width, "height": height, "images": shown})
    return shots


def _files(report: Report, images: ImageStore) -> dict[Key, Path]:
    files: dict[Key, Path] = {}
    for view in images.shown:
        for scale in report.scales:
            for recipe in report.recipes:
                files[view, scale, recipe] = images.path(view, recipe, scale)
            truth = images.path(view, report.recipes[-1], scale, TRUTHS)
            if truth.is_file():
                files[view, scale, TRUTH] = truth
    return files


def _uris(files: dict[Key, Path]) -> dict[Key, str]:
    """Lossless images, or lossy ones where those would exceed the budget."""
    encoded = {key: _webp(path, None) for key, path in files.items()}
    if sum(map(len, encoded.values())) > BUDGET:
        encoded = {key: _webp(path, LOSSY) for key, path in files.items()}
    prefix = "data:image/webp;base64,"
    return {key: prefix + base64.b64encode(webp).decode() for key, webp in encoded.items()}


def _webp(path: Path, quality: int | None) -> bytes:
    return encode_webp(read_image(path, None), quality)


def _scores(report: Report) -> dict[tuple[str, float, str], str]:
    """By view, scale and recipe: the value of the report's first metric against the truth, as text."""
    metric = first_compared(report)
    return {
        (m.view, m.scale, m.recipe): with_unit(metric, value)
        for m in report.measurements
        if metric is not None and (value := m.values.get(metric.name)) is not None
    }
