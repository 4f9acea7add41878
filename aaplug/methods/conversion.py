"""Conversion: fusing anti-aliasing into a plain scene, for viewers that have only a fixed 2D filter.

`fuse` targets the Mip rule (0.1 px², compensated), `fuse_for` a named viewer.  Each Gaussian is converted
independently; `aaplug.finetuning` can then optimize all of them together.
"""

from collections.abc import Sequence
from dataclasses import replace

from aaplug.core.conventions import MIP, Convention
from aaplug.core.convolution import fuse_stored
from aaplug.core.gaussians import Fusion, Gaussians
from aaplug.core.training import TrainingViews
from aaplug.methods.filters.energy import MATCHED_ENERGY, MatchedEnergy
from aaplug.methods.filters.smoothing import BY_VOLUME, Smoothing3D
from aaplug.methods.viewers import Viewer
from aaplug.system.errors import UsageError

FITTED_VARIANCE = 0.1  # px² at the median training rate, best measured; from uncompensated training to compensation
TUNED = "finetune"  # method that fine-tuning records in `Gaussians.fused`; it adds no blur
MERGED = "merge"  # method that levels of detail record; it keeps what blur there is

Form = MatchedEnergy | Smoothing3D  # a closed-form conversion to the Mip rule
FORMS: dict[str, Form] = {"matched-energy": MATCHED_ENERGY, "mip-splatting": BY_VOLUME}
MERGE_ALONE = "`aaplug merge` of it alone changes the format"


def fuse(scene: Gaussians, training: TrainingViews | None, form: Form = MATCHED_ENERGY) -> Gaussians:
    """Convert a scene to the Mip rule: fuse its stored 3D filter, or apply `form` if it stores none.

    2D Gaussians keep their rule; `Smoothing3D` smooths them within their planes.

    training: may be None if the scene stores a 3D filter.

    Raises UsageError if something is fused already, the scene needs nothing, or cameras are missing.
    """
    smooths = isinstance(form, Smoothing3D)
    if not smooths:
        _check_discs(scene)
    _check_unblurred(scene)
    if not smooths and scene.convention == MIP and scene.filter_3d is None:
        problem = "was trained by the Mip rule and stores no 3D filter: there is nothing to fuse"
        raise UsageError(scene.name, f"{problem}; {MERGE_ALONE}")
    if scene.filter_3d is not None:
        converted = fuse_stored(scene)
    elif training is None:
        raise UsageError(scene.name, "has no stored 3D filter: its conversion needs the training cameras")
    else:
        converted = form(scene, training)
    return converted if scene.flat else replace(converted, convention=MIP)


def fuse_for(scene: Gaussians, training: TrainingViews, viewer: Viewer) -> Gaussians:
    """Convert a scene for a viewer, which sees only the harmonics that it draws.

    If the viewer draws as training did, only a stored 3D filter is fused.

    Raises UsageError if the scene holds 2D Gaussians, or the viewer has a rule of its own and blur is already fused.
    """
    _check_discs(scene)
    if viewer.convention is None:
        return fuse_stored(scene)
    _check_unblurred(scene)
    scene = fuse_stored(viewer.shown(scene))
    trained, shown = scene.convention, viewer.convention
    if trained == shown:
        return scene
    fitted = shown.compensated and not trained.compensated
    return MatchedEnergy(FITTED_VARIANCE if fitted else trained.kernel - shown.kernel, shown)(scene, training)


def carried(scene: Gaussians, training: TrainingViews, convention: Convention) -> Gaussians:
    """The scene with the energy and the width that training showed, as one of another convention.

    Widths are exact where the other kernel is smaller, but opacities are capped; where it is larger, Gaussians are
    thinned as far as they can be.  Raises UsageError for 2D Gaussians.
    """
    if scene.convention == convention:
        return scene
    _check_discs(scene)
    variance = scene.convention.kernel - convention.kernel
    if convention.compensated and not scene.convention.compensated:  # the smallest need room to keep their energy
        variance = max(variance, FITTED_VARIANCE)
    return MatchedEnergy(variance, convention)(scene, training)


def blurring(fused: Sequence[Fusion]) -> list[Fusion]:
    """The fusions that added blur: all but merging and fine-tuning."""
    return [fusion for fusion in fused if fusion.method not in (MERGED, TUNED)]


def describe(fusion: Fusion) -> str:
    """One printable phrase, such as "matched-energy (variance=0.2, views=25)"."""
    settings = ", ".join(f"{key}={value}" for key, value in fusion.settings.items())
    return f"{fusion.method} ({settings})" if settings else fusion.method


def described_fusions(fused: Sequence[Fusion]) -> str:
    """The filters fused into a scene, in words."""
    return "; ".join(map(describe, fused)) or "nothing"


def _check_discs(scene: Gaussians) -> None:
    if scene.flat:
        works = "form mip-splatting smooths them within their planes, for 2DGS's own renderers"
        raise UsageError(scene.name, f"holds 2D Gaussians, whose pixel filter no other rule can replace; {works}")


def _check_unblurred(scene: Gaussians) -> None:
    if blurs := blurring(scene.fused):
        problem = f"already has {described_fusions(blurs)} fused, and converting it again would blur it twice"
        raise UsageError(scene.name, f"{problem}; convert the scene that it was made of, or {MERGE_ALONE}")
