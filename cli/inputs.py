"""Scenes and cameras as the command line names them: options, reading, and saying what was read."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import aaplug
from aaplug.core.conventions import CONVENTIONS, SpzAxes
from aaplug.options.base import Group, Options, as_path, flag, names, number
from aaplug.options.verbs import CAMERAS, SCALE, Orbit
from aaplug.system.errors import FormatError, UsageError, counted

from .console import TERMINAL, say
from .words import Words

if TYPE_CHECKING:
    from aaplug.io.scenes.scene import Scene

SCENE_FILE = Group("scene file", "How scene files are read.")


class FileOptions(Options):
    """How scene files are read."""

    convention: Annotated[str | None, names(*CONVENTIONS), SCENE_FILE] = None
    """How the scene was trained or, for playcanvas and playcanvas-classic, converted, if its file does not say."""
    drop_bad: Annotated[bool, SCENE_FILE] = False
    """Leave out Gaussians with NaN, infinite or unusable values instead of stopping."""
    allow_checkpoint: Annotated[bool, SCENE_FILE] = False
    """Also read gsplat's .pt, a pickle; only its tensors are loaded."""
    spz_axes: Annotated[SpzAxes, SCENE_FILE] = "auto"
    """Axes of a .spz: opengl (its specification), opencv (splat-transform, gsply), or auto: as the cameras tell."""
    frames_apart: Annotated[bool, SCENE_FILE] = False
    """The frames of a scene in time were trained apart: no Gaussian of one is in another."""


class SceneOptions(FileOptions):
    """The scene."""

    scene: Annotated[Path | None, flag("[SCENE]", read=as_path, by_place=True)] = None
    """A scene file (`aaplug guide formats`) or folder: model, levels; for render, video, evaluate, convert: frames."""
    model_path: Annotated[Path | None, flag("FOLDER", "-m", read=as_path), SCENE_FILE] = None
    """An INRIA model folder, instead of SCENE."""
    iteration: Annotated[int | None, number(0, 10**9, whole=True, metavar="N"), SCENE_FILE] = None
    """Iteration of a model folder (default: the last)."""


class CameraOptions(Options):
    """The cameras."""

    cameras: Annotated[Path | None, flag("PATH", read=as_path)] = None
    """cameras.json, COLMAP model, Blender transforms_*.json, or their folder (default: SCENE's own)."""
    train_scale: Annotated[float | None, SCALE, CAMERAS] = None
    """Training size relative to the cameras' source size, where the files do not say."""
    images: Annotated[str | None, flag("FOLDER"), CAMERAS] = None
    """Folder of photographs inside the data set (default: the format's own)."""
    test_every: Annotated[int | None, number(0, 1_000_000, whole=True, metavar="N"), CAMERAS] = None
    """Hold out every N-th view by name; 0 for no split (default: as usual for the format)."""
    undistort: Annotated[bool, CAMERAS] = False
    """Undistort photographs, and draw pinhole views."""


SCENE_AND_CAMERAS: Sequence[type[Options]] = (SceneOptions, CameraOptions, Orbit)


def path_of(words: Words) -> Path:
    """The one scene that the words name; raises UsageError if they name none or two."""
    if (words.scene is None) == (words.model_path is None):
        raise UsageError("scene", "name one scene, before the options: a .ply, a model folder, or -m FOLDER")
    return words.scene or words.model_path


def open_scene(words: Words, path: Path | None = None) -> "Scene":
    """Open the scene that the words name, or one at a path, and say what it is."""
    path = path or path_of(words)
    if not path.exists():  # told before torch is imported
        raise FormatError(path, "cannot be read: no such file")
    from aaplug.methods.conversion import describe

    how: dict[str, Any] = words.keywords(FileOptions) | {"iteration": words.values.get("iteration")}
    how["convention"] = words.convention and CONVENTIONS[words.convention]
    scene = aaplug.read_scene(path, **how)
    facts = f"SH degree {scene.sh_degree}, {scene.convention.name} ({scene.evidence})"
    say(f"scene: {scene.path}: {counted(scene.count, 'Gaussian')}, {facts}")
    for note in scene.notes:
        undecided = scene.other is not None and note == scene.notes[-1]
        text = f"unless the cameras tell otherwise, {note}" if undecided else note
        say(words.command.worded(f"scene: {text}"))
    for fusion in scene.fused:
        say(f"fused: {describe(fusion)}")
    return scene


def read_cameras(words: Words, scene: "Scene") -> "aaplug.CameraSet | Orbit":
    """Read the cameras and say where sizes and split come from; without any, the orbit that stands in for them."""
    how, orbit = words.keywords(CameraOptions), words.of(Orbit)
    named, own, orbits = how.pop("cameras"), scene.camera_path, "views" in words.values and orbit != Orbit()
    path = named or (None if orbits else own)
    if path is None:
        problem = "the views orbit" if own else "there are none; name them with `cameras`"
        given, usual, problem = how, CameraOptions(), f"is of cameras, and {problem}"
    else:
        given, usual, problem = vars(orbit), Orbit(), f"is for scenes without cameras, and there are some: {path}"
    for name, value in given.items():
        if name != "monitor" and value != getattr(usual, name):
            raise UsageError(name, problem)
    if path is None:
        if own:
            say(f"cameras: those of {own} are not drawn, the views are around the scene")
        return orbit
    cameras = aaplug.read_cameras(path, **how)
    for note in cameras.notes:
        say(words.command.worded(f"cameras: {note}"))
    return cameras


def read_inputs(words: Words) -> "tuple[Scene, aaplug.CameraSet | Orbit]":
    """Open the scene and read its cameras, and say what they are."""
    scene = open_scene(words)
    return scene, read_cameras(words, scene)


def told(words: Words, options: type[Options]) -> dict[str, Any]:
    """Keywords of the library's verb: its options, and the terminal to tell."""
    return words.keywords(options) | {"monitor": TERMINAL}
