"""Mipmap-GS's zoom-in with upsamplers: the chair trained at 100x100, adapted to 4 times that size.

A network comes from the npm package @upscalerjs/esrgan-slim (MIT), which ships weights: `npm pack` and `tar xzf`, then
`--network package/models/x4`.  Its layers are written here in torch, as a .pt2 that any user of `--upsampler` can make.
"""

import json
import math
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import conv2d, interpolate, pad

from aaplug.evaluation.upsamplers import find_upsampler
from aaplug.verbs.finetune import finetune
from tests.bench import row
from tests.bench.literature import photographs, psnr
from tests.bench.scenes import decibels, trained

SCALE, VIEWS = 4, 5
BYTE = 255.0  # the network's range
MARGIN = 8  # px repeated around the image, or convolutions would darken its edge


def main(network: Path | None = None, steps: int = 200) -> None:
    """Print PSNR at 4x: of images upsampled, and of renders after adaptation towards them.

    Args:
        network: folder of a model.json of TensorFlow.js, made of convolutions; None leaves it out.
        steps: of each adaptation.
    """
    torch.set_num_threads(1)
    opened = trained("chair_eighth")
    truths = photographs(opened, (1.0, SCALE), opened.views(VIEWS))
    with TemporaryDirectory() as folder:
        upsamplers = ["bicubic", "lanczos"]
        if network is not None:
            upsamplers.append(str(exported(network, Path(folder) / "network.pt2")))
        for recipe in ("classic", "matched"):
            row(f"`{recipe}`", *psnr(opened.renderer(recipe), truths))
        for name in upsamplers:
            larger = find_upsampler(name)
            with torch.no_grad():
                found = [decibels(larger(opened.renderer("classic")(v).rgb.clamp(0, 1), v.scaled(SCALE).hw), i[SCALE])
                         for v, i in truths]  # fmt: skip
            row(f"the image, {Path(name).stem}", "", f"{sum(found) / len(found):.2f}")
        for name in [*upsamplers, None]:
            options = {"method": "mipmap-gs", "scale": (float(SCALE),), "truth": "self", "views": truths[0][0].name}
            tuned = finetune(opened.scene, opened.cameras, None, steps=steps, upsampler=name, **options)
            adapted = replace(opened, scene=tuned.scene).renderer("classic")
            guess = Path(name).stem if name else "our own guess"
            row(f"adapted to {guess}, {steps} steps", *psnr(adapted, truths))


class Layers(torch.nn.Module):
    """A network of Keras as TensorFlow.js stores it: convolutions of padding "same", and what joins them."""

    def __init__(self, folder: Path):
        super().__init__()
        model = json.loads((folder / "model.json").read_text())
        self.layers = model["modelTopology"]["model_config"]["config"]["layers"]
        groups = model["weightsManifest"]
        stored = b"".join((folder / path).read_bytes() for group in groups for path in group["paths"])
        values, start = torch.from_numpy(np.frombuffer(stored, "<f4").copy()), 0
        for weight in (weight for group in groups for weight in group["weights"]):
            size = math.prod(weight["shape"])
            value = values[start : start + size].view(weight["shape"])
            order = (3, 2, 0, 1) if value.ndim == 4 else (0,)
            self.register_buffer(weight["name"].replace("/", "_"), value.permute(order).contiguous())
            start += size

    def forward(self, image: Tensor) -> Tensor:
        """An image [1, 3, h, w] in [0, 1], enlarged."""
        made: dict[str, Tensor] = {}
        for layer in self.layers:
            name, inputs = layer["name"], [made[node[0]] for nodes in layer["inbound_nodes"] for node in nodes]
            match layer["class_name"]:
                case "InputLayer":
                    made[name] = BYTE * pad(image, 4 * [MARGIN], mode="replicate")
                case "Conv2D":
                    weight, bias = (self.get_buffer(f"{name}_{each}") for each in ("kernel", "bias"))
                    made[name] = conv2d(inputs[0], weight, bias, padding="same")
                case "Activation":
                    made[name] = inputs[0].relu()
                case "Concatenate":
                    made[name] = torch.cat(inputs, dim=1)
                case "Add":
                    made[name] = torch.stack(inputs).sum(dim=0)
                case "UpSampling2D":
                    made[name] = interpolate(inputs[0], scale_factor=float(layer["config"]["size"][0]))
                case other:
                    raise ValueError(f"{name}: layers of kind {other} are not known")
        margin, larger = MARGIN * SCALE, made[self.layers[-1]["name"]].div(BYTE).clamp(0, 1)
        return larger[:, :, margin:-margin, margin:-margin]


def exported(folder: Path, path: Path) -> Path:
    """The network as a torch program for images of any size."""
    sides = {2: torch.export.Dim("h", min=8), 3: torch.export.Dim("w", min=8)}
    torch.export.save(torch.export.export(Layers(folder), (torch.rand(1, 3, 16, 20),), dynamic_shapes=(sides,)), path)
    return path
