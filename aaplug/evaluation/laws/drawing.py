"""Laws of pixel kernels, compositors and rasterizers: what they draw is what their exact forms say, in float64."""

from dataclasses import replace
from itertools import product
from unittest.mock import patch

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.ellipses import squared_cutoff, whitening
from aaplug.core.interfaces import Compositor, Limits, PixelKernel, Pixels, Rasterizer, ReadsRays, SortsTiles
from aaplug.core.kernels import EAGER
from aaplug.core.rules import RULES_3DGS, Rules
from aaplug.core.splats import Render, Splats2D
from aaplug.methods import PIXEL_KERNELS
from aaplug.methods.pixel_kernels.point import POINT
from aaplug.methods.pixel_kernels.raster_rows import BLUE, RED, TILE, tile_centres
from aaplug.rasterizers.reference import Reference, alphas
from aaplug.rasterizers.tiled import Tiled
from aaplug.rasterizers.tiled.forward import STEP
from aaplug.system.plug_ins import check_answer

from .base import F64, copies_of, make_splats, require, require_same

HW = (33, 44)  # px
BLACK, SKY = (0.0, 0.0, 0.0), (0.25, 0.5, 1.0)
COARSE = Rules(max_alpha=0.9, min_alpha=0.02, min_transmittance=1e-2)
WINDOWS = (0.0, 0.6, 1.0)  # px
CUTOFF_BAND = 1e-3  # relative: nearer to the cut-off, rounding decides
SAME = 2e-5  # of an image's range, in float32
MAX_FLIPS = 1e-3  # share of the pixels that a cut-off may flip


def some_splats(m: int, hw: tuple[int, int], log_sigmas: tuple[float, float], window: float = 1.0) -> Splats2D:
    """Random splats that every kernel can draw, with depth slopes.

    Their horizons lie outside the image: at a disc's horizon AA-2DGS's filter is not small, and the tiled rasterizer
    does not draw it there.
    """
    splats = make_splats(m, hw, 8, log_sigmas).to(F64)
    xx, xy, yy = splats.covs.unbind(dim=1)
    slopes = 0.07 * torch.randn(m, 2, generator=torch.Generator().manual_seed(3), dtype=F64)
    slopes = (slopes / splats.covs[:, [0, 2]].sqrt()).clamp(-0.012, 0.012)
    return replace(splats, dets=xx * yy - xy * xy, depth_slopes=slopes, window=window)


def alpha_is_exact(pixel: PixelKernel) -> None:
    """`alpha` from raster rows is `exact` to 1e-9 in float64 and 2e-5 in float32."""
    for rules, window, dtype, compiling in product((RULES_3DGS, COARSE), WINDOWS, (torch.float32, F64), (False, True)):
        splats = some_splats(60, (2 * TILE, 3 * TILE), (-1.5, 2.5), window)
        corners = torch.cartesian_prod(torch.arange(3), torch.arange(2)).to(dtype) * TILE
        centres = torch.stack(tile_centres(corners), dim=1)
        rows = pixel.raster_rows(splats.to(dtype), EAGER)[:-1, None].expand(-1, len(corners), -1)
        with patch("torch.compiler.is_compiling", lambda: compiling):  # noqa: B023 (called in the same turn)
            limits = Limits(*torch.tensor(Limits.by(rules)).unbind()) if compiling else Limits.by(rules)
            alpha = pixel.alpha(rows, _pixels(pixel, splats, corners, centres), limits)
        points = (corners[:, None] + centres).flatten(0, 1).double()
        exact = pixel.exact(splats, points[:, None] - splats.means)
        shapes = (tuple(alpha.shape), tuple(exact.shape))
        expected = (len(splats), len(corners), len(centres)), (len(points), len(splats))
        require(shapes == expected, f"`alpha` and `exact` are of shapes {shapes}, not {expected}")
        exact = exact * splats.opacities
        exact = exact.T.unflatten(1, alpha.shape[1:])
        expected = torch.where(exact >= rules.min_alpha, exact, 0.0)
        compared = (exact / rules.min_alpha - 1).abs() > CUTOFF_BAND
        difference = (alpha.double() - expected).abs()[compared].max()
        require((expected > 0).sum() > 1000, "draws next to nothing")
        # the compiler's exp2 is a polynomial with a relative error of 1e-6
        most = SAME if dtype == torch.float32 else 2e-6 if compiling else 1e-9
        require(difference < most, f"they differ by {difference:.1e} in {dtype} with a window of {window} px")


