"""Rules of web viewers, measured: single black splats on white, whose alpha a Gaussian is fitted to.

It needs Node.js, npm and Chromium.  Round splats of 0.05 to 4 px stand 46 px apart, 40 units away, at the centres of
pixels.  Columns: the variance that the viewer adds along x and y, in px², a median over splats of 0.4 to 1 px; what is
left of the opacity of a splat of 0.5 px, and what `VIEWERS` says; how many standard deviations the widest splats reach
in 8 bits (an alpha of 0.8 ends at 3.1 by rounding alone); and the smallest splat that is drawn, in px, against the
largest that `VIEWERS` says is dropped.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from statistics import median

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug import SH_C0, VIEWERS, Camera, Gaussians
from aaplug.core.conventions import CLASSIC
from tests.bench import heading, row
from tests.bench.viewers import PAGES

SIZE, FOCAL, DISTANCE = 800, 4000.0, 40.0  # px, px, units
SIGMAS = (0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.5, 0.6, 0.8, 1.0, 1.5, 2.0, 3.0, 4.0)  # px
OPACITIES = (204 / 255, 51 / 255)  # without rounding in 8 bits
PITCH, MARGIN, REACH = 46, 50, 19  # px
FAINT = 3 / 255  # alpha: fainter pixels are not fitted


def main(work: Path = Path("out/single-splats"), rows: Sequence[str] = tuple(PAGES)) -> None:
    """Print the table.  work: folder of scene and pictures.  rows: of `VIEWERS` that a page shows."""
    steps = [round(16 * (math.log(s * DISTANCE / FOCAL) + 10)) / 16 - 10 for s in SIGMAS]  # what a .spz holds
    places = [(MARGIN + PITCH * i, MARGIN + PITCH * j) for j in range(len(OPACITIES)) for i in range(len(SIGMAS))]
    middles = torch.tensor(places) + 0.5 - SIZE / 2
    scene = Gaussians(
        means=torch.cat([middles * DISTANCE / FOCAL, torch.full((len(places), 1), DISTANCE)], dim=1),
        log_scales=torch.tensor(steps * len(OPACITIES))[:, None].repeat(1, 3),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(len(places), 1),
        logit_opacities=torch.tensor([o for o in OPACITIES for _ in SIGMAS]).logit(),
        sh=torch.full((len(places), 1, 3), -0.5 / SH_C0),
        convention=CLASSIC,
    )
    view = Camera(
        "splats", cam_from_world=torch.eye(4), fx=FOCAL, fy=FOCAL, cx=SIZE / 2, cy=SIZE / 2, width=SIZE, height=SIZE
    )
    heading("single splats", "`--for`", "adds x", "y", "opacity", "by the rule", "reaches (σ)", "smallest", "dropped")
    for name in rows:
        viewer, page = VIEWERS[name.split()[0]], PAGES[name]
        alpha = 1 - page.shot(scene, work / "shown", {0: view}, work / name)[0][..., 0]
        sigmas = [math.exp(step) * FOCAL / DISTANCE for step in steps]
        fits = [_fit(alpha, place) for place in places]
        bright = list(zip(sigmas, fits, strict=False))
        added = [[f[axis] - s * s for s, f in bright if f and 0.4 <= s <= 1.05] for axis in (1, 2)]
        kept = [(s, f[0] / OPACITIES[0]) for s, f in bright if f and 0.45 < s < 0.65]
        assert viewer.convention is not None
        kernel = viewer.convention.kernel
        rule = kept[0][0] ** 2 / (kept[0][0] ** 2 + kernel) if viewer.convention.compensated else 1.0
        drawn = [s for s, (x, y) in zip(sigmas, places, strict=False) if alpha[y, x] > FAINT]
        least = math.sqrt(max(0.0, viewer.smallest - kernel, viewer.apart - kernel))
        reach = max(f[3] for s, f in bright if f and s > 1.9)
        row(name, *(f"{median(a):.3f}" for a in added), kept[0][1], rule, reach, min(drawn), least)


def _fit(alpha: Float[Tensor, "h w"], place: tuple[int, int]) -> tuple[float, float, float, float] | None:
    """Opacity, variances along x and y, and reach of the splat at a pixel; None where too few pixels show it.

    log alpha = log o + b·d - dx²/2vx - dy²/2vy, by least squares weighted with alpha; b finds the centre.
    """
    x, y = place
    window = alpha[y - REACH : y + REACH + 1, x - REACH : x + REACH + 1].double()
    d = torch.arange(-REACH, REACH + 1, dtype=torch.float64)
    dy, dx = torch.meshgrid(d, d, indexing="ij")
    clear = window > FAINT
    if clear.sum() < 6:
        return None
    columns = torch.stack([torch.ones_like(dx), dx, dy, -(dx**2) / 2, -(dy**2) / 2], dim=-1)[clear]
    weights = window[clear]
    fitted = torch.linalg.lstsq(columns * weights[:, None], (weights.log() * weights)[:, None]).solution
    c, bx, by, px, py = fitted.flatten().tolist()
    if min(px, py) <= 0:
        return None
    far = ((dx - bx / px) ** 2 * px + (dy - by / py) ** 2 * py)[window > 0.5 / 255].max().sqrt()
    return math.exp(c + (bx * bx / px + by * by / py) / 2), 1 / px, 1 / py, float(far)
