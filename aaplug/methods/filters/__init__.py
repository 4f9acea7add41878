"""World filters, screen filters and selections by name.  A new one is a file here and a line below."""

from aaplug.core.gaussians import ANTIALIASED, CLASSIC, MIP, PLAYCANVAS, PLAYCANVAS_CLASSIC
from aaplug.core.interfaces import ScreenFilter, Selection, WorldFilter
from aaplug.core.registry import Registry
from aaplug.methods.filters.adaptive import ADAPTIVE_VARIANCE, Adaptive
from aaplug.methods.filters.dilation import Dilation
from aaplug.methods.filters.energy import MATCHED_VARIANCE, MatchedEnergy
from aaplug.methods.filters.low_pass import LowPass
from aaplug.methods.filters.matched import PIXEL_VARIANCE, Matched
from aaplug.methods.filters.pixel_size import ByPixelSize
from aaplug.methods.filters.smoothing import (
    NYQUIST_VARIANCE,
    AnisotropicSmoothing,
    FlatSmoothing,
    Smoothing3D,
    fuse_stored,
)

WORLD_FILTERS: Registry[WorldFilter] = Registry(
    "world filter",
    {
        "smoothing3d": Smoothing3D(),
        "smoothing3d-largest-focal": Smoothing3D(focal="largest"),
        "smoothing3d-balanced": Smoothing3D(opacity="balanced"),
        "smoothing3d-anisotropic": AnisotropicSmoothing(),
        "flat": FlatSmoothing(),
        "matched-energy": MatchedEnergy(),
    },
    WorldFilter,
)

SCREEN_FILTERS: Registry[ScreenFilter] = Registry(
    "screen filter",
    {
        "classic": Dilation.of(CLASSIC),
        "ewa": Dilation.of(ANTIALIASED),
        "mip": Dilation.of(MIP),
        "playcanvas": Dilation.of(PLAYCANVAS),
        "playcanvas-classic": Dilation.of(PLAYCANVAS_CLASSIC),
        "none": Dilation(0.0, compensated=False),
        "aaa": Adaptive(),
        "sa-gs": Matched("global", pixel_variance=0.0),
        "matched": Matched(),
        "matched-global": Matched("global"),
        "matched-sharpest": Matched("sharpest"),
        "matched-interval": Matched("interval"),
    },
    ScreenFilter,
)

SELECTIONS: Registry[Selection] = Registry("selection", {"pixel-size": ByPixelSize()}, Selection)
