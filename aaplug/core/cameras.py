"""Cameras: the conventions for axes, pixel centres, and the order of height and width.

Camera frame: x right, y down, z forward (OpenCV).  Pixel (0, 0) covers [0, 1) × [0, 1); its centre is (0.5, 0.5).
`cam_from_world` is float64: scenes far from the origin keep their digits until the camera's centre is subtracted.
Sizes and focal lengths may differ from view to view.
"""

import hashlib
import json
import math
import operator
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.colours import Colour
from aaplug.core.lenses import PINHOLE, Lens
from aaplug.system.contracts import Range, check_fields, contract
from aaplug.system.errors import UsageError

WHOLE_SLACK = 1e-6  # a size (px) or a factor this close to a whole number is one
MAX_SIDE = 2**31 - 1  # px: files store sides in 32 bits
MAX_FOCAL = 1e9  # px: far above any real lens; what is computed from it stays finite
MAX_DISTANCE = 1e18  # world units from the origin; its square fits into float32
MIN_SINE = 1e-12  # between the direction of sight and up
MAX_BLADES = 64
NEEDS_PINHOLE = "an aperture needs a pinhole without distortion"
MAX_EXPOSURES = 4096  # frames averaged to one
MAX_ROTATION_ERROR = 1e-3  # largest error of an entry of R·Rᵀ that counts as rounding
MAX_LAST_ROW_ERROR = 1e-6  # the same of the row 0 0 0 1, which some inverses round, too

Side = Annotated[int, Range(1, MAX_SIDE)]  # px
Focal = Annotated[float, Range(above=0, most=MAX_FOCAL)]  # px
Place = Annotated[float, Range(-MAX_FOCAL, MAX_FOCAL)]  # px
Factor = Annotated[float, Range(above=0, most=MAX_FOCAL)]
Point = tuple[float, float]  # x and y, px
CORNER: Point = (0.0, 0.0)  # of an image


@dataclass(frozen=True)
class Undistortion:
    """How a photograph becomes its camera's view: the lens that took it, against the pinhole that is drawn.

    lens: that took it.
    size: width and height of the whole photograph, in px.  pinhole: its fx, fy, cx, cy, in the same px.
    window: left, top, width and height of the camera's view in it, in px.
    """

    lens: Lens
    size: tuple[int, int]
    pinhole: tuple[float, float, float, float]
    window: tuple[int, int, int, int]


