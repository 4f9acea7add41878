"""The report as one page that needs nothing else: no network, no file beside it, no script from elsewhere.

Every name goes through jinja2's escaping or, in the page's script, through textContent.  The page's own policy
forbids anything that it does not hold, and names its one script by hash.
"""

import base64
import hashlib
import json
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any

from jinja2 import Environment, StrictUndefined
from markupsafe import Markup

from aaplug.core.errors import OutputError
from aaplug.evaluation.image_store import RENDERS, TRUTHS, Images
from aaplug.evaluation.metrics import PSNR
from aaplug.evaluation.report.plots import Plot, plots
from aaplug.evaluation.results import (
    CEILING,
    Report,
    as_csv,
    mean,
    rows,
    scale_name,
    work,
)
from aaplug.inspection.coverage import Coverage
from aaplug.io.atomic import replacing
from aaplug.io.images import encode_webp, image_size, read_image

BUDGET = 12_000_000  # bytes of lossless images; a page of more would be slow to open, and gets lossy ones
LOSSY = 90  # WebP's quality then
TRUTH = "truth"
PAGE, PLOTS = "report.html", "plots"


def write_page(
    folder: Path, name: str, report: Report, found: Coverage, images: Images, overwrite: bool
) -> list[Path]:
    """Write report.html, and its plots as PNG and SVG into plots/; gives the paths.

    Raises:
        OutputError: a file exists and `overwrite` is false, or it cannot be written.
        FormatError: an image that the page shows is missing.
    """
    drawn = plots(report, found)
    content = {folder / PAGE: page(name, report, found, drawn, images).encode()}
    for plot in drawn:
        content[folder / PLOTS / f"{plot.name}.png"] = plot.png()
        content[folder / PLOTS / f"{plot.name}.svg"] = plot.svg().encode()
    try:
        (folder / PLOTS).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(
            folder / PLOTS, f"cannot be made: {(error.strerror or str(error)).lower()}"
        ) from error
    for path, data in content.items():
        with replacing(path, overwrite or path.parent.name == PLOTS) as stream:
            stream.write(data)
    return [folder / PAGE, folder / PLOTS]


def page(name: str, report: Report, found: Coverage, drawn: list[Plot], images: Images) -> str:
    """The page's text."""
    source = files("aaplug.evaluation.report.webpage")
    script = source.joinpath("page.js").read_text(encoding="utf-8")
    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    template = environment.from_string(source.joinpath("page.html.j2").read_text(encoding="utf-8"))
    return template.render(
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
        gallery=_gallery(report, images),
        facts=_facts(report.protocol),
        csv=as_csv({name: report}),
        style=Markup(source.joinpath("page.css").read_text(encoding="utf-8")),
        script=Markup(script),
        script_hash=base64.b64encode(hashlib.sha256(script.encode()).digest()).decode(),
    )


def _headline(report: Report) -> dict[str, str] | None:
    """The best recipe at the scale farthest from training's, against the worst; None without a truth."""
    for scale in sorted(report.scales, key=lambda s: min(s, 1 / s)):
        known = {
            recipe: value
            for recipe in report.recipes
            if (value := mean(report.select(recipe, scale), PSNR.name)) is not None
        }
        ceiling = known.pop(CEILING, None)
        if len(known) > 1:
            best, worst = max(known, key=known.__getitem__), min(known, key=known.__getitem__)
            return {
                "scale": scale_name(scale),
                "best": best,
                "best_value": f"{known[best]:.2f}",
                "worst": worst,
                "worst_value": f"{known[worst]:.2f}",
                "ceiling_value": "" if ceiling is None else f"{ceiling:.2f}",
            }
    return None


def _tables(report: Report) -> list[dict[str, Any]]:
    """Title, what it means, and rows of (recipe, cells of (text, best))."""
    variants = report.protocol.get("metrics", {})
    tables = [
        {
            "title": metric.name + (f" [{metric.unit}]" if metric.unit else ""),
            "about": variants.get(metric.name, metric.protocol),
            "rows": list(zip(report.recipes, rows(report, metric), strict=True)),
        }
        for metric in report.metrics
    ]
    about = (
        "rendering alone, on the machine that the protocol names",
        "splat and pixel pairs that compositing evaluated",
    )
    for words, (title, lines) in zip(about, work(report), strict=True):
        cells = [[(text, False) for text in line] for line in lines]
        tables.append(
            {"title": title, "about": words, "rows": list(zip(report.recipes, cells, strict=True))}
        )
    return tables


def _gallery(report: Report, images: Images) -> dict[str, Any]:
    """What the viewer shows: names, PSNR and images as data URIs."""
    names = report.protocol["view_names"]
    files_of: dict[tuple[int, float, str], Path] = {}
    for view in images.shown:
        for scale in report.scales:
            for recipe in report.recipes:
                files_of[view, scale, recipe] = images.path(view, recipe, scale, RENDERS)
            truth = images.path(view, report.recipes[-1], scale, TRUTHS)
            if truth.is_file():
                files_of[view, scale, TRUTH] = truth
    encoded = {key: _webp(path, None) for key, path in files_of.items()}
    if sum(map(len, encoded.values())) > BUDGET:
        encoded = {key: _webp(path, LOSSY) for key, path in files_of.items()}
    values = {(m.view, m.scale, m.recipe): m.values.get(PSNR.name) for m in report.measurements}
    shots = []
    for view in images.shown:
        for scale in report.scales:
            width, height = image_size(files_of[view, scale, report.recipes[-1]])
            shots.append(
                {
                    "view": names[view],
                    "scale": scale_name(scale),
                    "width": width,
                    "height": height,
                    "images": {
                        role: {"uri": _uri(data), "psnr": values.get((names[view], scale, role))}
                        for (v, s, role), data in encoded.items()
                        if (v, s) == (view, scale)
                    },
                }
            )
    return {
        "views": [names[view] for view in images.shown],
        "scales": [scale_name(scale) for scale in report.scales],
        "truth": TRUTH,
        "truthName": "photograph" if report.protocol["truth"] == "photographs" else "truth",
        "ceiling": CEILING,
        "recipes": list(report.recipes),
        "shots": shots,
    }


def _webp(path: Path, quality: int | None) -> bytes:
    return encode_webp(read_image(path, None), quality)


def _uri(webp: bytes) -> str:
    return "data:image/webp;base64," + base64.b64encode(webp).decode()


def _facts(protocol: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The protocol as lines of name and text."""
    hidden = ("metrics", "view_names")
    return [(key.replace("_", " "), _text(value)) for key, value in protocol.items() if key not in hidden]  # fmt: skip


def _text(value: Any) -> str:
    if isinstance(value, Mapping):
        return "\n".join(f"{key}: {_text(item)}" for key, item in value.items())
    if isinstance(value, list | tuple):
        return "; ".join(_text(item) for item in value)
    if value is None:
        return "none"
    return value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
