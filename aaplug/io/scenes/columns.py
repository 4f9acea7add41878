"""The parameters of Gaussians as the named columns of a .ply, and values in them that no renderer can use."""

from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from aaplug.core.gaussians import MAX_LOG_SCALE, Gaussians
from aaplug.system.errors import UsageError, listing

FILTER_COLUMN = "filter_3D"  # Mip-Splatting's 3D filter: a standard deviation in world units
SHORTEST_QUATERNION = 1e-12  # torch's `normalize` does not normalize a shorter one
DEGREES = {3 * ((d + 1) ** 2 - 1): d for d in range(5)}  # SH degree by number of f_rest columns


def columns_of(scene: Gaussians) -> dict[str, Float[Tensor, " n"]]:
    """The parameters as columns of a .ply, by name, in its order.  A flat scene has two scales.

    f_rest is channel-major: f_rest_(c·(k − 1) + j) is coefficient 1 + j of channel c.
    """

    def numbered(stem: str, table: Float[Tensor, "n c"]) -> dict[str, Tensor]:
        return {f"{stem}_{i}": column for i, column in enumerate(table.unbind(dim=1))}

    columns = dict(zip("xyz", scene.means.unbind(dim=1), strict=True))
    columns |= numbered("f_dc", scene.sh[:, 0]) | numbered("f_rest", scene.sh[:, 1:].transpose(1, 2).flatten(1))
    columns |= {"opacity": scene.logit_opacities, **numbered("scale", scene.log_scales[:, : 2 if scene.flat else 3])}
    columns |= numbered("rot", scene.quats)
    return columns if scene.filter_3d is None else columns | {FILTER_COLUMN: scene.filter_3d}


def scene_of(names: Sequence[str], values: Float[Tensor, "n c"], degree: int, flat: bool) -> Gaussians:
    """The scene in a matrix of named columns, in any order and among others: the inverse of `columns_of`."""
    at = {name: i for i, name in enumerate(names)}
    k = (degree + 1) ** 2

    def chosen(*wanted: str) -> Tensor:
        return values.index_select(1, torch.tensor([at[name] for name in wanted]))

    rest = [f"f_rest_{c * (k - 1) + j}" for j in range(k - 1) for c in range(3)]
    scales = chosen(*(f"scale_{i}" for i in range(2 if flat else 3)))
    if flat:
        scales = torch.nn.functional.pad(scales, (0, 1), value=-MAX_LOG_SCALE)
    return Gaussians(
        means=chosen("x", "y", "z"),
        quats=chosen(*(f"rot_{i}" for i in range(4))),
        log_scales=scales,
        logit_opacities=chosen("opacity")[:, 0],
        sh=chosen(*(f"f_dc_{c}" for c in range(3)), *rest).reshape(-1, k, 3),
        filter_3d=chosen(FILTER_COLUMN)[:, 0] if FILTER_COLUMN in at else None,
        flat=flat,
    )


def faults_of(scene: Gaussians) -> dict[str, Bool[Tensor, " n"]]:
    """Unusable values and their rows: NaN, infinities, quaternions without a direction, negative filters.

    A log-scale of -inf (no thickness) and a logit of -inf (invisible) or +inf (opaque) are valid.
    """
    nans, infinities = dict[str, Tensor](), dict[str, Tensor]()
    finite = all(bool(v.sum().isfinite()) or bool(v.isfinite().all()) for v in scene.columns.values())
    for name, values in ({} if finite else columns_of(scene)).items():
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
