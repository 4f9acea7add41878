"""Where an evaluation stores images: test/<recipe>@<scale>/renders/00003.png, and the truth in gt/ beside it.

This is the layout of 3DGS's own scripts in a model folder, so other metric scripts can read it.  The few images that a
report shows have the same layout in images/.  The number is the view's place in the request.  An existing image is
replaced: a continued evaluation writes the same one again.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from aaplug.evaluation.results import CEILING, method
from aaplug.io.atomic import make_folder
from aaplug.io.images import write_png

RENDERS, TRUTHS = "renders", "gt"
SHOWN, EVERYTHING = "images", "test"  # folders


@dataclass(frozen=True)
class ImageStore:
    """A store of rendered and true images.

    shown: places of the views that go to images/, with the ceiling.
    everything: store all views that have a truth in test/, as 3DGS's scripts do.
    """

    folder: Path
    shown: tuple[int, ...]
    everything: bool = False

    def keep(
        self, view: int, recipe: str, scale: float, image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"] | None
    ) -> None:
        """Store one image and its truth.

        Raises:
            OutputError: it cannot be written.
        """
        for folder in self._folders(view, recipe, truth):
            for kind, pixels in ((RENDERS, image), (TRUTHS, truth)):
                if pixels is not None:
                    _write(_path(folder, view, recipe, scale, kind), pixels)

    def path(self, view: int, recipe: str, scale: float, kind: str = RENDERS) -> Path:
        """Path of a shown render, or by kind of its truth."""
        return _path(self.folder / SHOWN, view, recipe, scale, kind)

    def _folders(self, view: int, recipe: str, truth: Tensor | None) -> Iterator[Path]:
        if view in self.shown:
            yield self.folder / SHOWN
        if self.everything and truth is not None and recipe != CEILING:
            yield self.folder / EVERYTHING


def _path(folder: Path, view: int, recipe: str, scale: float, kind: str) -> Path:
    name = "ceiling" if recipe == CEILING else recipe
    return folder / method(name, scale) / kind / f"{view:05d}.png"


def _write(path: Path, pixels: Float[Tensor, "h w 3"]) -> None:
    make_folder(path.parent)
    write_png(path, pixels, overwrite=True)
