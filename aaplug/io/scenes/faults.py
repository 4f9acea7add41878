"""Values of Gaussians that no renderer can use."""

from collections.abc import Mapping

import torch
from jaxtyping import Bool
from torch import Tensor

from aaplug.core.gaussians import Gaussians
from aaplug.io.scenes.columns import FILTER_COLUMN, matrix_of
from aaplug.system.errors import UsageError, listing

SHORTEST_QUATERNION = 1e-12  # torch's `normalize` does not normalize a shorter one


def faults_of(scene: Gaussians) -> dict[str, Bool[Tensor, " n"]]:
    """Unusable values and their rows: NaN, infinities, quaternions without a direction, negative filters.

    A log-scale of -inf (no thickness) and a logit of -inf (invisible) or +inf (opaque) are valid.
    """
    nans, infinities = dict[str, Tensor](), dict[str, Tensor]()
    finite = all(bool(v.sum().isfinite()) or bool(v.isfinite().all()) for v in scene.columns.values())
    names, matrix = ([], torch.empty(0, 0)) if finite else matrix_of(scene)
    for name, values in zip(names, matrix.T, strict=True):
        limits = {"opacity": (-torch.inf, torch.inf), "scale": (-torch.inf,)}.get(name.split("_")[0], ())
        nans[f"NaN in {name}"] = values.isnan()
        infinities[f"Inf in {name}"] = values.isinf() & ~torch.isin(values, values.new_tensor(limits))
    length = torch.linalg.vector_norm(scene.quats, dim=-1)
    faults = {**nans, **infinities, "a quaternion of length zero": length <= SHORTEST_QUATERNION}
    faults["a quaternion too long for float32"] = length.isinf() & scene.quats.isfinite().all(dim=-1)
    if scene.filter_3d is not None:
        faults[f"a negative {FILTER_COLUMN}"] = scene.filter_3d < 0
    return {text: rows for text, rows in faults.items() if rows.any()}


def described_faults(faults: Mapping[str, Bool[Tensor, " n"]], start: int = 0) -> str:
    """Faults in words, each with its first row, counted from `start`."""
    words = []
    for text, rows in faults.items():
        first, *others = rows.nonzero()[:, 0].tolist()
        words.append(f"row {start + first}{f' (and {len(others)} more)' if others else ''} has {text}")
    return listing(words)


def usable(scene: Gaussians) -> Gaussians:
    """The Gaussians that renderers can use."""
    faults = faults_of(scene)
    return scene[~torch.stack(list(faults.values())).any(dim=0)] if faults else scene


def check_values(scene: Gaussians) -> None:
    """Refuse Gaussians in memory that no renderer can use."""
    if faults := faults_of(scene):
        raise UsageError(scene.name, f"{described_faults(faults)}; leave such Gaussians out")
