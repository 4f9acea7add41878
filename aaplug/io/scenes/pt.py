"""gsplat's checkpoints (.pt): a pickle in a zip, from which torch's restricted loader reads tensors only.

Under the key "splats": means, scales (natural logarithms), quats (wxyz), opacities (logits), sh0 and shN.  The loader
has had holes (CVE-2025-32434, CVE-2026-24747), so torch older than 2.10 is refused, and the user must ask for this
format by `allow_checkpoint`.
"""

import pickle
import re
import warnings
import zipfile
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from aaplug.core.gaussians import MAX_LOG_SCALE, Gaussians
from aaplug.io.limits import whole_limit
from aaplug.io.scenes.columns import DEGREES
from aaplug.io.scenes.ply_tags import run_config
from aaplug.io.scenes.record import Facts
from aaplug.io.scenes.rows import SceneFileOptions, by_name, library_errors
from aaplug.io.scenes.scene import Scene
from aaplug.system.errors import FormatError

SAFE_TORCH = (2, 10)  # the first release without CVE-2026-24747
SHAPES = {"means": (3,), "scales": (3,), "quats": (4,), "opacities": (), "sh0": (1, 3)}
UNKNOWN = Facts("neither the format nor a cfg.yml or cfg.json in the folder above says: assumed classic")

name = "pt"
sniff = by_name(".pt", ".pth", ".ckpt")


def open_scene(path: Path, options: SceneFileOptions) -> Scene:
    """See `SceneFormat`."""
    if not options.allow_checkpoint:
        what = "is a training checkpoint (a pickle)"
        raise FormatError(path, f"{what}; pass `allow_checkpoint` to read it, or export it as .ply")
    version = re.match(r"(\d+)\.(\d+)", torch.__version__)
    if version is None or (int(version[1]), int(version[2])) < SAFE_TORCH:
        raise FormatError(path, f"needs torch 2.10 or newer to be read safely; this is {torch.__version__}")
    with library_errors(path):
        size = path.stat().st_size
        if size > whole_limit("CHECKPOINT"):
            raise FormatError(path, f"has {size:,} bytes; AAPLUG_CHECKPOINT raises the limit")
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
        # torch stores members uncompressed, and would inflate others without a limit
        if any(m.compress_type != zipfile.ZIP_STORED or m.file_size > size for m in members):
            raise FormatError(path, "has compressed members, which torch does not write")
        try:
            with warnings.catch_warnings(action="ignore"):  # torch's, about a damaged pickle
                document = torch.load(path, "cpu", weights_only=True, mmap=True)
        except pickle.UnpicklingError as error:  # torch's own words advise loading everything else too
            raise FormatError(path, "is damaged, or holds more than tensors; nothing of it was run") from error
        splats = _splats(path, document, size)
    count, degree, said = len(splats["means"]), DEGREES[3 * splats["shN"].shape[1]], run_config(path) or UNKNOWN
    return Scene(path, name, count, degree, partial(_rows, splats, said.flat), *said)


def _splats(path: Path, document: Any, size: int) -> dict[str, Tensor]:
    """The tensors by gsplat's names.  One can be a mere description, sparse, nested, quantized or a scalar."""
    splats = document.get("splats", document) if isinstance(document, dict) else None
    if not isinstance(splats, dict) or not all(isinstance(splats.get(k), Tensor) for k in SHAPES):
        raise FormatError(path, f"holds no splats with {', '.join(SHAPES)}, as gsplat writes them")
    tensors = {key: splats[key] for key in (*SHAPES, "shN") if splats.get(key) is not None}
    for key, value in tensors.items():
        dense = isinstance(value, Tensor) and value.layout == torch.strided
        plain = dense and not value.is_nested and not value.is_quantized and value.device.type == "cpu"
        if not plain or value.ndim == 0:
            raise FormatError(path, f"{key} should be a tensor with a row for each Gaussian, on the CPU")
    count = len(tensors["means"])
    tensors = {"shN": torch.zeros(count, 0, 3), **tensors}
    for key, tensor in tensors.items():
        right = tensor.shape[1:] == SHAPES.get(key)
        if key == "shN":
            right = tensor.ndim == 3 and tensor.shape[2] == 3 and 3 * tensor.shape[1] in DEGREES
        if not (right and tensor.is_floating_point() and len(tensor) == count):
            raise FormatError(path, f"{key} is {tensor.dtype} of shape {list(tensor.shape)}, for {count:,} Gaussians")
        if tensor.numel() * tensor.element_size() > size:
            raise FormatError(path, f"{key} has {tensor.numel():,} values, more than the file holds")
    return tensors


def _rows(tensors: dict[str, Tensor], flat: bool, start: int, stop: int) -> Gaussians:
    parts = {key: tensor[start:stop].detach().float().clone() for key, tensor in tensors.items()}
    means, quats, scales, opacities = (parts[key] for key in ("means", "quats", "scales", "opacities"))
    if flat:
        scales[:, 2] = -MAX_LOG_SCALE
    return Gaussians(means, quats, scales, opacities, torch.cat([parts["sh0"], parts["shN"]], dim=1))
