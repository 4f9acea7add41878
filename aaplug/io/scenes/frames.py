"""A scene in time: a folder of .ply files, one a frame, numbered without gaps, of which one is open at a time.

Gaussian i of each frame is the same thing at another time, unless the frames were trained apart.  Its sampling rates
are those over all frames and cameras, as Alias-Free 4D Gaussian Splatting (arXiv 2511.18367) takes the maximum over
time: filters that follow them do not change from frame to frame.
"""

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

from aaplug.core.cameras import Camera
from aaplug.core.gaussians import Gaussians
from aaplug.core.training import TrainingViews
from aaplug.system.errors import FormatError, listing

if TYPE_CHECKING:
    from aaplug.io.scenes.scene import Scene

NUMBERED = re.compile(r"(.*?)(?<!\d)(?<!_lod)(\d+)((?:\.compressed)?\.ply)", re.ASCII)  # levels of detail are no frames


@dataclass(frozen=True)
class SceneFrames:
    """The frames of a scene in time.

    paths: their files, in order.  numbers: theirs, as the files' names write them.  open: opens one of the files.
    apart: they were trained apart, so that each has sampling rates of its own.
    """

    paths: tuple[Path, ...]
    numbers: tuple[str, ...]
    open: Callable[[Path], "Scene"]
    apart: bool = False

    def __len__(self) -> int:
        return len(self.paths)

    def __iter__(self) -> "Iterator[Scene]":
        return map(self.open, self.paths)

    def check(self) -> None:
        """Read what every file says, without its rows.

        Raises:
            FormatError: a file breaks its format, or it is of another kind than the first, or it holds another number
                of Gaussians and the frames were not trained apart.
        """
        kinds = [
            {"degree of harmonics": s.sh_degree, "convention": s.convention.name, "2D Gaussians": s.flat}
            | ({} if self.apart else {"number of Gaussians": s.count})
            for s in self
        ]
        for path, kind in zip(self.paths, kinds, strict=True):
            for name, value in kind.items():
                if value != kinds[0][name]:
                    hint = "; pass `frames_apart` if each frame was trained alone" * (name == "number of Gaussians")
                    problem = f"expected the {name} of {self.paths[0].name}, {kinds[0][name]}, got {value}"
                    raise FormatError(path, problem + hint)

    def at_each(self, views: Sequence[Camera]) -> tuple[Camera, ...]:
        """The views at every frame, a frame at a time; the number of the frame ends a view's name."""
        moments = enumerate(self.numbers)
        return tuple(replace(v, frame=k, name=f"{v.name}-{n}", photo=None) for k, n in moments for v in views)

    def along(self, path: Sequence[Camera]) -> list[Camera]:
        """The cameras of a path, during which the frames pass once."""
        return [replace(view, frame=i * len(self) // len(path)) for i, view in enumerate(path)]

    def over_all(self, training: TrainingViews) -> TrainingViews:
        """The training views of the first frame, with sampling bounds over all; raises UsageError as `also`."""
        for frame in () if self.apart else islice(self, 1, None):
            training = training.also(frame.gaussians())
        return training

    def training_of(self, frame: Gaussians, training: TrainingViews) -> TrainingViews:
        """The training views of a frame; training: of the scene."""
        return TrainingViews.of(frame, training.cameras, training.cull_margin) if self.apart else training


def frame_files(folder: Path) -> dict[Path, str]:
    """The numbers of the files of a scene in time, by file and in order; none if no two differ by a number alone.

    Raises:
        FormatError: frames are missing, or there are frames of several sequences.
    """
    matches = [match for path in folder.glob("*.ply") if (match := NUMBERED.fullmatch(path.name))]
    named: dict[tuple[str, str], list[re.Match[str]]] = {}
    for match in sorted(matches, key=lambda match: int(match[2])):
        named.setdefault((match[1], match[3]), []).append(match)
    sequences = {name: found for name, found in named.items() if len(found) > 1}
    if not sequences:
        return {}
    if len(sequences) > 1:
        patterns = listing(sorted(f"{first}####{last}" for first, last in sequences))
        raise FormatError(folder, f"holds frames of {len(sequences)} sequences ({patterns}); give each a folder")
    [found] = sequences.values()
    numbers = [int(match[2]) for match in found]
    missing = sorted({*range(numbers[0], numbers[-1] + 1)} - {*numbers})
    if missing or len({*numbers}) < len(numbers):
        span = f"{found[0][0]} to {found[-1][0]}"
        problem = f"lack {listing([*map(str, missing)], most=3)}" if missing else "have a number twice"
        raise FormatError(folder, f"its frames {span} {problem}; or name one of the files")
    return {folder.absolute() / match[0]: match[2] for match in found}
