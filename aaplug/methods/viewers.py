"""A plain scene file in which the anti-aliasing of training is fused, for a viewer that follows another rule.

Without a viewer named it is the Mip rule's, 0.1 px² with compensation (or, for a stored 3D filter, what Mip-Splatting's
own fused export needs, which is the same).  A closed form looks at one Gaussian at a time; `aaplug.finetuning` can take
its result as a start.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

from aaplug.core.errors import UsageError
from aaplug.core.gaussians import ANTIALIASED, CLASSIC, MIP, Convention, Fusion, Gaussians
from aaplug.core.interfaces import WorldFilter
from aaplug.core.training import TrainingViews
from aaplug.methods.filters import MatchedEnergy, Smoothing3D, fuse_stored

FORMS: Mapping[str, WorldFilter] = {
    "matched-energy": MatchedEnergy(),
    "mip-splatting": Smoothing3D(),
}
FITTED_VARIANCE = 0.1  # px²: of a scene trained without compensation for a viewer with it, measured
TUNED = "finetune"  # the record of fine-tuning, which blurs nothing


@dataclass(frozen=True)
class Viewer:
    """A program that shows scenes by one rule: the recipe of that rule, and what a file says to ask for it."""

    name: str
    recipe: str
    convention: Convention
    rule: str


VIEWERS: Mapping[str, Viewer] = {
    viewer.name: viewer
    for viewer in (
        Viewer("classic-viewer", "classic", CLASSIC, "0.3 px², not compensated"),
        Viewer("antialiased-viewer", "ewa", ANTIALIASED, "0.3 px², compensated"),
        Viewer("mip-viewer", "mip", MIP, "0.1 px², compensated"),
        Viewer("gsplat", "ewa", ANTIALIASED, 'rasterize_mode="antialiased": 0.3 px², compensated'),
    )
}


def form_for(scene: Gaussians, viewer: Viewer) -> MatchedEnergy:
    """The closed form that brings a scene to a viewer's rule: its missing blur, the energy that training showed."""
    trained, shown = scene.convention, viewer.convention
    fitted = shown.compensated and not trained.compensated
    return MatchedEnergy(FITTED_VARIANCE if fitted else trained.kernel - shown.kernel, shown)


def convert_for(scene: Gaussians, training: TrainingViews, viewer: Viewer) -> Gaussians:
    """A scene for a viewer, in closed form; unchanged where the viewer follows training's own rule.

    Raises:
        UsageError: something is fused already that a second conversion would blur again.
    """
    _check_fused(scene)
    scene = fuse_stored(scene)
    if scene.convention == viewer.convention:
        return scene
    return form_for(scene, viewer)(scene, training)


def default_form(scene: Gaussians) -> str:
    """mip-splatting for a scene that stores a 3D filter, matched-energy for all else."""
    return "matched-energy" if scene.filter_3d is None else "mip-splatting"


def convert(scene: Gaussians, training: TrainingViews | None, form: WorldFilter) -> Gaussians:
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
    _check_fused(scene)
    if scene.convention == MIP and scene.filter_3d is None and isinstance(form, MatchedEnergy):
        raise UsageError(
            _name(scene),
            "was trained by the Mip rule and stores no 3D filter: there is nothing to fuse",
        )


def _check_fused(scene: Gaussians) -> None:
    blurs = [fusion for fusion in scene.fused if fusion.method != TUNED]
    if blurs:
        done = "; ".join(describe(fusion) for fusion in blurs)
        raise UsageError(
            _name(scene), f"already has {done} fused; converting it again would blur it twice"
        )


def _name(scene: Gaussians) -> str:
    return scene.origin.path if scene.origin else "scene"
