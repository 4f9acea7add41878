"""Options of an orbit, which stands in for cameras where there are none."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

from aaplug.core.errors import UsageError
from aaplug.options.base import UNSET, Options, flag, number
from aaplug.options.shared import size_of

FOV = 50.0  # degrees
FARTHEST = 1e7  # world units
AXES = 3  # numbers of a place or direction

_PLACE = number(-FARTHEST, FARTHEST, several=True)


@dataclass(frozen=True, kw_only=True)
class OrbitOptions(Options):
    """Without cameras: views on an orbit around the scene, and the training that is assumed."""

    orbit: Annotated[int | None, number(1, 10_000, whole=True), UNSET] = None
    """Number of views around the scene (default: 8, or 1 for a single picture)."""
    elevation: Annotated[float | None, number(-89, 89), UNSET] = None
    """Degrees of the orbit above the horizon (default: 20)."""
    fov: Annotated[float, number(1, 170)] = FOV
    """Field of view in degrees, along the image's shorter side."""
    look_at: Annotated[Sequence[float] | None, _PLACE, UNSET] = None
    """Place to look at, X Y Z (default: the middle of the scene)."""
    eye: Annotated[Sequence[float] | None, _PLACE, UNSET] = None
    """Place to look from, X Y Z, instead of an orbit."""
    up: Annotated[Sequence[float] | None, _PLACE, UNSET] = None
    """Direction that points up, X Y Z (default: 0 -1 0, or what file and colours say)."""
    train_view: Annotated[str | None, flag("WxH")] = None
    """Size in px of the training images, which are taken to show what the orbit shows (default: 1600x1066)."""
    train_rate: Annotated[float | None, number(1e-6, 1e9), UNSET] = None
    """Instead, px per world unit in the middle of the scene in training."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("look_at", "eye", "up"):
            value = getattr(self, name)
            if value is not None and len(value) != AXES:
                raise UsageError(name, f"takes three numbers X Y Z, got {len(value)}")
        if self.train_view is not None:
            size_of(self.train_view, "train_view")
        if self.train_view is not None and self.train_rate is not None:
            raise UsageError("train_view", "and `train_rate` both set the training rate; give one")
        for name in ("orbit", "elevation"):
            if self.eye is not None and getattr(self, name) is not None:
                raise UsageError("eye", f"is a single place, which `{name}` would change; give one")
