"""A run as a user sees it: progress, measurements on the way, checkpoints and Ctrl-C."""

import math
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from aaplug.core.cameras import spread
from aaplug.core.conventions import Convention
from aaplug.core.gaussians import Fusion, Gaussians
from aaplug.evaluation.engine import Task, evaluate
from aaplug.evaluation.metrics import PSNR
from aaplug.evaluation.results import mean, scale_name
from aaplug.finetuning.loop import run
from aaplug.finetuning.state import State, TuningJob, begin, load, save
from aaplug.methods.conversion import TUNED
from aaplug.system.monitor import SILENT, Monitor

PROBE_VIEWS = 3  # training views, evenly spaced, that progress is measured on
LOSS_STEPS = 20  # over which the reported loss is averaged


def tune(
    job: TuningJob, checkpoint: Path | None = None, every: int = 100, resume: bool = False, monitor: Monitor = SILENT
) -> State:
    """Run a job to its end, from the checkpoint if `resume`; see `load` and `run` for what they raise.

    Ctrl-C stops it after the current step, once the checkpoint is written; a second Ctrl-C stops it at once.  Both
    raise KeyboardInterrupt.
    """
    if resume and checkpoint is not None and checkpoint.exists():
        state = load(checkpoint, job)
        monitor.say(f"resumed at step {state.step}")
    else:
        state = begin(job)
        if resume:
            monitor.say("there is no checkpoint yet: starting at step 0")
    steps, first, started = job.settings.steps, state.step, time.monotonic()

    def keep(state: State) -> None:
        """Measure a few training views at the training size and the farthest scale; write the checkpoint; say both."""
        scales = list(dict.fromkeys([1.0, max(job.settings.weights, key=lambda s: abs(math.log(s)))]))
        now = {"now": replace(state, group=None).renderer(job)}
        report = evaluate(Task(now, scales, spread(job.views, PROBE_VIEWS), job.truth, ceiling=False))
        psnr = {scale: mean(report.select("now", scale), PSNR.name) for scale in scales}
        state.probes.append({"step": state.step, "psnr": {f"{s:g}": v for s, v in psnr.items()}})
        losses = [loss for step in state.curve[-LOSS_STEPS:] for loss in step["loss"].values()]
        loss = f", loss {sum(losses) / len(losses):.2e}" if losses else ""
        values = {s: "infinite" if v is None else f"{v:.2f}" for s, v in psnr.items()}
        decibels = ", ".join(f"{value} dB at {scale_name(s)}" for s, value in values.items())
        if checkpoint is not None:
            save(checkpoint, job, state)
        pace = (time.monotonic() - started) / max(1, state.step - first)
        monitor.say(f"step {state.step} of {steps}{loss}: {decibels}; {pace:.2f} s per step")

    with monitor.progress("tuning", "steps") as tell, _interruptible(monitor.say) as presses:
        done = run(job, state, every=every, keep=keep, stop=lambda: presses, tell=tell)
    if not done:
        monitor.say(f"stopped at step {state.step}")
        raise KeyboardInterrupt
    return state


def tuned_scene(state: State, job: TuningJob, convention: Convention, settings: Mapping[str, str]) -> Gaussians:
    """The tuned scene with a record of its tuning; after no steps the start itself."""
    if state.step == 0:
        return replace(job.start.scene, convention=convention)
    scene, fusion = state.scene(job), Fusion(TUNED, {"steps": str(state.step), **settings})
    return replace(scene, convention=convention, fused=(*scene.fused, fusion))


@contextmanager
def _interruptible(say: Callable[[str], None]) -> Iterator[list[int]]:
    """Yield a list of the presses of Ctrl-C, of which the second raises KeyboardInterrupt.

    Python lets only the main thread handle signals; in others nothing changes.
    """
    presses: list[int] = []

    def note(number: int, frame: Any) -> None:
        if presses:
            raise KeyboardInterrupt
        presses.append(number)
        say("stopping after this step; press again to stop at once")

    if threading.current_thread() is not threading.main_thread():
        yield presses
        return
    before = signal.signal(signal.SIGINT, note)
    try:
        yield presses
    finally:
        signal.signal(signal.SIGINT, before)
