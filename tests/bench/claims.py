"""examples/guides/claims.md: each paper's claims about aliasing beside what aaplug measured.

It writes the page from the result files in examples/guides/tables, which `method_tables` makes.
"""

import csv
import re
from collections.abc import Callable
from statistics import fmean
from typing import NamedTuple

from tests.bench.method_tables import PSNR_COLUMN, SCALES, TABLES, made, table

PAGE = TABLES.with_name("claims.md")


class Ours(NamedTuple):
    """A figure that aaplug measured, and the result file that it is read from."""

    file: str
    read: Callable[[], str]

    def __call__(self) -> str:
        """The figure, in words."""
        return self.read()


class Claim(NamedTuple):
    """What a paper claims, and what of it can be repeated here.

    ours: None if it cannot be repeated, for the reason in `what`.
    """

    paper: str
    claim: str
    what: str
    ours: Ours | None = None


def value(scene: str, recipe: str, scale: float, column: str = PSNR_COLUMN) -> float:
    """A figure of a result file."""
    return float(table(scene)[recipe, scale][column])


def _over(scene: str, recipe: str, scales: tuple[float, ...]) -> Ours:
    """PSNR at some scales and their mean."""

    def text() -> str:
        values = [value(scene, recipe, scale) for scale in scales]
        return f"{' '.join(f'{value:.2f}' for value in values)}, mean {fmean(values):.2f} dB"

    return Ours(scene, text)


def _gain(scene: str, recipe: str, other: str, scales: tuple[float, ...]) -> Ours:
    """Mean gain in PSNR of one recipe over another."""
    return Ours(scene, lambda: f"{fmean(value(scene, recipe, s) - value(scene, other, s) for s in scales):+.2f} dB")


def _fall(scene: str, recipe: str, first: float, last: float) -> Ours:
    return Ours(scene, lambda: f"{value(scene, recipe, first):.2f} → {value(scene, recipe, last):.2f} dB")


def _time(rasterizer: str, recipe: str) -> Ours:
    """How much longer a view takes than by `classic`, in percent."""

    def text() -> str:
        with open(TABLES / "times.csv", newline="", encoding="utf-8") as file:
            times = {(line["rasterizer"], line["recipe"]): float(line["ms"]) for line in csv.DictReader(file)}
        return f"{100 * (times[rasterizer, recipe] / times[rasterizer, 'classic'] - 1):+.0f} % time per view at 1"

    return Ours("times", text)


def _work(scene: str, recipe: str, other: str, scale: float) -> Ours:
    """Evaluations of one recipe against another's."""

    def text() -> str:
        work = [value(scene, name, scale, "evaluations (M)") for name in (recipe, other)]
        return f"{work[0] / work[1]:.2f} times the evaluations of {other} at {scale:g}"

    return Ours(scene, text)