@dataclass(frozen=True)
class Camera:
    """One view through a lens.

    fx, fy: focal lengths, in px of this size: px per unit of the lens's places (a radian, or of ortho a world unit).
    cx, cy: the principal point, in px.
    trained_focal: px.  For a pose of the data set, the focal length at which training rendered it (or would have, for
        a held-out view); scaling the view keeps it.  None for a free camera.
    photo: the photograph taken from here, if any.  undistortion: how it becomes this view, if it is not of this lens.
        Neither counts for equality.
    lens: maps rays to places in the image.
    exposure: aperture and shutter; None for an instant, and for a lens without a size.
    frame: place, from 0, of the frame that it shows of a scene in time.

    Raises:
        UsageError: a number is out of range, the pose is no rigid motion, or a lens that bends has an aperture.
    """

    name: str
    width: Side
    height: Side
    fx: Focal
    fy: Focal
    cx: Place
    cy: Place
    cam_from_world: Float[Tensor, "4 4"]
    trained_focal: Focal | None = None
    photo: Path | None = None
    undistortion: Undistortion | None = None
    lens: Lens = PINHOLE
    exposure: "Exposure | None" = None
    frame: Annotated[int, Range(0)] = 0

    def __post_init__(self) -> None:
        try:
            check_fields(self)
            object.__setattr__(self, "cam_from_world", self.cam_from_world.double())
            self._check_pose()
            if self.lens != PINHOLE and self.exposure is not None and self.exposure.aperture is not None:
                raise UsageError("exposure", f"{NEEDS_PINHOLE}, got {self.lens.kind}")
        except UsageError as error:
            if error.where == "name" or not self.name:
                raise
            raise UsageError(f"camera {self.name}", str(error)) from None

    def _check_pose(self) -> None:
        check_rigid(self.cam_from_world.tolist())

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Camera):
            return NotImplemented
        return self._scalars == other._scalars and torch.equal(self.cam_from_world, other.cam_from_world)

    def __hash__(self) -> int:
        return hash(self._scalars)

    @property
    def _scalars(self) -> tuple[object, ...]:
        return self.name, *self.intrinsics, self.trained_focal, self.lens, self.exposure, self.frame

    @property
    def intrinsics(self) -> tuple[float, float, float, float, int, int]:
        """fx, fy, cx, cy, width and height, in px."""
        return self.fx, self.fy, self.cx, self.cy, self.width, self.height

    @property
    def hw(self) -> tuple[int, int]:
        """Height and width, in px."""
        return self.height, self.width

    @property
    def focal(self) -> float:
        """One focal length for both axes, in px: the geometric mean, fx itself where pixels are square."""
        return self.fx if self.fx == self.fy else math.sqrt(self.fx * self.fy)

    @property
    def centre(self) -> Float[Tensor, " 3"]:
        """Position in the world."""
        return -self.cam_from_world[:3, :3].T @ self.cam_from_world[:3, 3]

    @contract
    def project(self, points: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "n 2"], Float[Tensor, " n"]]:
        """Positions in px and depths along the optical axis in world units of world points, in float64."""
        pose = self.cam_from_world
        local = points.double() @ pose[:3, :3].T + pose[:3, 3]
        return self.pixels(self.lens.places(local)), local[:, 2]

    @contract
    def pixels(self, places: Float[Tensor, "*n 2"]) -> Float[Tensor, "*n 2"]:
        """Places of the lens, in px."""
        return places * places.new_tensor([self.fx, self.fy]) + places.new_tensor([self.cx, self.cy])

    @contract
    def rays(self, pixels: Float[Tensor, "*n 2"]) -> Float[Tensor, "*n 3"]:
        """Rays of positions in px, in the camera's frame; 0 where the lens sees nothing."""
        offset = pixels.double() - pixels.new_tensor([self.cx, self.cy]).double()
        return self.lens.rays(offset / offset.new_tensor([self.fx, self.fy])).to(pixels)

    @contract
    def scaled(self, factor: Factor) -> "Camera":
        """The same view with pixels `factor` times as dense.

        A partial row at the bottom or column at the right is dropped, so that scaled(1/n) sees exactly what n×n box
        averages of the full image see.
        """
        return self._moved(whole_side(self.width * factor), whole_side(self.height * factor), factor, factor)

    @contract
    def resized(self, width: Side, height: Side) -> "Camera":
        """The same field of view in `width` × `height` px; pixels stop being square if the aspect changes."""
        return self._moved(width, height, width / self.width, height / self.height)

    @contract
    def framed(self, width: Side, height: Side) -> "Camera":
        """The same pose in `width` × `height` px, square as before: the shorter side keeps its field of view."""
        factor = min(width, height) / min(self.hw)
        middle = self.width / 2, self.height / 2
        return self._moved(width, height, factor, factor, middle, (width / 2, height / 2))

    @contract
    def cropped(self, left: int, top: int, width: Side, height: Side) -> "Camera":
        """`width` × `height` px of this view, whose corner is `left` and `top` px from its own."""
        return self._moved(width, height, 1.0, 1.0, (float(left), float(top)))

    def as_trained(self) -> "Camera":
        """This view, declared to be a pose of the data set at its training size."""
        return replace(self, trained_focal=self.focal)

    def straight(self) -> "Camera":
        """This view as a pinhole of the same focal lengths if its lens is a distorted pinhole, else unchanged."""
        return replace(self, lens=PINHOLE) if self.lens.flat and self.lens.distorts else self

    def _moved(self, width: int, height: int, x: float, y: float, at: Point = CORNER, to: Point = CORNER) -> "Camera":
        """Another image, of pixels x and y times as dense, in which the place `at` of this one, in px, is at `to`."""
        lens = {"fx": self.fx * x, "fy": self.fy * y}
        lens |= {"cx": to[0] + x * (self.cx - at[0]), "cy": to[1] + y * (self.cy - at[1])}
        exposure = self.exposure
        if exposure is not None and exposure.motion is not None:
            opened, closed = (camera._moved(width, height, x, y, at, to) for camera in exposure.motion)
            exposure = replace(exposure, motion=(opened, closed))
        return replace(self, width=width, height=height, **lens, exposure=exposure)


