"""Images of an evaluation on disk: test/<recipe>@<scale>/renders/00003.png, and the truth in gt/ beside it.

This is the layout of 3DGS's own scripts in a model folder, so other metric scripts can read it.  The few images that a
report shows have the same layout in images/.  The number is the view's place in the request.  An existing image is
replaced: a continued evaluation writes the same one again.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from aaplug.core.cameras import Camera
from aaplug.evaluation.metric import Image
from aaplug.evaluation.results import CEILING, method
from aaplug.io.atomic import make_folder
from aaplug.io.cameras import view_names
from aaplug.io.images import write_png

RENDERS, TRUTHS = "renders", "gt"
REPORT_FOLDER, TEST_FOLDER = "images", "test"


@dataclass(frozen=True)
class ImageStore:
    """A store of rendered and true images.

    report_views: places of the views that go to images/, with the ceiling.
    everything: store all views that have a truth in test/, as 3DGS's scripts do.
    """

    folder: Path
    report_views: tuple[int, ...]
    everything: bool = False

    @classmethod
    def of(cls, folder: Path, show: str, views: Sequence[Camera], everything: bool = False) -> "ImageStore":
        """A store whose report shows these views: so many, evenly spread, or those named, with commas between."""
        if show.isdecimal():
            count = min(int(show), len(views))
            return cls(folder, tuple(i * len(views) // count for i in range(count)), everything)
        places = {view.name: place for place, view in enumerate(views)}
        names = view_names(places, show, "show", "a number, or names of views that are measured,")
        return cls(folder, tuple(places[name] for name in names), everything)

    def keep(self, view: int, recipe: str, scale: float, image: Image, truth: Image | None) -> None:
        """Store one image and its truth, wherever they belong."""
        folders = [REPORT_FOLDER] if view in self.report_views else []
        if self.everything and truth is not None and recipe != CEILING:
            folders.append(TEST_FOLDER)
        for folder in folders:
            for kind, pixels in ((RENDERS, image), (TRUTHS, truth)):
                if pixels is not None:
                    path = self.path(view, recipe, scale, kind, folder)
                    make_folder(path.parent)
                    write_png(path, pixels, overwrite=True)

    def path(self, view: int, recipe: str, scale: float, kind: str = RENDERS, folder: str = REPORT_FOLDER) -> Path:
        """Path of a render, or by `kind` of its truth; in the report's folder unless the other one is named."""
        return self.folder / folder / method(recipe, scale) / kind / f"{view:05d}.png"
