"""Filters by name; a new one is a file here and a line below."""

from aaplug.filters.adaptive import ADAPTIVE_VARIANCE, Adaptive
from aaplug.filters.dilation import Dilation
from aaplug.filters.energy import MATCHED_VARIANCE, MatchedEnergy
from aaplug.filters.low_pass import LowPass
from aaplug.filters.matched import PIXEL_VARIANCE, Matched, RateChoice
from aaplug.filters.pixel_size import ByPixelSize
from aaplug.filters.smoothing import (
    NYQUIST_VARIANCE,
    AnisotropicSmoothing,
    FlatSmoothing,
    Smoothing3D,
    StoredSmoothing,
    fuse_stored,
)
from aaplug.interfaces import ScreenFilter, Selection, WorldFilter

WORLD_FILTERS: dict[str, WorldFilter] = {
    "smoothing3d": Smoothing3D(),
    "smoothing3d-largest-focal": Smoothing3D(focal="largest"),
    "smoothing3d-balanced": Smoothing3D(opacity="balanced"),
    "smoothing3d-anisotropic": AnisotropicSmoothing(),
    "flat": FlatSmoothing(),
    "stored": StoredSmoothing(),
    "matched-energy": MatchedEnergy(),
}

SCREEN_FILTERS: dict[str, ScreenFilter] = {
    "classic": Dilation(0.3, compensated=False),
    "ewa": Dilation(0.3, compensated=True),
    "mip": Dilation(0.1, compensated=True),
    "none": Dilation(0.0, compensated=False),
    "aaa": Adaptive(),
    "sa-gs": Matched("global", pixel_variance=0.0),
    "matched": Matched(),
    "matched-global": Matched("global"),
    "matched-sharpest": Matched("sharpest"),
    "matched-interval": Matched("interval"),
}

SELECTIONS: dict[str, Selection] = {"pixel-size": ByPixelSize()}

__all__ = [
    "ADAPTIVE_VARIANCE",
    "MATCHED_VARIANCE",
    "NYQUIST_VARIANCE",
    "PIXEL_VARIANCE",
    "SCREEN_FILTERS",
    "SELECTIONS",
    "WORLD_FILTERS",
    "Adaptive",
    "AnisotropicSmoothing",
    "ByPixelSize",
    "Dilation",
    "FlatSmoothing",
    "LowPass",
    "Matched",
    "MatchedEnergy",
    "RateChoice",
    "Smoothing3D",
    "StoredSmoothing",
    "fuse_stored",
]
