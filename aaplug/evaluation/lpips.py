"""LPIPS (Zhang et al. 2018, version 0.1) from weight files of the user: a trunk and the linear heads on it.

The trunk is torchvision's VGG16 or AlexNet as a state dict (vgg16-397923af.pth, alexnet-owt-7be5be79.pth), the heads
are the `lpips` package's (weights/v0.1/vgg.pth, alex.pth).  Neither is shipped here.  The net expects colours in
[−1, 1].  3DGS's scripts feed it [0, 1], and published tables follow them, so that is a flavour of its own.
"""

import pickle
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path

import torch
from torch import Tensor
from torch.nn.functional import conv2d, max_pool2d, relu

from aaplug.evaluation.metric import Image, Metric
from aaplug.evaluation.protocols import LpipsFlavour
from aaplug.system.errors import FormatError, UsageError

SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)  # of ImageNet in [−1, 1] (LPIPS)
EPSILON = 1e-10  # added to a feature's length before dividing by it (LPIPS)
MIN_SIDE = 32  # px: smaller images leave nothing after five stages


# A pooling's window and stride in px, then convolutions: number in torchvision's `features`, stride and padding of each
Stage = tuple[tuple[int, int] | None, tuple[tuple[int, int, int], ...]]
NETS: dict[str, tuple[Stage, ...]] = {
    "vgg": (
        (None, ((0, 1, 1), (2, 1, 1))),
        ((2, 2), ((5, 1, 1), (7, 1, 1))),
        ((2, 2), ((10, 1, 1), (12, 1, 1), (14, 1, 1))),
        ((2, 2), ((17, 1, 1), (19, 1, 1), (21, 1, 1))),
        ((2, 2), ((24, 1, 1), (26, 1, 1), (28, 1, 1))),
    ),
    "alex": (
        (None, ((0, 4, 2),)),
        ((3, 2), ((3, 1, 2),)),
        ((3, 2), ((6, 1, 1),)),
        (None, ((8, 1, 1),)),
        (None, ((10, 1, 1),)),
    ),
}
VARIANTS: dict[LpipsFlavour, str] = {
    "3dgs": "3dgs: version 0.1, VGG16 fed [0, 1] as 3DGS's scripts do",
    "vgg": "vgg: version 0.1, VGG16 fed [−1, 1]",
    "alex": "alex: version 0.1, AlexNet fed [−1, 1]",
}


def lpips_metric(flavour: LpipsFlavour, trunk: str | PathLike[str], heads: str | PathLike[str]) -> Metric:
    """LPIPS as a metric, with its weights (torchvision's and the `lpips` package's) in memory.

    Raises FormatError if a file is not the weights of this net.
    """
    net = NETS["alex" if flavour == "alex" else "vgg"]
    state, weights, channels = _state(Path(trunk)), dict[int, tuple[Tensor, Tensor]](), 3
    for number in (number for _, convolutions in net for number, _, _ in convolutions):
        weight, bias = (state.get(f"features.{number}.{part}") for part in ("weight", "bias"))
        if weight is None or bias is None or weight.dim() != 4 or weight.shape[1] != channels:
            problem = f"holds no features.{number} for {channels} channels; give torchvision's weights"
            raise FormatError(Path(trunk), problem)
        weights[number], channels = (weight.float(), bias.float()), weight.shape[0]
    state, linear = _state(Path(heads)), []
    for number, (_, convolutions) in enumerate(net):
        head, count = state.get(f"lin{number}.model.1.weight"), weights[convolutions[-1][0]][0].shape[0]
        if head is None or head.shape != (1, count, 1, 1):
            problem = f"holds no lin{number} of {count} channels; give the lpips package's weights"
            raise FormatError(Path(heads), problem)
        linear.append(head.float())
    return replace(LPIPS, protocol=VARIANTS[flavour], measure=_Distance(net, weights, linear, flavour == "3dgs"))


@dataclass(frozen=True, eq=False)
class _Distance:
    """The distance of two images; from_unit: the net is fed [0, 1].  It can be sent to other processes."""

    net: tuple[Stage, ...]
    weights: dict[int, tuple[Tensor, Tensor]]
    heads: list[Tensor]
    from_unit: bool

    @torch.no_grad()
    def __call__(self, image: Image, truth: Image) -> float | None:
        if min(image.shape[:2]) < MIN_SIDE:
            return None
        pairs = zip(self._features(image), self._features(truth), self.heads, strict=True)
        return float(sum(conv2d((a - b).square(), head).mean() for a, b, head in pairs))

    def _features(self, image: Image) -> list[Tensor]:
        x = image.float() if self.from_unit else 2 * image.float() - 1
        x = ((x - x.new_tensor(SHIFT)) / x.new_tensor(SCALE)).permute(2, 0, 1)[None]
        maps = []
        for pool, convolutions in self.net:
            x = max_pool2d(x, *pool) if pool else x
            for number, stride, padding in convolutions:
                x = relu(conv2d(x, *self.weights[number], stride=stride, padding=padding))
            maps.append(x / (x.square().sum(dim=1, keepdim=True).sqrt() + EPSILON))
        return maps


def _state(path: Path) -> dict[str, Tensor]:
    """A state dict; reading it runs no code from the file."""
    if not path.is_file():
        raise FormatError(path, "there is no such file")
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except (RuntimeError, OSError, EOFError, ValueError, KeyError, pickle.UnpicklingError) as error:
        raise FormatError(path, "is not a file of torch weights") from error
    if not isinstance(state, dict):
        raise FormatError(path, "should hold a state dict")
    return {key: value for key, value in state.items() if isinstance(value, Tensor)}


def _without_weights(image: Image, truth: Image) -> None:
    raise UsageError("LPIPS", "needs weights: see `lpips_metric`")


TOO_SMALL = f"image smaller than the {MIN_SIDE} px that LPIPS needs"
LPIPS = Metric("LPIPS", "", 0.0, 4, "version 0.1", _without_weights, undefined=TOO_SMALL)
