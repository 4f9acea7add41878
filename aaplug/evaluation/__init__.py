"""Measuring images against a truth: protocols, metrics, the truth, the engine, its journal and its reports."""

from typing import TYPE_CHECKING

from aaplug.system.registry import Registry

if TYPE_CHECKING:
    from aaplug.evaluation.metric import Metric
    from aaplug.evaluation.protocols import Protocol

METRICS: Registry["Metric"] = Registry(
    "metric",
    "aaplug.evaluation.metric:Metric",
    {
        "PSNR": "aaplug.evaluation.metrics:PSNR",
        "SSIM": "aaplug.evaluation.metrics:SSIM_WANG",
        "LPIPS": "aaplug.evaluation.lpips:LPIPS",
        "FLIP": "aaplug.evaluation.metrics:FLIP",
        "consistency": "aaplug.evaluation.metrics:CONSISTENCY",
        "energy drift": "aaplug.evaluation.metrics:ENERGY",
        "flicker": "aaplug.evaluation.metrics:FLICKER",
    },
)
PROTOCOLS: Registry["Protocol"] = Registry(
    "protocol",
    "aaplug.evaluation.protocols:Protocol",
    {
        "default": "aaplug.evaluation.protocols:DEFAULT",
        "blender": "aaplug.evaluation.protocols:BLENDER",
        "360-zoom-out": "aaplug.evaluation.protocols:ZOOM_OUT_360",
        "360-zoom-in": "aaplug.evaluation.protocols:ZOOM_IN_360",
        "distance": "aaplug.evaluation.protocols:DISTANCE",
        "fov": "aaplug.evaluation.protocols:FIELD_OF_VIEW",
        "self": "aaplug.evaluation.protocols:SELF",
    },
)
