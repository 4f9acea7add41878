"""Metrics by name.

A package adds one by an entry point in the group "aaplug.metrics": a `Metric` with a `measure` of image and truth.
"""

import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from aaplug.core.errors import UsageError, listing
from aaplug.core.registry import Registry
from aaplug.evaluation.figures import CONSISTENCY, ENERGY, FLICKER
from aaplug.evaluation.lpips import LPIPS
from aaplug.evaluation.metric import Metric, MetricOptions, SsimFlavour
from aaplug.evaluation.protocols import Protocol
from aaplug.evaluation.similarity import FLIP_DEGREE, SSIM_WINDOW, flip, psnr, ssim

PSNR = Metric(
    "PSNR",
    "dB",
    math.inf,
    2,
    "peak 1, over all channels, mean of per-view values",
    psnr,
    undefined="equal images: PSNR is infinite and left out of the mean",
)


def _ssim(flavour: SsimFlavour, border: str) -> Metric:
    return Metric(
        "SSIM",
        "",
        1.0,
        4,
        f"{flavour}: {SSIM_WINDOW}×{SSIM_WINDOW} Gaussian, sigma 1.5, {border}, channel mean",
        partial(ssim, flavour=flavour),
        undefined="image smaller than the SSIM window",
        prepare=lambda options: SSIM[options.ssim],
    )


SSIM: dict[SsimFlavour, Metric] = {
    "wang": _ssim("wang", "border cropped"),
    "3dgs": _ssim("3dgs", "zero-padded, border kept"),
}
FLIP = Metric("FLIP", "", 0.0, 4, f"LDR-FLIP, mean, {FLIP_DEGREE} px a degree", flip)

METRICS: Registry[Metric] = Registry(
    "metric",
    {metric.name: metric for metric in (PSNR, SSIM["wang"], LPIPS, FLIP, CONSISTENCY, ENERGY, FLICKER)},
    check=lambda value: isinstance(value, Metric) and (value.measure is None) != (value.figure is None),
)


def find_metrics(
    names: Sequence[str], protocol: Protocol, lpips_weights: tuple[Path, Path] | None = None
) -> list[Metric]:
    """Metrics by name, in the flavours of a protocol.

    Args:
        names: of `METRICS`, in any case, "-" for a space: "psnr", "energy-drift".
        protocol: see `PROTOCOLS`.
        lpips_weights: files of LPIPS's trunk and heads; only LPIPS needs them.

    Raises:
        UsageError: a name is not known or given twice, or a metric lacks what it needs.
        FormatError: a file of weights cannot be read.
    """
    known = {metric_option(name): metric for name, metric in METRICS.items()}
    wanted = [metric_option(name) for name in names]
    for name in wanted:
        if name not in known:
            options = listing(list(known), most=len(known))
            raise UsageError("metric", f"'{name}' is not one of {options}")
    if len(set(wanted)) != len(wanted):
        raise UsageError("metric", "a metric is named twice")
    options = MetricOptions(protocol.ssim, protocol.lpips, lpips_weights)
    return [known[name].prepared(options) for name in wanted]


def default_metrics(protocol: Protocol) -> tuple[str, ...]:
    """Names of what is measured where the user chooses nothing."""
    figures = (CONSISTENCY, ENERGY) if protocol.change == "size" else ()
    return tuple(metric_option(m.name) for m in (PSNR, SSIM[protocol.ssim], *figures))


def metric_option(name: str) -> str:
    """A metric's name as an option's value."""
    return name.casefold().replace(" ", "-")
