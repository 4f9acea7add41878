"""A camera format: a text file of pinholes that look at a point.

Each line has a name and ten numbers: width, height and focal length in px, the camera's position, the point that it
looks at, and 1 for a test view or 0 for a training view.  The world's z axis points up.
"""

from dataclasses import dataclass
from pathlib import Path

import torch

from aaplug import Camera, CameraFileOptions, CameraSet, FormatError, UsageError, look_at

NUMBERS = 10
UP = torch.tensor([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Look:
    """Cameras in a .look file."""

    name: str = "look"
    sign: str = "a file called .look"

    def sniff(self, path: Path) -> bool:
        """True for a file of this format.  Never raises."""
        return path.suffix.lower() == ".look"

    def read(self, path: Path, options: CameraFileOptions) -> CameraSet:
        """The cameras at their training size.

        Raises:
            FormatError: a line is not what it should be.
            UsageError: an option does not fit.
        """
        if options != CameraFileOptions():
            raise UsageError("cameras", "a .look file holds sizes and split; it takes no options")
        views = [_view(path, line) for line in path.read_text().splitlines() if line.strip()]
        train = tuple(camera for camera, held_out in views if not held_out)
        test = tuple(camera for camera, held_out in views if held_out)
        if not train:
            raise FormatError(path, "holds no training view")
        return CameraSet(train, test or train, notes=(f"look: {len(views)} cameras",))


def _view(path: Path, line: str) -> tuple[Camera, bool]:
    name, *words = line.split()
    try:
        width, height, focal, *places, held_out = (float(word) for word in words)
        eye, target = torch.tensor(places).view(2, 3)
    except (ValueError, RuntimeError) as error:
        raise FormatError(path, f"'{line}' is not a name and {NUMBERS} numbers") from error
    centre = width / 2, height / 2
    pose = look_at(eye, target, UP)
    camera = Camera(name, int(width), int(height), focal, focal, *centre, pose)
    return camera.as_trained(), bool(held_out)


LOOK = Look()
