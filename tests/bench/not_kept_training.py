"""Fine-tuning by what was tried and not kept: python -m tests.bench.not_kept_training [STEPS] [SCENE ...].

Losses in the frequency domain, and Group Training, against the usual steps on the same views.  The ground truth is the
photographs.  Prints a table of PSNR and SSIM on test views at every scale, and seconds of one processor.
"""

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from aaplug.core.cameras import Camera
from aaplug.core.sampling import SamplingBounds
from aaplug.core.training import TrainingViews
from aaplug.evaluation.engine import Candidate, compare
from aaplug.evaluation.results import Report, mean
from aaplug.evaluation.truth import MEMORY, Truth, own_look
from aaplug.finetuning.loop import advance
from aaplug.finetuning.losses import LOSSES, l2
from aaplug.finetuning.settings import OURS
from aaplug.finetuning.state import State, TuningJob, begin
from aaplug.io.cameras import read_cameras
from aaplug.io.scenes import read_scene
from aaplug.rendering.renderer import Renderer
from tests.bench.away import SCENES
from tests.conftest import SHARED_DATA

STEPS = 200
TEST_VIEWS = {"chair": 5, "snowmiku": 4}
SCALES = (1.0, *OURS.weights)
GROUP_SHARE = 0.6  # of the Gaussians that train at a time
REGROUPED = 60  # times in a run, as every 500 of 30,000 steps
WHOLE_FROM = 0.8  # share of the run after which all Gaussians train

Image = Float[Tensor, "h w 3"]


def spectrum(image: Image) -> Tensor:
    """Orthonormal Fourier transform of each channel."""
    return torch.fft.fft2(image, dim=(0, 1), norm="ortho")


def amplitude_error(image: Image, truth: Image) -> Float[Tensor, ""]:
    """Mean absolute difference of the spectra's amplitudes."""
    return (spectrum(image).abs() - spectrum(truth).abs()).abs().mean()


def focal_frequency(image: Image, truth: Image) -> Float[Tensor, ""]:
    """Focal frequency loss (Jiang et al. 2021, eq. 8 and 9) with its exponent of 1.

    Mean of w |F - F'|², with the weight w = |F - F'| / max |F - F'| of each channel, which has no gradient.
    """
    error = (spectrum(image) - spectrum(truth)).abs()
    weight = (error / error.amax(dim=(0, 1)).clamp(min=1e-12)).detach()
    return (weight * error.square()).mean()


TRIED_LOSSES = {
    "l2 + 0.1 amplitudes": lambda a, b: l2(a, b) + 0.1 * amplitude_error(a, b),
    "l2 + 10 focal frequency": lambda a, b: l2(a, b) + 10 * focal_frequency(a, b),
}


@dataclass
class Grouped(State):
    """A run of which one group of the Gaussians is drawn.  group: their indices, None for all."""

    group: Int[Tensor, " k"] | None = field(default=None)

    def renderer(self, job: TuningJob) -> Renderer:
        """Draws the group as it is now."""
        whole = super().renderer(job)
        if self.group is None:
            return whole
        bounds = SamplingBounds(**{name: column[self.group] for name, column in vars(whole.training.bounds).items()})
        return replace(whole, scene=whole.scene[self.group], training=replace(whole.training, bounds=bounds))


@dataclass(frozen=True)
class Groups:
    """Group Training (Wang et al. 2025): a group trains, the others are cached.  shown: the others are drawn too."""

    by_opacity: bool
    shown: bool = False

    def cached(self, opacities: Float[Tensor, " n"], seed: int) -> Bool[Tensor, " n"]:
        """Those outside of a new group, which is drawn without replacement, by opacity or each alike."""
        generator = torch.Generator().manual_seed(seed)
        weights = opacities if self.by_opacity else torch.ones_like(opacities)
        group = torch.multinomial(weights, round(GROUP_SHARE * len(weights)), generator=generator)
        return torch.ones_like(weights, dtype=torch.bool).index_fill_(0, group, False)


