"""Passes of a rendered view as one file, in a format of `IMAGE_FORMATS`.

A pass is a tensor of floats, [height, width, channels] or [height, width].  Colours are premultiplied where there is an
alpha.  A .png or .webp stores them straight, divided by alpha; an .exr or .npz as they are.  Linear colours are decoded
from finished pixels, once: scenes are composited in the display values that training saw.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from aaplug.core.imaging import linear, straight
from aaplug.core.passes import PASSES
from aaplug.io.atomic import AnyPath, replacing, replacing_file, told_by_library, write_file
from aaplug.io.image_formats import COLOURS, Storage
from aaplug.io.images import encoded
from aaplug.system.contracts import contract

INTEROP_IDS = {"srgb": "srgb_rec709_display", "linear": "lin_rec709_scene"}  # of the Color Interop Forum
MAX_HALF = 65504.0  # the largest finite half


@contract
def write_layers(
    path: AnyPath,
    layers: Mapping[str, Float[Tensor, "h w ..."] | Int[Tensor, "h w"]],
    storage: Storage,
    overwrite: bool = False,
) -> None:
    """Write the passes that `storage` names, each of which `layers` holds.

    Raises:
        OutputError: see `replacing`.
        UsageError: a .png, .jpg or .webp is to hold values that are NaN or infinite.
    """
    chosen = {name: layers[name].detach().cpu() for name in storage.passes}
    chosen = {name: layer.float() if layer.is_floating_point() else layer for name, layer in chosen.items()}
    if storage.colour == "linear" and "rgb" in chosen:
        rgb, alpha = chosen["rgb"], chosen.get("alpha")
        chosen["rgb"] = linear(rgb) if alpha is None else linear(straight(rgb, alpha)) * alpha[..., None]
    if storage.format.name == "exr":
        _write_exr(path, chosen, storage, overwrite)
    elif storage.format.name == "npz":
        arrays: dict[str, Any] = {name: layer.numpy() for name, layer in chosen.items()}
        with replacing(path, overwrite) as stream:
            np.savez(stream, colorSpace=COLOURS[storage.colour], **arrays)
    else:
        image, alpha = chosen.get("rgb"), chosen.get("alpha")  # a file of colours, of both straight, or of alpha alone
        if alpha is not None:
            matte = alpha[..., None]
            image = matte if image is None else torch.cat([straight(image, alpha), matte], dim=2)
        assert image is not None
        write_file(path, encoded(f".{storage.format.name}", image, bit_depth=storage.bit_depth), overwrite)


def _write_exr(
    path: AnyPath, layers: Mapping[str, Float[Tensor, "h w ..."]], storage: Storage, overwrite: bool
) -> None:
    """Write a file of named layers, as Blender and Nuke read them: R, G, B, A, depth.Z, normal.X ..."""
    import OpenEXR  # an extra

    channels = dict[str, np.ndarray]()
    for name, layer in layers.items():
        spec = PASSES[name]
        half = storage.bit_depth == 16 and not spec.exact
        for letter, plane in zip(spec.channels, layer.reshape(*layer.shape[:2], -1).unbind(dim=2), strict=True):
            samples = plane.clamp(-MAX_HALF, MAX_HALF).half() if half else plane.float()
            channels[f"{spec.layer}.{letter}".lstrip(".")] = samples.contiguous().numpy()
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    if "rgb" in layers:
        header |= {"colorSpace": COLOURS[storage.colour], "colorInteropID": INTEROP_IDS[storage.colour]}
    with replacing_file(path, overwrite, ".exr") as place, told_by_library(), OpenEXR.File(header, channels) as file:
        file.write(str(place))
