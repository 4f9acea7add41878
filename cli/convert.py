"""aaplug convert: a plain .ply with anti-aliasing fused in."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

import torch

from aaplug.conversion import FORMS, default_form, describe
from aaplug.conversion import convert as fuse
from aaplug.io.atomic import check_output
from aaplug.io.scenes import find_scene, write_parts, write_scene
from aaplug.io.scenes.scene_file import SceneFile
from aaplug.streaming import LARGE, check_frame_of, convert_parts

from .console import print_json, progress, say
from .options import CameraOptions, SceneOptions, flag


@dataclass(frozen=True)
class Convert:
    """Fuse anti-aliasing into a plain .ply, for viewers with the 2D Mip filter (0.1 px², compensated)."""

    output: Annotated[Path, flag("FILE.ply", "-o")]
    """Where to write."""
    scene: SceneOptions = field(default_factory=SceneOptions)
    cameras: CameraOptions = field(default_factory=CameraOptions)
    form: Annotated[
        Literal["matched-energy", "mip-splatting"] | None, flag("matched-energy|mip-splatting")
    ] = None
    """What to fuse: the energy that training showed, or Mip-Splatting's 3D smoothing (default for filter_3D files)."""
    variance: Annotated[float | None, flag("PX2")] = None
    """Variance fused, in px² at the training rate (default: 0.2 for both forms)."""
    overwrite: bool = False
    """Replace an existing output."""
    json: bool = False
    """Print what was done as one JSON object on stdout."""


def convert(options: Convert) -> int:
    """Fuse anti-aliasing into a plain .ply."""
    source = find_scene(options.scene.path, options.scene.iteration)
    check_output(options.output, options.overwrite, [source])
    opened = options.scene.open()
    if opened.count > LARGE:
        return _convert_in_parts(options, opened)
    scene = opened.whole(options.scene.drop_bad)
    form = FORMS[options.form or default_form(scene)]
    if options.variance is not None:
        form = replace(form, variance=options.variance)  # type: ignore[type-var]
    stored = scene.filter_3d is not None or bool(scene.fused)  # either needs no cameras
    training = None
    if not stored:
        training = options.cameras.learn(scene, options.cameras.read(options.scene))
    converted = fuse(scene, training, form)
    write_scene(options.output, converted, overwrite=options.overwrite)
    done = "; ".join(describe(fusion) for fusion in converted.fused)
    say(f"wrote {options.output}: fused {done}; show it with the Mip rule (0.1 px², compensated)")
    if options.json:
        fused = [{"method": f.method, **f.settings} for f in converted.fused]
        print_json({"output": str(options.output), "gaussians": len(converted), "fused": fused})
    return 0


def _convert_in_parts(options: Convert, opened: SceneFile) -> int:
    """The same for a scene that would need much memory whole."""
    first = opened.raw(0, min(1, opened.count))
    form = FORMS[options.form or default_form(first)]
    if options.variance is not None:
        form = replace(form, variance=options.variance)  # type: ignore[type-var]
    cameras = ()
    if first.filter_3d is None and not opened.fused:
        cameras = options.cameras.read(options.scene).train
        check_frame_of(opened, cameras, options.cameras.min_seen)
    with progress("converting", "Gaussians") as tell:
        parts = convert_parts(
            opened,
            cameras,
            form,
            options.cameras.guard,
            options.scene.drop_bad,
            tell,
            threads=torch.get_num_threads(),
        )
        write_parts(options.output, parts, opened.count, [opened.path], overwrite=options.overwrite)
    say(f"wrote {options.output}, in parts; show it with the Mip rule (0.1 px², compensated)")
    if options.json:
        print_json({"output": str(options.output), "gaussians": opened.count})
    return 0
