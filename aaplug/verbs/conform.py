"""Errors of a renderer: ten tiny scenes, drawn by a program or by hand, against the pictures they should be."""

import os
import shlex
import subprocess
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory

from jaxtyping import Float
from torch import Tensor

from aaplug.core.colours import BLACK
from aaplug.evaluation.conformance import CAMERA, SIDE, TESTS, Conformance, draw, judged
from aaplug.evaluation.report.files import as_json
from aaplug.io.atomic import AnyPath, make_folder, refuse_existing, write_file
from aaplug.io.images import read_image, write_png
from aaplug.io.scenes import write_scene
from aaplug.methods.viewers import CLASSIC_VIEWER, Viewer, find_viewer
from aaplug.system.contracts import contract
from aaplug.system.errors import MAX_VALUE_CHARACTERS, FormatError, UsageError, reason
from aaplug.system.executors import torch_threads
from aaplug.system.monitor import SILENT, Monitor

PLACEHOLDERS = ("{scene}", "{camera}", "{image}")
PROGRAM_SECONDS = 300.0  # that a program may take for a picture
LACK = "no picture: "  # begins a finding
TOLD_LINES = 3  # of the end of what a failed program says
EXPECTED = "expected"  # folder of the pictures as they should be


@contract
def conform(
    program: str | Callable[[Path, Path, Path], object] | None = None,
    images: AnyPath | None = None,
    output: AnyPath | None = None,
    *,
    viewer: str | Viewer | None = None,
    overwrite: bool = False,
    monitor: Monitor = SILENT,
) -> Conformance | None:
    """Test a renderer by its pictures of ten tiny scenes, and name what it draws wrong; with neither, write the scenes.

    A picture is 64×64 px, on black or white.  The camera is a cameras.json of 3DGS with one entry: position, and
    rotation from camera to world in OpenCV's axes; its principal point is the image's centre.

    Args:
        program: a command line, in which {scene}, {camera} and {image} stand for the .ply, the .json and the .png to
            write, or to which they are added; or a function of the three paths.
        images: instead, folder of pictures by the tests' names, such as near-plane.png.
        output: folder for scenes, cameras, the program's pictures, and in `expected` those that they should be.
        viewer: whose rule to expect; None for the one that fits best (classic for pictures that are written alone).

    Raises:
        UsageError: there is nothing to do, two things contradict each other, or there is no picture at all, as of a
            program that cannot be started.
        OutputError: a file exists and `overwrite` is false, or cannot be written.
    """
    found = find_viewer(viewer)
    if program is not None and images is not None:
        raise UsageError("images", "gives the pictures, as `program` does; give one")
    if program is None and images is None and output is None:
        raise UsageError("program", "name a program, `images`, or an `output` folder for the scenes")
    if images is not None and not os.path.isdir(images):
        raise UsageError("images", f"is no folder: {str(images)[:MAX_VALUE_CHARACTERS]}")
    if found is not None and found.convention is None:
        raise UsageError("viewer", f"{found.name} draws each scene by its own convention; name one with a rule")
    with ExitStack() as stack, torch_threads(1):
        folder = Path(output or stack.enter_context(TemporaryDirectory()))
        drawn = folder if images is None else Path(images)
        files = {test: (folder / f"{test.name}.ply", folder / f"{test.name}.json") for test in TESTS}
        if program is not None or output is not None:
            made = [folder / f"{test.name}.png" for test in TESTS if program is not None]
            refuse_existing([*(path for paths in files.values() for path in paths), *made], overwrite)
            make_folder(folder)
            rotation = CAMERA.cam_from_world[:3, :3].T.tolist()
            place = {"position": CAMERA.centre.tolist(), "rotation": rotation, "fx": CAMERA.fx, "fy": CAMERA.fy}
            entry = {"id": 0, "img_name": CAMERA.name, "width": SIDE, "height": SIDE, **place}  # as 3DGS writes it
            for test, (scene, camera) in files.items():
                write_scene(scene, test.stored, overwrite=overwrite)
                write_file(camera, as_json([entry]).encode(), overwrite)
        pictures = dict[str, Float[Tensor, "h w 3"] | str]()
        if program is not None or images is not None:
            with monitor.progress("drawing", "pictures") as tell:
                for done, (test, paths) in enumerate(files.items(), 1):
                    picture = drawn / f"{test.name}.png"
                    problem = "" if program is None else _run(program, *paths, picture)
                    pictures[test.name] = problem or _picture(picture)
                    tell(done, len(files))
            first = next(iter(pictures.values()))
            if isinstance(first, str) and all(isinstance(picture, str) for picture in pictures.values()):
                problem = f"gave none of {len(files)} pictures: {first.removeprefix(LACK)}"
                raise UsageError("images" if program is None else "program", problem)
        verdict = judged(pictures, found) if pictures else None
        if output is not None:
            shown = verdict.viewer if verdict else found or CLASSIC_VIEWER
            for test in TESTS:
                expected = make_folder(folder / EXPECTED) / f"{test.name}.png"
                write_png(expected, draw(test.scene, shown).float(), overwrite=overwrite)
            monitor.say(f"wrote {folder}: scenes, cameras, and in {EXPECTED} what {shown.name} draws")
        return verdict


def _run(program: str | Callable[[Path, Path, Path], object], *paths: Path) -> str:
    """Let the program draw, in place of an earlier picture; why there is none, in words."""
    paths[-1].unlink(missing_ok=True)
    if not isinstance(program, str):
        program(*paths)
        return ""
    try:
        words = shlex.split(program)
    except ValueError as error:
        raise UsageError("program", f"is no command line: {error}") from error
    if not any(placeholder in word for word in words for placeholder in PLACEHOLDERS):
        words += PLACEHOLDERS
    for placeholder, path in zip(PLACEHOLDERS, paths, strict=True):
        words = [word.replace(placeholder, str(path)) for word in words]
    try:
        run = subprocess.run(words, capture_output=True, timeout=PROGRAM_SECONDS, check=False)
    except subprocess.TimeoutExpired:
        return f"{LACK}the program took more than {PROGRAM_SECONDS:g} s"
    except (OSError, ValueError) as error:
        raise UsageError("program", f"cannot be started: {words[0]}: {reason(error)}") from error
    if not run.returncode:
        return ""
    told = (run.stderr or run.stdout).decode(errors="replace").split("\n")
    end = "; ".join([line.strip() for line in told if line.strip()][-TOLD_LINES:])
    return f"{LACK}the program ended with code {run.returncode}: {end or 'it said nothing'}"


def _picture(path: Path) -> Float[Tensor, "h w 3"] | str:
    """A renderer's picture; in words, why there is none."""
    if not path.is_file():
        return f"{LACK}there is no {path.name}"
    try:
        picture = read_image(path, BLACK)
    except FormatError as error:
        return f"{LACK}{error}"
    height, width = picture.shape[:2]
    if (height, width) != CAMERA.hw:
        return f"{LACK}expected {SIDE}x{SIDE} px, got {width}x{height}"
    return picture