ALL, SMALL, LARGE, NEAR = (1.0, 0.5, 0.25, 0.125), (0.5, 0.25, 0.125), (2.0, 4.0, 8.0), (1.0, 2.0, 4.0, 8.0)
MIP, SAGS, MIPMAP = "Mip-Splatting (2311.16493)", "SA-GS (2403.19615)", "Mipmap-GS (2408.06286)"
ANALYTIC, BLENDING, AAA = (
    "Analytic-Splatting (2403.11056)",
    "Gaussian Blending (2511.15102)",
    "AAA-Gaussians (2504.12811)",
)
MULTI, SURFELS, AASPLAT = "Multi-Scale 3DGS (2311.17089)", "AA-2DGS (2506.11252)", "AA-Splat (2603.29394)"
STMT, ZOOM = "NeRF-synthetic, trained at full size", "Mip-NeRF 360, trained at 1/8"
VANILLA = "by its rule on the chair as 3DGS trained it; the paper trains with it"
CLAIMS = (
    Claim(
        MIP,
        f"{STMT}: 3DGS falls from 33.33 to 17.69 dB at 1/8 (mean of four 24.84)",
        "one scene of eight: the chair",
        _over("chair", "classic", ALL),
    ),
    Claim(
        MIP,
        f"{ZOOM}: 3DGS falls from 29.19 to 19.59 dB at 8×",
        "the chair trained at 1/8",
        _fall("chair-eighth", "classic", 1.0, 8.0),
    ),
    Claim(
        MIP,
        f"{ZOOM}: the same, over scales to 4×: 29.19 to 20.71 dB",
        "a capture trained at 1/4",
        _fall("snowmiku-quarter", "classic", 1.0, 4.0),
    ),
    Claim(
        MIP,
        f"{STMT}: 3DGS + EWA reaches 33.51 31.66 27.82 24.63, mean 29.40 dB",
        f"{VANILLA}",
        _over("chair", "ewa", ALL),
    ),
    Claim(
        MIP,
        f"{STMT}: Mip-Splatting reaches 33.36 34.00 31.85 28.67, mean 31.97 dB",
        f"{VANILLA}",
        _over("chair", "mip-splatting", ALL),
    ),
    Claim(MIP, f"{STMT}: +7.13 dB over 3DGS on average", f"{VANILLA}", _gain("chair", "mip-splatting", "classic", ALL)),
    Claim(
        MIP,
        "without the 3D filter 31.90 instead of 31.97 dB: making smaller, the 2D filter is everything",
        "the 2D filter alone on the chair as 3DGS trained it",
        _over("chair", "mip", ALL),
    ),
    Claim(
        MIP,
        f"{ZOOM}: Mip-Splatting reaches 29.39 27.39 26.47 26.22, mean 27.37 dB",
        "the chair trained at 1/8 by 3DGS",
        _over("chair-eighth", "mip-splatting", NEAR),
    ),
    Claim(
        MIP,
        f"{ZOOM}: 3DGS + EWA reaches 29.30 25.90 23.70 22.81, mean 25.43 dB",
        "the chair trained at 1/8 by 3DGS",
        _over("chair-eighth", "ewa", NEAR),
    ),
    Claim(
        MIP, "Mip-NeRF 360 at the training size: 27.79 dB, 3DGS 27.21", "training with the filter is out of scope here"
    ),
    Claim(
        SAGS,
        "a scene as 3DGS trained it, made smaller: the filter alone gains 3.6 dB and more",
        "the same, on the chair",
        _gain("chair", "sa-gs", "classic", SMALL),
    ),
    Claim(SAGS, "the same on a real scene", "the same, on a capture", _gain("snowmiku", "sa-gs", "classic", SMALL)),
    Claim(
        SAGS,
        "enlarged: the filter keeps the look of training",
        "the chair trained at 1/8, 2× to 8×",
        _gain("chair-eighth", "sa-gs", "classic", LARGE),
    ),
    Claim(
        SAGS,
        "integration helps once the filter is on",
        "integration against the filter alone",
        _gain("chair", "sa-gs-integral", "sa-gs", SMALL),
    ),
    Claim(
        SAGS,
        "super-sampling (3×3) helps once the filter is on",
        "samples against the filter alone",
        _gain("chair", "sa-gs-samples", "sa-gs", SMALL),
    ),
    Claim(
        MIPMAP,
        "made smaller: +10.40 dB over 3DGS after adaptation to each scale (34.18 32.51 30.64)",
        "`auto` on the chair, without any adaptation; `aaplug finetune --method mipmap-gs` adapts, in minutes a scale",
        _gain("chair", "auto", "classic", SMALL),
    ),
    Claim(
        MIPMAP,
        "enlarged: +9.25 dB over 3DGS (31.23 28.29 26.43)",
        "`matched` on the chair trained at 1/8; its pseudo truth needs a super-resolution network",
        _gain("chair-eighth", "matched", "classic", LARGE),
    ),
    Claim(
        ANALYTIC,
        "made smaller, integration over the pixel (trained): 33.78 34.20 31.16 27.22, mean 31.59 dB",
        f"{VANILLA}",
        _over("chair", "analytic", ALL),
    ),
    Claim(
        ANALYTIC,
        "about 10 % slower than 3DGS",
        "on a processor, both interpreted; the paper takes a logistic function for the normal distribution, aaplug the "
        "exact one",
        _time("eager", "analytic"),
    ),
    Claim(
        BLENDING,
        "without training again: 33.62 35.72 37.36 36.51, mean 35.80 dB on a scene of Analytic-Splatting",
        "on the chair as 3DGS trained it",
        _over("chair", "gaussian-blending", ALL),
    ),
    Claim(
        BLENDING,
        "+3.85 dB over Mip-Splatting on average (35.58 against 31.73)",
        "on the chair, neither trained for it",
        _gain("chair", "gaussian-blending", "mip-splatting", ALL),
    ),
    Claim(
        AAA,
        "the adaptive 3D filter removes aliasing at any scale (3 times the field of view: 23.58, 3DGS 17.11 dB)",
        "made smaller, on the chair as 3DGS trained it",
        _over("chair", "aaa", ALL),
    ),
    Claim(
        SURFELS,
        "2DGS: 33.05 27.64 20.61 16.59, mean 24.47 dB",
        "the chair's Gaussians drawn as discs",
        _over("chair", "2dgs", ALL),
    ),
    Claim(
        SURFELS,
        "AA-2DGS: 33.24 34.10 32.11 29.00, mean 32.11 dB, 15 to 30 % slower",
        "the same discs, not trained with it",
        _over("chair", "aa-2dgs", ALL),
    ),
    Claim(
        MULTI,
        "+10 dB at 1/64 to 1/128, 160 to 2400 % faster",
        "no checkpoint of the method is public; a photograph of 800 px has 6 px at 1/128",
    ),
    Claim(
        MULTI,
        "fewer Gaussians make small images faster",
        "the cost of `auto` at 1/8, without levels of detail",
        _work("chair", "auto", "classic", 0.125),
    ),
    Claim(
        AASPLAT,
        "+5.4 to 7.5 dB over DepthSplat from 4× to 1/4",
        "a feed-forward network without public code; the formula of its balancing is not published",
    ),
    Claim(
        "LOD-GS (2507.00554)",
        "one filter per scene is blind to the camera's rate (3DGS: 23.38 dB nearer, 35.73 at training's distance)",
        "`aaplug evaluate --protocol distance` moves the cameras; methods.md has its table",
    ),
    Claim(
        "mip-Grid, Mip-VoG, Tri-MipRF",
        "a cost of O(1) per pixel by filtering in advance",
        "grids, not Gaussians; the cost of `matched` against 3DGS at 1/8",
        _work("chair", "matched", "classic", 0.125),
    ),
    Claim(
        "none",
        "filters cost 5 to 10 % of a frame: often said, by none of the papers in these words",
        "`matched` against 3DGS on a processor, both compiled",
        _time("compiled", "matched"),
    ),
    Claim(
        "3DGS (2308.04079)",
        "more than 50 frames per second at 1080p",
        "it needs a graphics card; aaplug draws on a processor",
    ),
)