@dataclass(frozen=True)
class Aperture:
    """The opening of a thin lens.

    radius: of the opening, in world units.  focus: depth of the plane that is sharp, in world units.
    blades: corners of the opening, which lie on the circle of that radius; 0 for a disc.
    """

    radius: Annotated[float, Range(above=0, most=MAX_DISTANCE)]
    focus: Annotated[float, Range(above=0, most=MAX_DISTANCE)]
    blades: Annotated[int, Range(0, MAX_BLADES)] = 0

    def __post_init__(self) -> None:
        check_fields(self)
        if self.blades in (1, 2):
            raise UsageError("blades", f"expected 0 for a disc, or 3 and more, got {self.blades}")

    @property
    def variance(self) -> float:
        """Variance of a place in the opening along any axis, in squared world units: second moment over area."""
        return self.radius**2 * (2 + math.cos(2 * math.pi / self.blades) if self.blades else 3) / 12


@dataclass(frozen=True)
class Exposure:
    """The exposure of a frame: the opening of its lens, and the time that its shutter is open.

    aperture: None for a pinhole.
    motion: the cameras where the shutter opens and where it closes, constants to gradients; None for an instant.
    samples: number of frames that are averaged.
    """

    aperture: Aperture | None = None
    motion: tuple[Camera, Camera] | None = None
    samples: Annotated[int, Range(1, MAX_EXPOSURES)] = 16

    def __post_init__(self) -> None:
        check_fields(self)
        if any(camera.cam_from_world.requires_grad for camera in self.motion or ()):
            raise UsageError("motion", "expected poses that require no gradients, which no motion has; detach them")


@dataclass(frozen=True)
class CameraSet:
    """Cameras of a scene at their training size, and where the facts about them came from.

    train: the cameras that sampling bounds come from.  test: held-out views; the same as `train` without a split.
    background: the colour that training put behind the scene; None if the files do not say.
    notes: facts worth printing, one line each (format, split, training scale and its source).
    assumed: true where nobody knows the cameras, and these stand in for them.
    files: what they were read from, with the data set's photographs; no output replaces one.
    """

    train: tuple[Camera, ...]
    test: tuple[Camera, ...]
    background: Colour | None = None
    notes: tuple[str, ...] = ()
    assumed: bool = False
    files: tuple[Path, ...] = ()

    def __post_init__(self) -> None:
        check_fields(self)
        for name in ("train", "test", "notes"):
            object.__setattr__(self, name, tuple(getattr(self, name)))

    def __repr__(self) -> str:
        found = f"{len(self.train)} train, {len(self.test)} test, background={self.background}, notes={self.notes}"
        return f"CameraSet({found}, assumed={self.assumed})"

    @property
    def all(self) -> tuple[Camera, ...]:
        """Every camera once, training views first."""
        training = {id(camera) for camera in self.train}
        return self.train + tuple(camera for camera in self.test if id(camera) not in training)