@dataclass(frozen=True)
class Training:
    """One way to fine-tune.  longer: factor on the steps, to take as much time as the usual way."""

    loss: str = OURS.loss
    groups: Groups | None = None
    seed: int = 0
    longer: float = 1.0


TRIED: dict[str, Training] = {
    "l2 (usual)": Training(),
    "the same, another seed": Training(seed=1),
    **{name: Training(name) for name in TRIED_LOSSES},
    "groups by opacity": Training(groups=Groups(by_opacity=True)),
    "groups by opacity, as long": Training(groups=Groups(by_opacity=True), longer=1.4),
    "groups at random": Training(groups=Groups(by_opacity=False)),
    "groups by opacity, all drawn": Training(groups=Groups(by_opacity=True, shown=True)),
}


def main(steps: int = STEPS, names: Sequence[str] = tuple(TEST_VIEWS)) -> None:
    torch.set_num_threads(1)
    LOSSES.update(TRIED_LOSSES)
    for name in names:
        measure(name, steps)


def measure(name: str, steps: int) -> None:
    """Print a scene's table, a row as it is measured."""
    how = SCENES[name]
    cameras, scene = read_cameras((SHARED_DATA / how.file).parent), read_scene(SHARED_DATA / how.file)
    look = own_look(scene, TrainingViews.of(scene, cameras, how.cull_margin), background=how.background)
    views = cameras.test[:: -(-len(cameras.test) // TEST_VIEWS[name])]
    print(f"\n{name}, {steps} steps, views {', '.join(view.name for view in views)}\n", flush=True)
    print("| | PSNR, dB | SSIM | s |\n|---|---|---|---|")
    print(row("not tuned", reported(look, views), 0.0), flush=True)
    job = TuningJob(look, cameras.train, Truth(look, "photographs", memory=MEMORY), OURS)
    for label, training in TRIED.items():
        settings = replace(OURS, steps=round(steps * training.longer), loss=training.loss, seed=training.seed)
        state, seconds = run(replace(job, settings=settings), training.groups)
        tuned = replace(look, scene=state.scene(job))
        print(row(label, reported(tuned, views), seconds), flush=True)


def run(job: TuningJob, groups: Groups | None) -> tuple[Grouped, float]:
    """Take all steps; the state after them, and the seconds that one processor took for them."""
    state, seconds, cached = Grouped(**vars(begin(job))), 0.0, None
    steps = job.settings.steps
    for step in range(steps):
        if groups and step % max(1, steps // REGROUPED) == 0:
            opacities = state.leaves["logit_opacities"].detach().sigmoid()
            cached = groups.cached(opacities, step) if step < WHOLE_FROM * steps else None
            state.group = None if cached is None or groups.shown else (~cached).nonzero()[:, 0]
        before = [] if cached is None else [(column, column.detach()[cached]) for column in columns(state)]
        started = time.process_time()
        advance(job, state)
        seconds += time.process_time() - started
        for column, was in before:
            column.data[cached] = was
    return state, seconds


def columns(state: State) -> list[Tensor]:
    """Every parameter, and Adam's moments of it."""
    leaves = list(state.leaves.values())
    moments = (m for leaf in leaves for m in state.adam.state.get(leaf, {}).values() if m.shape == leaf.shape)
    return [*leaves, *moments]


def reported(renderer: Renderer, views: Sequence[Camera]) -> Report:
    """The test views against their photographs."""
    with torch.no_grad():
        return compare([Candidate("", renderer)], views, SCALES, Truth(renderer, "photographs"))


def row(label: str, report: Report, seconds: float) -> str:
    """A line of the table."""
    cells = []
    for metric, digits in (("PSNR", 2), ("SSIM", 4)):
        values = (mean(report.select("", scale), metric) or 0.0 for scale in SCALES)
        cells.append(" / ".join(f"{value:.{digits}f}" for value in values))
    return f"| {label} | {' | '.join(cells)} | {seconds:.0f} |"


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else STEPS, sys.argv[2:] or tuple(TEST_VIEWS))