def pair(claim: Claim) -> tuple[float, float] | None:
    """The paper's figure and ours in dB, where both are a mean over scales or a gain; else None."""
    if claim.ours is None:
        return None
    for pattern in (r"mean (?:of four )?(\d+\.\d+)", r"([+-]\d+\.\d+)(?: dB|$)"):
        said, ours = (re.search(pattern, text) for text in (claim.claim, claim.ours()))
        if said and ours:
            return float(said[1]), float(ours[1])
    return None


def main() -> None:
    """Write the page."""
    PAGE.write_text(page())


def page() -> str:
    """claims.md."""
    lines = [
        "# What the papers claim, and what can be repeated here",
        "",
        "Each row has a claim about aliasing of a paper that [methods.md](methods.md) names, what of it can be",
        "repeated with the scenes at hand, and the figure that aaplug measured. There are two scenes, with few views:",
        "the chair of NeRF-synthetic and a capture. Both were trained by 3DGS. A method that its paper trains with is",
        "drawn by its rule alone, so a lower figure than the paper's says nothing against it. PSNR is in dB, sizes are",
        "relative to training. Photographs are made smaller by box averages, as in [methods.md](methods.md).",
        "",
        f"The figures come from the result files, which {made(*SCALES)}, and of time",
        f"{made('times')} (the least of several views in turn).",
        "One command writes the page from them:",
        "",
        "```bash",
        "python -m tests.bench claims",
        "```",
        "",
        "<!-- plot: claims -->",
        "",
        "| | paper | claim | what is repeated | ours | result file |",
        "|---|---|---|---|---|---|",
    ]
    for number, claim in enumerate(CLAIMS, 1):
        ours, file = "", "none: cannot be repeated"
        if claim.ours is not None:
            ours, file = claim.ours(), f"[{claim.ours.file}](tables/{claim.ours.file}.csv)"
        lines.append(f"| {number} | {claim.paper} | {claim.claim} | {claim.what} | {ours} | {file} |")
    return "\n".join(lines) + "\n"
