"""Where an evaluation's images lie: <folder>/<recipe>@<scale>/renders/00003.png and the truth in gt/ beside it.

That is the layout of 3DGS's own scripts (there <folder> is a model's test/), so that other metric scripts run on it.
The number is the view's place in the request.  An image that is there already is replaced: who continues an
evaluation writes the same one.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from aaplug.errors import OutputError
from aaplug.io.images import write_png
from aaplug.report import CEILING, method

RENDERS, TRUTHS = "renders", "gt"


@dataclass(frozen=True)
class Images:
    """A store of rendered and true images.

    wanted: whether a view's images are stored, by its place.  whole: store only what has a truth, and no ceiling.
    """

    folder: Path
    wanted: Callable[[int], bool]
    whole: bool = False

    def keep(
        self,
        view: int,
        recipe: str,
        scale: float,
        image: Float[Tensor, "h w 3"],
        truth: Float[Tensor, "h w 3"] | None,
    ) -> None:
        """Store one image and its truth.

        Raises:
            OutputError: it cannot be written.
        """
        if not self.wanted(view) or (self.whole and (truth is None or recipe == CEILING)):
            return
        for kind, pixels in ((RENDERS, image), (TRUTHS, truth)):
            if pixels is not None:
                path = self.path(view, recipe, scale, kind)
                try:
                    path.parent.mkdir(parents=True, exist_ok=True)
                except OSError as error:
                    raise OutputError(
                        path.parent, f"cannot be made: {(error.strerror or '').lower()}"
                    ) from error
                write_png(path, pixels, overwrite=True)

    def path(self, view: int, recipe: str, scale: float, kind: str = RENDERS) -> Path:
        """Where a render or, by kind, its truth lies."""
        name = "ceiling" if recipe == CEILING else recipe
        return self.folder / method(name, scale) / kind / f"{view:05d}.png"
