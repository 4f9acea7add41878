"""Metrics: those that compare an image with a truth, and figures of one renderer, which need no truth.

Images are [h, w, 3] in [0, 1].  A value that is not defined (images too small) or infinite (equal images) is None.

SSIM comes in the two flavours that the field's tables mix: "wang" crops the border that the window overhangs, as
scikit-image with Gaussian weights and torchmetrics do; "3dgs" pads with zeros and keeps the border, as 3DGS's own
script does, and so reads higher the smaller the image (by 0.003 at 512 px, 0.0085 at 64 px).
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import Any, get_args

import cv2
import numpy as np
from jaxtyping import Float
from torch import Tensor

from aaplug.evaluation import METRICS
from aaplug.evaluation.lpips import LPIPS, lpips_metric
from aaplug.evaluation.metric import Image, Metric, Series
from aaplug.evaluation.protocols import LpipsFlavour, Protocol, SsimFlavour
from aaplug.io.atomic import AnyPath
from aaplug.system.errors import UsageError, not_one_of
from aaplug.system.extras import check_installed
from aaplug.system.registry import spelt

SSIM_WINDOW = 11  # px: the Gaussian of SSIM_SIGMA, cut at 3.5 sigma (Wang et al. 2004)
SSIM_SIGMA = 1.5  # px
FLIP_PX_PER_DEGREE = 67  # FLIP's default, a 0.7 m wide 4K screen seen from 0.7 m
FLAVOURS = {"ssim": get_args(SsimFlavour), "lpips": get_args(LpipsFlavour)}
LUMINANCE = (0.2126, 0.7152, 0.0722)  # Rec. 709, on the values as stored


def psnr(image: Image, truth: Image) -> float | None:
    """Peak signal-to-noise ratio over all channels, in dB, for a peak of 1; None for equal images."""
    a, b = image.cpu().numpy(), truth.to(image.dtype).cpu().numpy()
    error = cv2.norm(a, b, cv2.NORM_L2SQR) / a.size  # summed in float64
    return None if error == 0 else -10 * math.log10(error)


def ssim(image: Image, truth: Image, flavour: SsimFlavour = "wang") -> float | None:
    """Structural similarity (Wang et al. 2004, eq. 13), the channels' mean; None for images smaller than the window."""
    if min(image.shape[:2]) < SSIM_WINDOW:
        return None
    from skimage.metrics import structural_similarity  # takes half a second to import

    a, b = (x.double().cpu().numpy() for x in (image, truth))
    if flavour == "3dgs":  # scikit-image crops the border that is added here, and nothing else
        border = SSIM_WINDOW // 2
        a, b = (np.pad(x, ((border, border), (border, border), (0, 0))) for x in (a, b))
    value: Any = structural_similarity(
        a, b, channel_axis=2, data_range=1.0, gaussian_weights=True, sigma=SSIM_SIGMA, use_sample_covariance=False
    )
    return float(value)


def flip(image: Image, truth: Image) -> float | None:
    """Mean of the LDR-FLIP map (Andersson et al. 2020) at the default viewing distance; 0 for equal images.

    Raises UsageError if the package that computes it is not installed.
    """
    check_installed("flip_evaluator", "flip", "FLIP", "needs the package flip-evaluator")
    import flip_evaluator  # pyright: ignore[reportMissingImports]

    a, b = (np.ascontiguousarray(x.float().cpu().numpy()) for x in (truth, image))
    _, value, _ = flip_evaluator.evaluate(a, b, "LDR", True, False, True, {"ppd": FLIP_PX_PER_DEGREE})
    return float(value)


def energy(rgb: Image) -> float:
    """Mean luminance (Rec. 709)."""
    means = cv2.mean(rgb.cpu().numpy())  # summed in float64
    return sum(weight * mean for weight, mean in zip(LUMINANCE, means, strict=False))


def energy_drift(image: Image, expected: Float[Tensor, "H W 3"]) -> float | None:
    """Relative excess of an image's light over the expected light; None where none is expected."""
    light = energy(expected)
    return None if light == 0 else energy(image) / light - 1


def flicker(frames: Sequence[Image], motion: Sequence[Image]) -> float | None:
    """RMS change from frame to frame, over that of `motion` alone; None where nothing moves.

    Above 1 the image shimmers, below 1 it is blurred.
    """
    actual, expected = (sum(float((b - a).double().square().mean()) for a, b in pairwise(x)) for x in (frames, motion))
    return None if expected == 0 else math.sqrt(actual / expected)


def _consistency(series: Series) -> float | None:
    if series.full is None:
        return None
    return psnr(series.image.rgb.clamp(0, 1), series.smaller(series.full.rgb.clamp(0, 1)))


