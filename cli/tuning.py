"""What `finetune` and `convert --for` share: a run on the terminal, with its progress, its checkpoints and Ctrl-C."""

import math
import signal
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from aaplug.core.cameras import Camera
from aaplug.core.gaussians import Convention, Fusion, Gaussians
from aaplug.evaluation.results import Report, mean, scale_name
from aaplug.finetuning import Candidate, Job, State, Truth, begin, compare, load, run, save
from aaplug.methods.viewers import TUNED

from .console import progress, say

INTERRUPTED = 130  # exit code
PROBES = 3  # training views, evenly spread, by which progress is told


@dataclass
class Watch:
    """Tells how a run goes."""

    job: Job
    checkpoint: Path | None
    started: float
    first: int

    def keep(self, state: State, good: Mapping[str, Any]) -> None:
        """Measure a few training views, and write the checkpoint."""
        scales = _ends(self.job)
        report = compare(
            [Candidate("now", state.scene(self.job), self.job.recipe)],
            spread(self.job.views, PROBES),
            scales,
            self.job.truth,
        )
        decibels = {s: mean(report.select("now", s), "PSNR") for s in scales}
        state.probes.append(
            {"step": state.step, "psnr": {f"{s:g}": d for s, d in decibels.items()}}
        )
        if self.checkpoint is not None:
            save(self.checkpoint, self.job, state, good)
        told = ", ".join(f"{_number(d)} dB at {scale_name(s)}" for s, d in decibels.items())
        pace = (time.monotonic() - self.started) / max(1, state.step - self.first)
        lost = f", loss {_recent(state):.2e}" if state.curve else ""
        say(f"step {state.step} of {self.job.settings.steps}{lost}: {told}; {pace:.2f} s a step")


def tune(
    job: Job, checkpoint: Path | None = None, every: int = 100, resume: bool = False
) -> tuple[State, bool]:
    """Run a job; its state, and whether it is done (Ctrl-C stops it after a step).

    Raises:
        FormatError, UsageError: there is nothing to resume, or it is of another run.
        OutputError: the checkpoint cannot be written.
    """
    state, good = load(checkpoint, job) if resume and checkpoint else (begin(job), None)
    if resume:
        say(f"resumed at step {state.step}")
    with progress("tuning", "steps") as tell, _interruptible() as stopped:
        watch = Watch(job, checkpoint, time.monotonic(), state.step)

        def stop() -> bool:
            tell(state.step, job.settings.steps)
            return stopped()

        done = run(job, state, good, every=every, keep=watch.keep, stop=stop, say=say)
        if done:
            tell(job.settings.steps, job.settings.steps)
    return state, done


def recorded(state: State, job: Job, convention: Convention, settings: dict[str, str]) -> Gaussians:
    """The tuned scene with the record of its tuning; the start itself after no steps."""
    if state.step == 0:
        return replace(job.start, convention=convention)
    scene = state.scene(job)
    steps = {"steps": str(state.step), **settings}
    fusion = Fusion(TUNED, steps)
    return replace(scene, convention=convention, fused=(*scene.fused, fusion))


def spread(views: Sequence[Camera], most: int) -> Sequence[Camera]:
    """At most so many views, evenly spread."""
    return views[:: max(1, -(-len(views) // most))]


def measured(
    candidates: Sequence[Candidate], views: Sequence[Camera], scales: Sequence[float], truth: Truth
) -> Report:
    """Measure scenes side by side, with progress."""
    with progress("measuring", "views") as tell:
        return compare(candidates, views, scales, truth, tell)


@contextmanager
def _interruptible() -> Iterator[Callable[[], bool]]:
    """Whether Ctrl-C was pressed; the second one is not waited for."""
    pressed: list[int] = []

    def note(number: int, frame: Any) -> None:
        if pressed:
            raise KeyboardInterrupt
        pressed.append(number)
        say("stopping after this step; press again to stop at once")

    before = signal.signal(signal.SIGINT, note)
    try:
        yield lambda: bool(pressed)
    finally:
        signal.signal(signal.SIGINT, before)


def _ends(job: Job) -> list[float]:
    """The training size and the scale farthest from it."""
    return list(dict.fromkeys([1.0, max(job.settings.weights, key=lambda s: abs(math.log(s)))]))


def _recent(state: State) -> float:
    """Mean loss of the last steps, over the scales that they drew."""
    losses = [loss for step in state.curve[-20:] for loss in step["loss"].values()]
    return sum(losses) / len(losses)


def _number(decibels: float | None) -> str:
    return "infinite" if decibels is None else f"{decibels:.2f}"
