"""The arguments of gsplat's `rasterization`, checked and taken apart into one view for each image.

b: leading batch dimensions; c: cameras; n: Gaussians; k: spherical-harmonics coefficients per channel; d: channels.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from aaplug.core.cameras import Camera
from aaplug.core.conventions import Convention
from aaplug.core.gaussians import MAX_LOG_SCALE, Gaussians
from aaplug.core.lenses import EQUIDISTANT, ORTHO, PINHOLE, Lens, opencv_lens
from aaplug.core.rules import Rules
from aaplug.io.limits import lack_for_samples
from aaplug.system.contracts import described
from aaplug.system.errors import UsageError, not_one_of

LENSES = {"pinhole": PINHOLE, "ortho": ORTHO, "fisheye": EQUIDISTANT}  # of camera models
COEFFICIENTS = {  # numbers of a camera model's coefficients of distortion
    "radial_coeffs": {"pinhole": 6, "fisheye": 4},
    "tangential_coeffs": {"pinhole": 2},
    "thin_prism_coeffs": {"pinhole": 4},
}

MODES = {
    "render_mode": ("RGB", "D", "ED", "RGB+D", "RGB+ED"),
    "rasterize_mode": ("classic", "antialiased", "matched"),
    "trained_mode": ("classic", "antialiased"),
    "camera_model": tuple(LENSES),
    "depth_mode": ("expected", "median"),
}

FIXED: dict[str, object] = {  # arguments of gsplat 1.5 and 1.6 of which only the default, or its like, is supported
    "sparse_grad": False,
    "absgrad": False,  # of discs
    "distributed": False,
    "camera_model": "pinhole",  # of discs, as the following
    "with_ut": False,
    "radial_coeffs": None,
    "tangential_coeffs": None,
    "thin_prism_coeffs": None,
    "with_eval3d": False,
    "ftheta_coeffs": None,
    "rolling_shutter": "GLOBAL",
    "viewmats_rs": None,
    "rays": None,
    "return_normals": False,
    "lidar_coeffs": None,
    "external_distortion_coeffs": None,
    "extra_signals": None,
    "extra_signals_sh_degree": None,
    "renderer_config": None,
}
WITHOUT_EFFECT = ("macro_tile", "ut_params")  # on classic projection


@dataclass(frozen=True, eq=False)  # `==` is that of `Camera`
class AnyPose(Camera):
    """A camera whose `cam_from_world` may be any affine map, which also makes its gradient that of any matrix."""

    def _check_pose(self) -> None:
        if not torch.linalg.det(self.cam_from_world[:3, :3]).abs() > 0:
            raise UsageError("viewmats", f"expected matrices that can be inverted, got {self.cam_from_world.tolist()}")

    @property
    def centre(self) -> Float[Tensor, " 3"]:
        """Position in the world."""
        return -torch.linalg.solve(self.cam_from_world[:3, :3], self.cam_from_world[:3, 3])


@dataclass(frozen=True)
class Options:
    """The arguments of a call beside its tensors; names and units as in `rasterization`.

    Raises:
        UsageError: a mode is not known, or memory does not hold an image.
    """

    width: int
    height: int
    near_plane: float
    far_plane: float
    radius_clip: float
    eps2d: float
    sh_degree: int | None
    tile_size: int
    render_mode: str
    rasterize_mode: str
    trained_mode: str
    max_alpha: float
    global_z_order: bool = True
    camera_model: str = "pinhole"
    depth_mode: str = "expected"

    def __post_init__(self) -> None:
        for name, modes in MODES.items():
            if getattr(self, name) not in modes:
                raise UsageError(name, not_one_of(getattr(self, name), modes))
        if lacking := lack_for_samples(self.width * self.height):
            raise UsageError("width", f"{self.width}x{self.height} would take {lacking}; a smaller image needs less")

    @property
    def hw(self) -> tuple[int, int]:
        """Height and width, in px."""
        return self.height, self.width

    @property
    def coloured(self) -> bool:
        """True where colours are drawn."""
        return self.render_mode.startswith("RGB")

    def shows(self, middles: Float[Tensor, "m 2"], radii: Float[Tensor, "m 2"]) -> Bool[Tensor, " m"]:
        """Which boxes, of half these sides, reach into the image and are larger than `radius_clip` along an axis."""
        low, high = middles - radii, middles + radii
        inside = (high > 0).all(dim=1) & (low < low.new_tensor([self.width, self.height])).all(dim=1)
        return inside & (radii > self.radius_clip).any(dim=1)

    @property
    def convention(self) -> Convention:
        """How training turned covariances into pixels."""
        rules = Rules(max_alpha=self.max_alpha, near=self.near_plane)
        mode = self.trained_mode if self.rasterize_mode == "matched" else self.rasterize_mode
        return Convention(f"gsplat {mode}", self.eps2d, mode == "antialiased", rules)


@dataclass(frozen=True, eq=False)
class View:
    """One image: its Gaussians and its camera.

    scene: the Gaussians without opacities, which gsplat has activated, so that they may be 0 or 1.
    features: plain colours; None for harmonics, which `scene` has.
    """

    scene: Gaussians
    opacities: Float[Tensor, " n"]
    covars: Float[Tensor, "n 3 3"] | None
    features: Float[Tensor, "n d"] | None
    background: Float[Tensor, " colours"] | None
    camera: Camera


def refuse(others: Mapping[str, object]) -> None:
    """Raise UsageError for an argument that is not known, or asks for something else than gsplat's default.

    None, False and 0 ask for the same, and coefficients of 0 for no distortion.
    """
    for name, value in others.items():
        if name in WITHOUT_EFFECT:
            continue
        if name not in FIXED:
            raise UsageError(name, "is not an argument of this function of gsplat's that aaplug knows")
        default, value = FIXED[name], value.name if isinstance(value, Enum) else value  # gsplat has one of shutters
        if isinstance(value, Tensor):
            same = name.endswith("_coeffs") and not value.any()
        else:
            same = value == default or not (value or default)
        if not same:
            raise UsageError(name, f"only {default} is supported on the CPU, got {described(value)}")


def views_of(
    means: Tensor,
    quats: Tensor | None,
    scales: Tensor | None,
    opacities: Tensor,
    colors: Tensor | None,
    viewmats: Tensor,
    Ks: Tensor,
    backgrounds: Tensor | None,
    covars: Tensor | None,
    relative_rate: float | Tensor | None,
    options: Options,
    coefficients: Sequence[Tensor | None] = (None, None, None),
) -> list[View]:
    """One view for each camera of each batch, in this order; shapes as in `rasterization`.

    coefficients: of distortion, as `COEFFICIENTS`.

    Raises:
        UsageError: shapes do not fit each other, or a camera is not of the options' model.
    """
    *batch, n, _ = means.shape
    c = viewmats.shape[-3]
    if not math.prod((*batch, c)):
        raise UsageError("viewmats", f"expected cameras, got a tensor of {list(viewmats.shape)}")
    for name, x in {"viewmats": viewmats, "Ks": Ks}.items():
        if not x.isfinite().all():
            raise UsageError(name, "expected finite numbers, got NaN or infinity")
    if covars is not None:
        quats, scales = means.new_zeros(*batch, n, 4), torch.ones_like(means)
    elif quats is None or scales is None:
        raise UsageError("covars", "expected quats and scales, or covars")
    degree = options.sh_degree
    if colors is None:
        if options.coloured:
            raise UsageError("colors", f"expected colours for render_mode {options.render_mode}, got None")
        colors, backgrounds = opacities[..., None], None
    if colors.dim() < len(batch) + (2 if degree is None else 3):
        wanted = "[*b, n, d]" if degree is None else f"[*b, n, k, 3] for sh_degree {degree}"
        raise UsageError("colors", f"expected a tensor {wanted}, got {described(colors)}")
    channels = colors.shape[-1:] if degree is None else (*colors.shape[-2:-1], 3)
    per_camera = colors.dim() == len(batch) + 2 + len(channels)
    check_shape("colors", colors, (*batch, *((c,) if per_camera else ()), n, *channels))
    if degree is not None and not 0 <= degree < colors.shape[-2] ** 0.5:
        raise UsageError("sh_degree", f"{degree} needs {(degree + 1) ** 2} coefficients, colors has {colors.shape[-2]}")
    if backgrounds is not None:
        check_shape("backgrounds", backgrounds, (*batch, c, 3 if degree is not None else colors.shape[-1]))
    others = {"quats": quats, "scales": scales, "opacities": opacities, "colors": colors, "covars": covars}
    for name, x in {**others, "backgrounds": backgrounds}.items():
        if x is not None and x.dtype != means.dtype:
            raise UsageError(name, f"expected {means.dtype}, as means have, got {x.dtype}")
    columns = [
        *(_per_image(x, batch, c) for x in (means, quats, scales, opacities, covars)),
        _per_image(colors, batch, c, per_camera),
        *(_per_image(x, batch, c, per_camera=True) for x in (backgrounds, viewmats, Ks)),
        _rates(relative_rate, (*batch, c), options),
        _lenses(coefficients, (*batch, c), options.camera_model),
    ]
    views = []
    for mean, quat, scale, opacity, covar, colour, background, viewmat, K, rate, lens in zip(*columns, strict=True):
        (fx, skew, cx), (below, fy, cy), last = K.tolist()
        if skew != 0 or below != 0 or last != [0, 0, 1] or not (fx > 0 and fy > 0):
            raise UsageError("Ks", f"expected fx, 0, cx; 0, fy, cy; 0, 0, 1 with fx and fy above 0, got {K.tolist()}")
        camera = AnyPose("", options.width, options.height, fx, fy, cx, cy, viewmat.double(), lens=lens)
        if rate is not None:
            camera = replace(camera, trained_focal=camera.focal / rate)
        log_scales = scale.abs().clamp(min=math.exp(-MAX_LOG_SCALE)).log()
        sh = mean.new_zeros(n, 1, 3) if degree is None else colour[:, : (degree + 1) ** 2]
        scene = Gaussians(mean, quat, log_scales, torch.zeros_like(opacity), sh, options.convention)
        views.append(View(scene, opacity, covar, colour if degree is None else None, background, camera))
    return views


def check_shape(name: str, x: Tensor, shape: Sequence[int]) -> None:
    """Raise UsageError for another shape."""
    if tuple(x.shape) != tuple(shape):
        raise UsageError(name, f"expected shape [{', '.join(map(str, shape))}], got {list(x.shape)}")


def _per_image(x: Tensor | None, batch: Sequence[int], c: int, per_camera: bool = False) -> list[Any]:
    """A tensor's part for each image, None for no tensor; with `per_camera` it has a dimension of cameras."""
    if x is None:
        return math.prod(batch) * c * [None]
    parts = x.reshape(math.prod(batch), *x.shape[len(batch) :])
    return [part for scene in parts.unbind() for part in (scene.unbind() if per_camera else c * [scene])]


