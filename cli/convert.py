"""aaplug convert: a plain scene file with anti-aliasing fused in."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from aaplug.evaluation.results import results, tables
from aaplug.methods.viewers import FORMS, VIEWERS, fused_in
from aaplug.verbs import convert as verb

from .console import TERMINAL, out, print_json, say
from .options import CameraOptions, SceneOptions, ViewOptions, arguments, flag


@dataclass(frozen=True)
class Convert:
    """Fuse anti-aliasing into a plain scene file, for the 2D Mip filter (0.1 px², compensated) or a named viewer."""

    output: Annotated[Path, flag("FILE", "-o")]
    """Where to write: .ply, or .spz or .splat, which round values and keep less."""
    scene: SceneOptions = field(default_factory=SceneOptions)
    cameras: CameraOptions = field(default_factory=CameraOptions)
    viewing: ViewOptions = field(default_factory=lambda: ViewOptions(views="train"))
    viewer: Annotated[str | None, flag("|".join(VIEWERS), "--for")] = None
    """Fit the scene to this viewer by a short optimization from the closed form, and print the remaining error."""
    steps: Annotated[int | None, flag("N")] = None
    """With --viewer: steps of the optimization (default: 300, or 0 if the viewer draws as training did); 0 keeps the
    closed form."""
    form: Annotated[str | None, flag("|".join(FORMS))] = None
    """Without --viewer, what to fuse: matched-energy (the default) keeps the energy that training showed;
    mip-splatting is Mip-Splatting's 3D smoothing.  A stored filter_3D is fused as it is."""
    variance: Annotated[float | None, flag("PX2")] = None
    """Without --viewer: variance to fuse, in px² at the training rate (default: 0.2)."""
    overwrite: bool = False
    """Replace an existing output."""
    json: bool = False
    """Print what was done as one JSON object on stdout."""


def convert(options: Convert) -> int:
    """Fuse anti-aliasing into a plain scene file."""
    opened = options.scene.open()
    named = options.cameras.cameras is not None or options.scene.path.is_dir()
    cameras = options.cameras.read(options.scene) if named else None
    found = verb.convert(opened, cameras, monitor=TERMINAL, **arguments(options, verb.convert))
    scene, report = found.scene, found.report
    if options.json:
        facts = {"output": str(options.output), "gaussians": opened.count}
        if scene is not None:
            fused = [{"method": f.method, **f.settings} for f in scene.fused]
            facts |= {"gaussians": len(scene), "fused": fused}
        if report is not None:
            facts |= {"for": found.viewer.name, "residual": results(report)}
        print_json(facts)
    elif report is not None:
        out.print("As the viewer draws it, against the scene's own training-size render:")
        out.print(tables(report)[0])
    how = "in parts" if scene is None else f"fused {fused_in(scene)}"
    say(f"wrote {options.output}: {how}; show it with {found.viewer.rule} ({found.viewer.name})")
    return 0
