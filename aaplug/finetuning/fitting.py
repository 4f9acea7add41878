"""Fitting a scene to a viewer: the closed form, a short optimization, and a check that no scale became worse."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from aaplug.core.cameras import Camera, spread
from aaplug.core.gaussians import Fusion, Gaussians
from aaplug.core.monitor import SILENT, Monitor
from aaplug.evaluation.engine import Candidate, compare
from aaplug.evaluation.metrics import PSNR
from aaplug.evaluation.results import Report, mean
from aaplug.evaluation.truth import MEMORY, Truth, back_projected
from aaplug.finetuning.parameters import between
from aaplug.finetuning.session import recorded, tune
from aaplug.finetuning.settings import QUICK, balanced
from aaplug.finetuning.state import TuningJob
from aaplug.methods.recipes import RECIPES
from aaplug.methods.viewers import Viewer, fuse_for
from aaplug.rendering.renderer import Renderer

SHARES = (0.5, 0.25, 0.125)  # of the way to the tuned scene, tried while a scale is worse than the original
ROUNDING = (1 / 255) ** 2 / 12  # mean square error of rounding to 8 bits
MEASURED = 8  # views, evenly spaced, that scenes are compared on
ORIGINAL, CLOSED_FORM, CONVERTED = "original", "closed form", "converted"  # rows of the report


@dataclass(frozen=True)
class Fitted:
    """A scene for a viewer.  report: original, closed form and result as the viewer shows them."""

    scene: Gaussians
    report: Report


def steps_for(scene: Gaussians, viewer: Viewer) -> int:
    """The usual number of steps: none for a viewer that draws as training did."""
    return 0 if scene.convention == viewer.convention_of(scene) else QUICK.steps


def fit(
    scene: Gaussians, viewer: Viewer, look: Renderer, views: Sequence[Camera], steps: int, monitor: Monitor = SILENT
) -> Fitted:
    """Convert a scene for a viewer; raises as `fuse_for` and `tune` do.

    look: draws the scene as training showed it, which the viewer should show.
    views: to measure on; a few of them are taken.
    steps: of the optimization; 0 keeps the closed form.
    """
    truth = Truth(look, enlarge=back_projected, memory=MEMORY)
    original = replace(look, scene=viewer.shown(look.scene), recipe=RECIPES[viewer.recipe])

    def measured(*candidates: Candidate) -> Report:
        with monitor.progress("measuring", "views") as tell:
            return compare(candidates, spread(views, MEASURED), (1.0, *QUICK.weights), truth, tell)

    def with_result(found: Gaussians) -> Report:
        return before.with_more(measured(Candidate(CONVERTED, replace(original, scene=found))))

    start = replace(original, scene=fuse_for(scene, original.training, viewer))
    before = measured(Candidate(ORIGINAL, original), Candidate(CLOSED_FORM, start))
    if steps and _is_worse(before, CLOSED_FORM):
        monitor.say("the closed form is worse than the original at some scale: starting from the original")
        start = original
    settings = balanced(replace(QUICK, steps=steps), _errors(before))
    job = TuningJob(start, original.training.cameras, truth, settings)
    state = tune(job, monitor=monitor)
    tuned = found = recorded(state, job, viewer.convention_of(scene), {"for": viewer.name})
    report = with_result(found)
    for share in SHARES if state.step else ():
        if not _is_worse(report, CONVERTED):
            break
        monitor.say(f"worse than the original at some scale: taking {share:g} of the change")
        *earlier, tuning = tuned.fused
        partly = Fusion(tuning.method, tuning.settings | {"share": f"{share:g}"})
        found = replace(between(original.scene, tuned, share), fused=(*earlier, partly))
        report = with_result(found)
    if state.step and _is_worse(report, CONVERTED):
        monitor.say("still worse than the original at some scale: read the table before you use it")
    return Fitted(found, report)


def _errors(report: Report) -> dict[float, float]:
    """The original's mean square error by scale, at least that of rounding."""
    psnr = {s: mean(report.select(ORIGINAL, s), PSNR.name) for s in report.scales}
    return {s: max(ROUNDING, 0.0 if d is None else 10 ** (-d / 10)) for s, d in psnr.items()}


def _is_worse(report: Report, name: str) -> bool:
    """Whether a row has a lower PSNR than the original at any scale; None means equal to the truth."""
    for scale in report.scales:
        before, after = (mean(report.select(n, scale), PSNR.name) for n in (ORIGINAL, name))
        if after is not None and (before is None or after < before):
            return True
    return False
