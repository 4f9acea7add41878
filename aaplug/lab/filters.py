"""The lab's filters, as the registries name them."""

from aaplug.lab.adaptive import Adaptive
from aaplug.lab.smoothing import AnisotropicSmoothing, FlatSmoothing
from aaplug.methods.filters.matched import Matched
from aaplug.methods.filters.smoothing import Smoothing3D

LARGEST_FOCAL = Smoothing3D(focal="largest")
BALANCED = Smoothing3D(opacity="balanced")
ANISOTROPIC = AnisotropicSmoothing()
FLAT = FlatSmoothing()
ADAPTIVE = Adaptive()
SCALE_ADAPTIVE = Matched("global", pixel_variance=0.0)  # SA-GS's