def _rates(relative_rate: float | Tensor | None, shape: Sequence[int], options: Options) -> list[float | None]:
    """Each image's sampling rate relative to training; None for every mode but "matched"."""
    if (relative_rate is not None) != (options.rasterize_mode == "matched"):
        raise UsageError("relative_rate", 'belongs to rasterize_mode="matched", which needs it')
    if relative_rate is None:
        return [None for _ in range(math.prod(shape))]
    rates = torch.as_tensor(relative_rate, dtype=torch.float64)
    if rates.dim() > 0:
        check_shape("relative_rate", rates, shape)
    if not ((rates > 0) & rates.isfinite()).all():
        raise UsageError("relative_rate", f"expected finite numbers above 0, got {relative_rate}")
    return rates.expand(*shape).flatten().tolist()


def _lenses(coefficients: Sequence[Tensor | None], shape: Sequence[int], model: str) -> list[Lens]:
    """Each image's lens.  coefficients: as `COEFFICIENTS`."""
    rows = []
    for (name, counts), x in zip(COEFFICIENTS.items(), coefficients, strict=True):
        count = counts.get(model, 0)
        if x is None or not x.any():
            x = torch.zeros(*shape, count)
        elif not count:
            raise UsageError(name, f"camera_model {model} has none, got {described(x)}")
        check_shape(name, x, (*shape, count))
        if not x.isfinite().all():
            raise UsageError(name, "expected finite numbers, got NaN or infinity")
        rows.append(x.flatten(0, -2).tolist())
    lenses = []
    for radial, tangential, prism in zip(*rows, strict=True):
        distorted = opencv_lens((*radial[:2], *tangential, *radial[2:], *prism), fisheye=model == "fisheye")
        lenses.append(distorted if distorted.distorts else LENSES[model])
    return lenses