def _pixels(
    pixel: PixelKernel, splats: Splats2D, corners: Float[Tensor, "t 2"], centres: Float[Tensor, "P 2"]
) -> Pixels:
    """Pixels of tiles, or their rays, as the pixel kernel reads them."""
    x, y = centres.unbind(dim=1)
    if isinstance(pixel, ReadsRays):
        return Pixels(corners, *pixel.rays(splats, corners[:, :1] + x, corners[:, 1:] + y))
    return Pixels(corners, x, y)


def rows_hold_colours(pixel: PixelKernel) -> None:
    """A raster row has `columns` numbers with the colour, the padding row draws nothing, and a pass is whole steps."""
    splats = some_splats(9, (TILE, TILE), (-1.5, 2.5))
    assert splats.rgb is not None
    rows = pixel.raster_rows(splats, EAGER)
    require(rows.shape == (10, pixel.columns), f"rows are of shape {tuple(rows.shape)}, not {(10, pixel.columns)}")
    torch.testing.assert_close(rows[:-1, RED : BLUE + 1], splats.rgb)
    pixels = _pixels(
        pixel, splats, torch.tensor([[0.0, 0.0], [8.0, 800.0]], dtype=F64), torch.stack(tile_centres(rows), dim=1)
    )
    drawn, padding = (rows[:-1, None].expand(-1, 2, -1), rows[-1:].expand(2, -1))
    require((pixel.alpha(drawn, pixels, Limits.by(RULES_3DGS)) > 0).any(), "draws nothing")
    require(pixel.alpha(padding, pixels, Limits.by(RULES_3DGS)).eq(0).all(), "the padding row draws")
    require(pixel.splats_per_pass % STEP == 0, f"splats_per_pass is no multiple of {STEP}")


def require_bounds(pixel: PixelKernel, splats: Splats2D, rules: Rules) -> None:
    """Raise AssertionError where a pixel is drawn that lies outside of its splat's bounding ellipse."""
    bounds = pixel.bounding_ellipses(splats, rules)
    ellipses = splats if bounds is None else bounds
    require(len(ellipses) == len(splats), f"there are {len(ellipses)} ellipses of {len(splats)} splats")
    points = torch.cartesian_prod(*(torch.arange(-20, side + 20, 2.3, dtype=F64) for side in (64, 48)))
    meets_horizon = ellipses.opacities == 0  # such discs are not drawn
    drawn = (alphas(splats, points, pixel, rules) >= rules.min_alpha) & ~meets_horizon
    white = torch.einsum("cij,pcj->pci", whitening(ellipses), points[:, None] - ellipses.means)
    inside = white.square().sum(dim=2) <= squared_cutoff(ellipses.opacities, rules.min_alpha) * (1 + 1e-9)
    require(drawn.sum() > 1000, "draws next to nothing")
    require(not (drawn & ~inside).any(), "a pixel is drawn outside of its splat's ellipse")


def ellipses_bound_it(pixel: PixelKernel) -> None:
    """`bounding_ellipses` contain every pixel that is drawn."""
    for rules in (RULES_3DGS, COARSE):
        require_bounds(pixel, some_splats(100, (48, 64), (-1.5, 2.5)), rules)


