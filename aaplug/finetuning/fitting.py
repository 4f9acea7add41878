"""Fitting a scene to a viewer: the closed form, a short optimization, and a check that it helped.

Where tuning made a scale worse than the original, parts of the change are tried.  The closed form or the original,
whichever is closer, is kept where that does not help, or where tuning did not lower what it minimises.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import reduce
from statistics import fmean

from aaplug.core.cameras import Camera, spread
from aaplug.core.gaussians import Fusion, Gaussians
from aaplug.evaluation.engine import Task, evaluate
from aaplug.evaluation.results import Report, mean_square_error
from aaplug.evaluation.truth import MEMORY, Truth, back_projected
from aaplug.finetuning.session import tune, tuned_scene
from aaplug.finetuning.settings import QUICK_SETTINGS, SHARED_SETTINGS, balance, slowed
from aaplug.finetuning.state import TuningJob, between
from aaplug.methods.conversion import fuse_for
from aaplug.methods.presets import recipe_of
from aaplug.methods.viewers import VIEWERS, Viewer
from aaplug.rendering.renderer import Renderer
from aaplug.system.monitor import SILENT, Monitor

PARTS_OF_CHANGE = (0.5, 0.25, 0.125)  # towards the tuned scene, tried while a scale is worse than the original
MAX_VIEWS = 8  # evenly spaced, that scenes are compared on
ORIGINAL, CLOSED_FORM, CONVERTED = "original", "closed form", "converted"  # rows of the report


def steps_for(scene: Gaussians, viewer: Viewer) -> int:
    """The usual number of steps: none for a viewer that draws as training did."""
    return 0 if scene.convention == viewer.convention_of(scene) else QUICK_SETTINGS.steps


def fit(
    scene: Gaussians, viewer: Viewer, look: Renderer, views: Sequence[Camera], steps: int, monitor: Monitor = SILENT
) -> tuple[Gaussians, Report]:
    """A scene for a viewer, and original, closed form and result as it shows them; raises as `fuse_for` and `tune` do.

    look: draws the scene as training showed it, which the viewer should show.
    views: to measure on; a few of them are taken.  Those of cameras that distort are straight, as viewers draw them.
    steps: of the optimization; 0 keeps the closed form.
    """
    truth = Truth(look, enlarge=back_projected, memory=MEMORY)
    views, train = ([view.straight() for view in each] for each in (spread(views, MAX_VIEWS), look.training.cameras))
    original = replace(look, scene=viewer.shown(look.scene), recipe=recipe_of(viewer))
    recipes = {"": original.recipe}  # by what they add to the names of rows
    recipes |= {f" in {VIEWERS[name].program}": recipe_of(VIEWERS[name]) for name in viewer.shown_by}

    def measure(renderers: Mapping[str, Renderer]) -> Report:
        rows = {name + by: replace(r, recipe=recipe) for by, recipe in recipes.items() for name, r in renderers.items()}
        with monitor.progress("measuring", "views") as tell:
            task = Task(rows, (1.0, *QUICK_SETTINGS.weights), views, truth, ceiling=False)
            return evaluate(task, tell=tell)

    def as_converted(name: str) -> Report:
        return reduce(lambda report, by: report.once_more(name + by, CONVERTED + by), recipes, before)

    def report_of(result: Gaussians) -> Report:
        return before.with_more(measure({CONVERTED: replace(original, scene=result)}))

    def errors_of(report: Report, name: str) -> dict[float, float]:
        """Mean square error of a row by scale, as a mean over the rules."""
        return {s: fmean(mean_square_error(report.select(name + by, s)) for by in recipes) for s in report.scales}

    def is_worse(report: Report, name: str) -> bool:
        before, after = (errors_of(report, row) for row in (ORIGINAL, name))
        return any(after[scale] > before[scale] for scale in report.scales)

    def loss_of(report: Report, name: str) -> float:
        errors = errors_of(report, name)
        return settings.anchor * errors[1.0] + sum(weight * errors[s] for s, weight in settings.weights.items())

    closed_form = replace(original, scene=fuse_for(scene, original.training, viewer))
    renderers = {ORIGINAL: original, CLOSED_FORM: closed_form}
    before = measure(renderers)
    start = CLOSED_FORM
    if steps and is_worse(before, CLOSED_FORM):
        problem = "the closed form is worse than the original at some scale"
        monitor.say(f"{problem}: starting from the original")
        start = ORIGINAL
    usual = SHARED_SETTINGS if viewer.shown_by else QUICK_SETTINGS
    settings = balance(replace(usual, steps=steps), errors_of(before, ORIGINAL))
    slow = slowed(settings, errors_of(before, start))
    job = TuningJob(renderers[start], train, truth, slow, recipes=[*recipes.values()])
    state = tune(job, monitor=monitor)
    tuned = result = tuned_scene(state, job, viewer.convention_of(scene), {"for": viewer.name})
    report = report_of(result) if steps else as_converted(CLOSED_FORM)
    for part in PARTS_OF_CHANGE if state.step else ():
        if not is_worse(report, CONVERTED):
            break
        monitor.say(f"worse than the original at some scale: taking {part:g} of the change")
        *earlier, tuning = tuned.fused
        record = Fusion(tuning.method, tuning.settings | {"share": f"{part:g}"})
        result = replace(between(original.scene, tuned, part), fused=(*earlier, record))
        report = report_of(result)
    losses = {row: loss_of(report, row) for row in (CLOSED_FORM, ORIGINAL, CONVERTED)}
    problem = ""
    if state.step and is_worse(report, CONVERTED):
        problem = "still worse than the original at some scale"
    elif state.step and start == CLOSED_FORM and losses[CONVERTED] >= losses[CLOSED_FORM]:
        problem = "tuning did not bring it closer, over all scales"
    if problem:
        kept = min(CLOSED_FORM, ORIGINAL, key=losses.__getitem__)
        monitor.say(f"{problem}: keeping the {kept}, which is closer over all scales")
        result = replace(renderers[kept].scene, convention=viewer.convention_of(scene))
        report = as_converted(kept)
    return result, report