def check_rigid(pose: Sequence[Sequence[float]]) -> None:
    """Refuse a pose, row by row, that is no rigid motion; raises UsageError."""
    right, down, forward, last = pose
    axes, place = [row[:3] for row in (right, down, forward)], [row[3] for row in (right, down, forward)]
    products = [sum(map(operator.mul, a, b)) - (a is b) for a in axes for b in axes]
    if not all(abs(product) <= MAX_ROTATION_ERROR for product in products):
        raise UsageError("cam_from_world", f"expected a rotation, got {axes}")
    (a, b, c), (d, e, f), (g, h, i) = axes
    if a * (e * i - f * h) + b * (f * g - d * i) + c * (d * h - e * g) < 0:
        raise UsageError("cam_from_world", f"expected a rotation, got one that mirrors: {axes}")
    is_last = all(abs(x - expected) <= MAX_LAST_ROW_ERROR for x, expected in zip(last, (0, 0, 0, 1), strict=True))
    if not is_last or not all(abs(x) <= MAX_DISTANCE for x in place):
        expected = f"a translation of at most {MAX_DISTANCE:g}, and 0 0 0 1 below"
        raise UsageError("cam_from_world", f"expected {expected}, got {place} and {last}")


def photographs(views: Iterable[Camera]) -> list[Path]:
    """Files of the views' photographs, of those that have one."""
    return [view.photo for view in views if view.photo is not None]


def whole_side(length: float) -> int:
    """Whole pixels in a side of this length (px), at least one."""
    return max(1, math.floor(length + WHOLE_SLACK))


def numbered(count: int, before: str = "") -> list[str]:
    """Names that end in a number, from 0 and of one length."""
    return [f"{before}{number:0{len(str(count - 1))}}" for number in range(count)]


def spread(views: Sequence[Camera], most: int) -> Sequence[Camera]:
    """At most this many of the views, evenly spaced."""
    return views[:: max(1, -(-len(views) // most))]


def centred(
    name: str, size: tuple[int, int], focal: float, pose: Float[Tensor, "4 4"], photo: Path | None = None
) -> Camera:
    """A free camera whose principal point is the image's centre.  size: width, height; focal: of both axes; in px."""
    return Camera(name, *size, focal, focal, size[0] / 2, size[1] / 2, pose, photo=photo)


@contract
def look_at(eye: Float[Tensor, " 3"], target: Float[Tensor, " 3"], up: Float[Tensor, " 3"]) -> Float[Tensor, "4 4"]:
    """`cam_from_world` of a camera at `eye` that looks at `target`, with `up` pointing up in the image.

    Raises:
        UsageError: there is no direction of sight, or it is that of `up`.
    """
    eye, target, up = (x.double() for x in (eye, target, up))
    sight = target - eye
    if not 0 < float(sight.detach().norm()) < math.inf:
        raise UsageError("target", f"expected a place other than `eye`, got {target.tolist()}")
    forward = torch.nn.functional.normalize(sight, dim=0)
    right = torch.linalg.cross(forward, torch.nn.functional.normalize(up, dim=0))
    if not float(right.detach().norm()) > MIN_SINE:
        raise UsageError("up", f"expected a direction other than that of sight, got {up.tolist()}")
    right = torch.nn.functional.normalize(right, dim=0)
    rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])
    return rigid_motion(rotation, -rotation @ eye)


def rigid_motion(rotation: Float[Tensor, "3 3"], translation: Float[Tensor, " 3"]) -> Float[Tensor, "4 4"]:
    """The motion that turns and then moves."""
    motion = torch.eye(4, dtype=torch.float64)
    motion[:3, :3], motion[:3, 3] = rotation, translation
    return motion


def digest_of_cameras(views: Sequence[Camera]) -> str:
    """Hash of the views as they were understood: names, sizes, intrinsics, poses, training focal lengths and lenses.

    An exposure counts too, and the frame of a scene in time.
    """
    values = []
    for view in views:
        more: list[object] = [asdict(lens) for lens in (view.lens, view.undistortion) if lens not in (PINHOLE, None)]
        if (exposure := view.exposure) is not None:
            more += [repr(exposure.aperture), exposure.samples, digest_of_cameras(exposure.motion or ())]
        more += [view.frame] * (view.frame > 0)
        values.append([view.name, *view.intrinsics, view.cam_from_world.tolist(), view.trained_focal, more or None])
    return hashlib.sha256(json.dumps(values).encode()).hexdigest()