def draws_the_exact_image(pixel: PixelKernel) -> None:
    """The tiled rasterizer draws its exact image, and differentiates it."""
    for window in (0.0, 1.0):
        splats = some_splats(160, HW, (-3.0, 3.0), window)
        exact = Reference()(splats, HW, SKY, pixel)
        torch.testing.assert_close(Tiled()(splats, HW, SKY, pixel).rgb, exact.rgb, rtol=0, atol=1e-9)
        require_same_image(Tiled()(splats.to(torch.float32), HW, SKY, pixel), exact)
    names = ["means", "covs", "opacities", "rgb", *(["depth_slopes"] if pixel.needs_depth_slopes else [])]
    splats, gradients = some_splats(120, (17, 26), (-1.5, 2.5)), []
    for rasterizer in (Tiled(), Reference()):
        values = {name: getattr(splats, name).clone().requires_grad_() for name in names}
        xx, xy, yy = values["covs"].unbind(dim=1)
        # with determinants made of the covariances: kernels may read either
        image = rasterizer(replace(splats, **values, dets=xx * yy - xy * xy), (17, 26), SKY, pixel)
        gradients.append(torch.autograd.grad(image.rgb.square().sum() + image.alpha.sum(), list(values.values())))
    for name, tiled, exact in zip(names, *gradients, strict=True):
        require(exact.abs().max() > 0, f"the gradient of {name} is 0")
        torch.testing.assert_close(tiled, exact, rtol=1e-8, atol=1e-8)


def require_same_image(image: Render, exact: Render) -> None:
    """Raise AssertionError where two images differ by more than flips at a cut-off."""
    difference = (image.rgb.double() - exact.rgb).abs().amax(dim=2)
    require((difference > SAME).double().mean() < MAX_FLIPS, "differs by more than flips at a cut-off")
    require(difference.max() < 0.01, f"differs by {difference.max():.1e} at a pixel")


def composites_the_exact_image(compositor: Compositor) -> None:
    """`tiles` composites what `exact` does."""
    for window, dtype in product(WINDOWS, (torch.float32, F64)):
        splats = some_splats(160, HW, (-3.0, 3.0), window).to(dtype)
        # the integral's ellipses, because a compositor may look at the whole pixel
        pixel = PIXEL_KERNELS["integral"]
        tiled, exact = (draw(splats, HW, SKY, pixel, compositor) for draw in (Tiled(), Reference()))
        require_same_image(tiled, exact)


def draws_what_the_reference_draws(rasterizer: Rasterizer) -> None:
    """Images of any size are the reference's, whatever the rules, order and sizes, and ray slopes if it sorts tiles."""
    sizes, sigmas = ((33, 44), (1, 1), (17, 3)), ((-2.0, 0.0), (0.0, 4.0))
    tilts = (None, 0.0, 2.0) if isinstance(rasterizer, SortsTiles) else (None,)
    for hw, rules, log_sigmas, tilt in product(sizes, (RULES_3DGS, COARSE), sigmas, tilts):
        splats = make_splats(150, hw, seed=1, log_sigmas=log_sigmas)
        if tilt is not None:
            splats = replace(splats, ray_slopes=tilt * (splats.means.roll(1, dims=0) / max(hw)).cos())
        splats = splats[torch.randperm(150, generator=torch.Generator().manual_seed(2))]
        image, exact = (draw(splats, hw, SKY, POINT, rules=rules) for draw in (rasterizer, Reference()))
        check_answer("`__call__`", image, Render)
        require(image.rgb.shape == (*hw, 3) and image.alpha.shape == hw, f"an image of {hw} is of another shape")
        require_same_image(image, exact)
        require((image.alpha.double() - exact.alpha).abs().median() < SAME, "alpha differs")


def keeps_its_splats(rasterizer: Rasterizer) -> None:
    """It keeps its input, gives the same bits again, and draws the background alone without splats."""
    splats = make_splats(300, (60, 70), seed=3)
    before = copies_of(splats)
    first, second = (rasterizer(splats, (60, 70), SKY, POINT) for _ in range(2))
    check_answer("`__call__`", first, Render)
    require_same(splats, before)
    require(first.rgb.equal(second.rgb) and first.alpha.equal(second.alpha), "two runs differ")
    empty = rasterizer(splats[:0], HW, SKY, POINT)
    background = empty.rgb.eq(torch.tensor(SKY, dtype=empty.rgb.dtype)).all() and empty.alpha.eq(0).all()
    require(background, "an image without splats is not the background")
