"""Compositors: other ways to turn alphas into light than 3DGS's product of transmittances."""

from aaplug.core.interfaces import Compositor
from aaplug.core.registry import Registry, named
from aaplug.methods.compositors.gaussian_blending import GaussianBlending

COMPOSITORS: Registry[Compositor] = Registry("compositor", named([GaussianBlending()]), Compositor)
