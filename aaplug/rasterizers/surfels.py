"""Discs where rays meet them: 2DGS (Huang et al. 2024), and AA-2DGS (Younes et al., NeurIPS 2025).

A disc of covariance C on the screen, at its centre, has its own coordinates e = B d there, B a whitening of C and d px
from the centre.  Away from the centre perspective divides: with the tilt n, depth is that of the centre over
w = 1 − n·d, and the ray meets the disc at s = e / w, in its standard deviations.  This is 2DGS's intersection (eq. 10)
by the matrix inversion lemma; it needs two numbers more than a Gaussian on the screen.

"surfel" is 2DGS: exp(−ρ/2) with ρ = min(|s|², 2 |d|²/r²), the second a low-pass filter of √½ px, for training's pixels
(r is `Splats2D.window`).  "surfel-mip" is AA-2DGS's object-space Mip filter: with J = ds/dd = (B + s nᵀ)/w and
V = I + 0.1 J Jᵀ it is det V^−½ exp(−sᵀ V⁻¹ s/2) (section 6 of the notes that it is from gives the expanded form).
"""

import torch
from torch import Tensor

from aaplug.rasterizers.pixels import widened
from aaplug.splats import Splats2D, reach

LOW_PASS = 2.0  # 1/px²: 2DGS's filter of √½ px, squared and inverted
DISC_VARIANCE = 0.1  # px²: AA-2DGS's object-space Mip filter
LEAST_FACTOR = 1e-8  # under the root of AA-2DGS's factor, as published
NARROWEST = 1e-3  # px: of a low-pass filter, which is divided by
IN_FRONT = 1e-3  # of the centre's inverse depth: what is farther is taken for the horizon


def disc(e: tuple[Tensor, Tensor], ahead: Tensor, squared: Tensor, window: Tensor) -> Tensor:
    """2DGS's value.  e: the whitened offset.  ahead: w.  squared: |d|², in px²."""
    ahead = ahead.clamp(min=IN_FRONT)
    on_disc = (e[0] * e[0] + e[1] * e[1]) / (ahead * ahead)
    return (-0.5 * torch.minimum(on_disc, LOW_PASS * squared / (window * window))).exp()


def smoothed_disc(
    e: tuple[Tensor, Tensor], ahead: Tensor, forms: tuple[Tensor, ...], tilts: tuple[Tensor, Tensor]
) -> Tensor:
    """AA-2DGS's value.  forms: ux, uy, vx, vy of the whitening."""
    ahead = ahead.clamp(min=IN_FRONT)
    s, t = e[0] / ahead, e[1] / ahead
    ux, uy, vx, vy = forms
    j00, j01 = (ux + s * tilts[0]) / ahead, (uy + s * tilts[1]) / ahead
    j10, j11 = (vx + t * tilts[0]) / ahead, (vy + t * tilts[1]) / ahead
    k = DISC_VARIANCE
    area = j00 * j11 - j01 * j10
    size = j00 * j00 + j01 * j01 + j10 * j10 + j11 * j11
    det = 1 + k * size + k * k * area * area
    across = (j10 * s - j00 * t) ** 2 + (j11 * s - j01 * t) ** 2
    return (1 / det + LEAST_FACTOR).sqrt() * (-0.5 * (s * s + t * t + k * across) / det).exp()


def discs_reach(splats: Splats2D, smoothed: bool) -> Splats2D:
    """Splats whose alpha ≥ 1/255 ellipses hold the discs' and their filters'; opacity 0 for what meets the horizon.

    |e|² ≤ R w² is an ellipse around −R C n / (1 − R q) with the covariance (C + R C n nᵀ C / (1 − R q)) / (1 − R q),
    q = nᵀ C n, as long as R q < 1.
    """
    assert splats.tilts is not None
    reached = reach(splats.opacities).clamp(min=torch.finfo(splats.means.dtype).tiny)
    xx, xy, yy = splats.covs.unbind(dim=1)
    nx, ny = splats.tilts.unbind(dim=1)
    cx, cy = xx * nx + xy * ny, xy * nx + yy * ny
    left = 1 - reached * (nx * cx + ny * cy)
    near = left > IN_FRONT
    left = left.clamp(min=IN_FRONT)
    shift = -reached / left
    stretch = reached / left
    covs = torch.stack(
        [xx + stretch * cx * cx, xy + stretch * cx * cy, yy + stretch * cy * cy], dim=1
    )
    ellipses = Splats2D(
        means=splats.means + shift[:, None] * torch.stack([cx, cy], dim=1),
        covs=covs / left[:, None],
        dets=splats.dets / left**3,
        depths=splats.depths,
        opacities=torch.where(near, splats.opacities, 0.0),
        sources=splats.sources,
        rgb=splats.rgb,
    )
    variance = DISC_VARIANCE if smoothed else max(splats.window, NARROWEST) ** 2 / LOW_PASS
    return widened(ellipses, (variance * reached).sqrt())
