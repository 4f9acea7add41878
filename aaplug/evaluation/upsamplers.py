"""Upsamplers: an estimate of the truth for views larger than training's.

Bicubic and Lanczos are built in.  A learned one is a file of the user: a network for OpenCV's `dnn_superres` under its
usual name (ESPCN_x4.pb), or a program that maps [1, 3, h, w] in [0, 1] to [1, 3, H, W]: an ONNX network (.onnx), which
OpenCV runs, or torch's (.pt2, `torch.export`).  The network's image is resized to the size asked for: averaged where it
is larger, bicubic where it is smaller.
"""

import re
from collections.abc import Callable
from pathlib import Path

import cv2
import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.system.errors import FormatError, UsageError, reason

Network = Callable[[Float[Tensor, "1 3 h w"]], Tensor]
Upsampler = Callable[[Float[Tensor, "h w 3"], tuple[int, int]], Float[Tensor, "H W 3"]]
OPENCV_NAME = re.compile(r"(edsr|espcn|fsrcnn|lapsrn).*_x(\d)\.pb", re.IGNORECASE)
BYTE = 255.0


def _resized(kernel: int) -> Upsampler:
    return lambda image, hw: torch.from_numpy(cv2.resize(image.numpy(), hw[::-1], interpolation=kernel))


bicubic, lanczos = _resized(cv2.INTER_CUBIC), _resized(cv2.INTER_LANCZOS4)
UPSAMPLERS: dict[str, Upsampler] = {"bicubic": bicubic, "lanczos": lanczos}


def find_upsampler(name: str) -> Upsampler:
    """A built-in upsampler by name, or the network in a file.

    Raises UsageError if the name is neither, and FormatError if the file cannot be read as what its name says.
    """
    if name in UPSAMPLERS:
        return UPSAMPLERS[name]
    path = Path(name)
    if path.suffix not in NETWORKS:
        *kinds, last = (*UPSAMPLERS, f"a {', '.join(NETWORKS)} file")
        raise UsageError("upsampler", f"expected {', '.join(kinds)} or {last}, got '{name}'")
    if not path.is_file():
        raise FormatError(path, "does not exist")
    load, kind = NETWORKS[path.suffix]
    try:
        network = load(path)
    except FormatError:
        raise
    except Exception as error:  # torch and OpenCV fail in many ways on a wrong file
        raise FormatError(path, f"is not {kind}") from error

    def upsample(image: Tensor, hw: tuple[int, int]) -> Tensor:
        try:
            with torch.no_grad():
                larger = network(image.permute(2, 0, 1)[None].contiguous())
        except Exception as error:
            raise FormatError(path, f"fails on {image.shape[1]}x{image.shape[0]} px: {reason(error)}") from error
        if larger.ndim != 4 or larger.shape[1] != image.shape[2]:
            raise FormatError(path, f"should give an image [1, 3, H, W], gives {[*larger.shape]}")
        larger = larger[0].permute(1, 2, 0).contiguous()
        if tuple(larger.shape[:2]) == hw:
            return larger
        return _resized(cv2.INTER_AREA if larger.shape[0] > hw[0] else cv2.INTER_CUBIC)(larger, hw)

    return upsample


def _opencv(path: Path) -> Network:
    match = OPENCV_NAME.fullmatch(path.name)
    if match is None:
        raise FormatError(path, "needs a name such as ESPCN_x4.pb, which gives network and factor")
    network = cv2.dnn_superres.DnnSuperResImpl.create()
    network.readModel(str(path))
    network.setModel(match[1].lower(), int(match[2]))

    def run(image: Tensor) -> Tensor:
        pixels = (image[0].flip(0).permute(1, 2, 0) * BYTE).round().byte().contiguous().numpy()  # BGR
        return torch.from_numpy(network.upsample(pixels)).permute(2, 0, 1).flip(0)[None].float() / BYTE

    return run


def _onnx(path: Path) -> Network:
    network = cv2.dnn.readNetFromONNX(str(path))

    def run(image: Tensor) -> Tensor:
        network.setInput(image.numpy())
        return torch.from_numpy(network.forward())

    return run


NETWORKS = {  # by suffix: how one is loaded, and what it is
    ".pb": (_opencv, "a network that OpenCV can read"),
    ".onnx": (_onnx, "an ONNX network that OpenCV can read"),
    ".pt2": (lambda path: torch.export.load(path).module(), "a program of torch.export"),
}
