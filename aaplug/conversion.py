"""A plain scene file in which the anti-aliasing of training is fused, for a viewer with the 2D Mip filter.

What viewers then need is the Mip rule, 0.1 px² with compensation (or, for a stored 3D filter, what Mip-Splatting's
own fused export needs, which is the same).
"""

from collections.abc import Mapping
from dataclasses import replace

from aaplug.errors import UsageError
from aaplug.filters import MatchedEnergy, Smoothing3D, fuse_stored
from aaplug.gaussians import MIP, Fusion, Gaussians
from aaplug.interfaces import Training, WorldFilter

FORMS: Mapping[str, WorldFilter] = {
    "matched-energy": MatchedEnergy(),
    "mip-splatting": Smoothing3D(),
}


def default_form(scene: Gaussians) -> str:
    """mip-splatting for a scene that stores a 3D filter, matched-energy for all else."""
    return "matched-energy" if scene.filter_3d is None else "mip-splatting"


def convert(scene: Gaussians, training: Training | None, form: WorldFilter) -> Gaussians:
    """Fuse the stored 3D filter if there is one, else what `form` says, and mark the scene for the Mip rule.

    training may be None where the scene stores its filter.

    Raises:
        UsageError: something is fused already, the scene needs nothing, or cameras are missing.
    """
    _check(scene, form)
    if scene.filter_3d is not None:
        converted = fuse_stored(scene)
    elif training is None:
        raise UsageError(_name(scene), "fusing needs the training cameras; pass --cameras")
    else:
        converted = form(scene, training)
    return replace(converted, convention=MIP)


def describe(fusion: Fusion) -> str:
    """One printable phrase, such as "matched-energy (variance=0.2, views=25)"."""
    settings = ", ".join(f"{key}={value}" for key, value in fusion.settings.items())
    return f"{fusion.method} ({settings})" if settings else fusion.method


def _check(scene: Gaussians, form: WorldFilter) -> None:
    if scene.flat:
        raise UsageError(
            _name(scene),
            "holds 2D Gaussians, which no filter here can thicken and stay 2D Gaussians",
        )
    if scene.fused:
        done = "; ".join(describe(fusion) for fusion in scene.fused)
        raise UsageError(
            _name(scene), f"already has {done} fused; converting it again would blur it twice"
        )
    if scene.convention == MIP and scene.filter_3d is None and isinstance(form, MatchedEnergy):
        raise UsageError(
            _name(scene),
            "was trained by the Mip rule and stores no 3D filter: there is nothing to fuse",
        )


def _name(scene: Gaussians) -> str:
    return scene.origin.path if scene.origin else "scene"