def _energy_drift(series: Series) -> float | None:
    if series.full is None:
        return None
    rows, columns = (math.ceil(side / series.scale) for side in series.image.rgb.shape[:2])
    return energy_drift(series.image.light, series.full.light[:rows, :columns])


def _flicker(series: Series) -> float | None:
    return None if series.frames is None else flicker(*series.frames())


EQUAL = "equal images: PSNR is infinite and left out of the mean"
PSNR = Metric("PSNR", "dB", math.inf, 2, "peak 1, over all channels, mean of per-view values", psnr, undefined=EQUAL)


def _ssim(flavour: SsimFlavour, border: str) -> Metric:
    variant = f"{flavour}: {SSIM_WINDOW}×{SSIM_WINDOW} Gaussian, sigma 1.5, {border}, channel mean"
    small, measure = "image smaller than the SSIM window", partial(ssim, flavour=flavour)
    return Metric("SSIM", "", 1.0, 4, variant, measure, undefined=small)


SSIM: dict[SsimFlavour, Metric] = {
    "wang": _ssim("wang", "border cropped"),
    "3dgs": _ssim("3dgs", "zero-padded, border kept"),
}
SSIM_WANG = SSIM["wang"]
FLIP = Metric("FLIP", "", 0.0, 4, f"LDR-FLIP, mean, {FLIP_PX_PER_DEGREE} px a degree", flip)
CONSISTENCY = Metric(
    "consistency",
    unit="dB",
    ideal=math.inf,
    digits=2,
    protocol="PSNR of the image against the recipe's own training-size image, box-averaged; null at and above that "
    "size, where the two are equal, and where scale 1 is not measured",
    figure=_consistency,
    undefined="it needs scale 1 among the scales",
    smaller=True,
)
ENERGY = Metric(
    "energy drift",
    unit="",
    ideal=0.0,
    digits=4,
    protocol="luminance of what is drawn, without the background, over the recipe's own at the training size, minus 1; "
    "null where scale 1 is not measured",
    figure=_energy_drift,
    undefined="it needs scale 1 among the scales",
)
FLICKER = Metric(
    "flicker",
    unit="",
    ideal=1.0,
    digits=3,
    protocol="frame-to-frame change over three steps of 1/4 px, or over the next three frames of a scene in time, over "
    "that of the training-size image, averaged down: "
    "1 is motion alone; null at and above the training size",
    figure=_flicker,
    undefined="it needs frames that differ",
    smaller=True,
)


def find_metrics(
    names: str | Sequence[str] | None, protocol: Protocol, lpips_weights: tuple[AnyPath, AnyPath] | None = None
) -> list[Metric]:
    """Metrics by name, in the flavours of a protocol where the names state none.

    names: of `METRICS`, in any case, "-" for a space: "psnr", "energy-drift", "ssim:wang"; None for the usual ones.
    lpips_weights: files of LPIPS's trunk and heads, which is then among the metrics; only LPIPS needs them.

    Raises UsageError if a name is not known or given twice or a metric lacks what it needs, and FormatError.
    """
    names = default_metrics(protocol) if names is None else (names,) if isinstance(names, str) else names
    parts = [spelt(name).partition(":") for name in names]
    if lpips_weights is not None and not any(name == "lpips" for name, _, _ in parts):
        parts.append(("lpips", "", ""))
    for name, colon, flavour in parts:
        if colon and flavour not in FLAVOURS.get(name, ()):
            flavours = [f"{metric}:{f}" for metric in FLAVOURS for f in FLAVOURS[metric]]
            raise UsageError("metric", not_one_of(f"{name}:{flavour}", flavours))
    options = {spelt(name): metric for name, metric in METRICS.items()}
    if unknown := [name for name, _, _ in parts if name not in options]:
        raise UsageError("metric", not_one_of(unknown[0], options))
    metrics = [options[name] for name, _, _ in parts]
    if len(set(metrics)) != len(metrics):
        raise UsageError("metric", "a metric is named twice")
    protocol = replace(protocol, **{name: flavour for name, _, flavour in parts if flavour})
    flavoured = {"SSIM": SSIM[protocol.ssim]}
    if LPIPS in metrics:
        if lpips_weights is None:
            raise UsageError("LPIPS", "needs weights: --lpips TRUNK HEADS")
        flavoured["LPIPS"] = lpips_metric(protocol.lpips, *lpips_weights)
    return [flavoured.get(metric.name, metric) for metric in metrics]


def default_metrics(protocol: Protocol) -> tuple[str, ...]:
    """Names of what is measured where the user chooses nothing."""
    figures = (CONSISTENCY, ENERGY) if protocol.change == "size" else ()
    return tuple(spelt(m.name) for m in (PSNR, SSIM[protocol.ssim], *figures))
