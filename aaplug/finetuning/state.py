"""The work of a run, its state, and its checkpoints.

n: Gaussians.  The scene is kept as leaves that an optimizer moves.  Colours are two of them, the constant (dc) and the
other harmonics (rest), because 3DGS gives them learning rates of their own.

A checkpoint is one file of everything that the next step depends on, written whole or not at all.  It is torch's, of
tensors, numbers and strings only, and is read as such: nothing in it is executed.
"""

import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from aaplug.core.cameras import Camera, digest_of_cameras
from aaplug.core.gaussians import Gaussians, digest_of_scene
from aaplug.core.sampling import SamplingBounds
from aaplug.evaluation.truth import Truth
from aaplug.finetuning.settings import CONSISTENCY, LEARNED_COLUMNS, Method, Settings
from aaplug.io.atomic import replacing
from aaplug.methods.recipe import Recipe
from aaplug.rendering.renderer import Renderer
from aaplug.system.digests import digest_of_files
from aaplug.system.errors import START_AGAIN, AaplugError, FormatError, UsageError, printable
from aaplug.system.locks import scratch

EPSILON = 1e-15  # of Adam (3DGS)
DYNAMO, DYNAMO_FOLDER = "torch._dynamo", "TORCHINDUCTOR_CACHE_DIR"  # torch's compiler, which its optimizers import
FORMAT, VERSION = "aaplug finetune", 10  # of a checkpoint
WHOLE = ("means", "quats", "log_scales", "logit_opacities")  # leaves that are columns of the scene
SATURATED = 1e3  # a logit or log-scale that looks like an infinite one, in float64 too

Leaves = dict[str, Tensor]


def leaves_of(scene: Gaussians) -> Leaves:
    """Copies of every parameter; infinite ones become finite numbers of the same look, which steps can average."""
    leaves = {name: getattr(scene, name) for name in WHOLE} | {"dc": scene.sh[:, :1], "rest": scene.sh[:, 1:]}
    if scene.learned:
        leaves[LEARNED_COLUMNS] = torch.stack([scene.extras[name] for name in scene.learned], dim=1)
    ends = {"nan": torch.nan, "posinf": SATURATED, "neginf": -SATURATED}
    return {name: value.detach().nan_to_num(**ends) for name, value in leaves.items()}


def scene_of(leaves: Mapping[str, Tensor], like: Gaussians) -> Gaussians:
    """The scene that the leaves stand for.

    If densification changed the number of Gaussians, the link to the rows of the source file is dropped.
    """
    values = {name: leaves[name] for name in WHOLE}
    sh = torch.cat([leaves["dc"], leaves["rest"]], dim=1)
    if len(sh) != len(like):
        return replace(like, **values, sh=sh, origin=None, extras={})
    learned = zip(like.learned, leaves[LEARNED_COLUMNS].unbind(dim=1), strict=True) if like.learned else ()
    return replace(like, **values, sh=sh, extras={**like.extras, **dict(learned)})


def between(start: Gaussians, end: Gaussians, share: float) -> Gaussians:
    """Interpolate two scenes of equally many Gaussians, parameter by parameter: 0 gives the start, 1 the end."""
    first, last = leaves_of(start), leaves_of(end)
    return scene_of({n: first[n].lerp(last[n], share) for n in first}, end)


@dataclass(frozen=True, eq=False)
class TuningJob:
    """A scene to tune, the way it will be drawn, and the images that it should give.

    start: draws the scene that the run starts from as the viewer will; its recipe has no world filter.
    views: training views, at the training size.
    truth: the images that renders are compared with.
    upsampler: what makes its larger images, as text that changes if it does.
    method: the way to fine-tune.
    recipes: by which steps draw in turn; none for the start's.
    """

    start: Renderer
    views: Sequence[Camera]
    truth: Truth
    settings: Settings
    upsampler: str = ""
    method: Method = CONSISTENCY
    recipes: Sequence[Recipe] = ()

    @cached_property
    def facts(self) -> dict[str, str]:
        """Everything that a run depends on, as text that can be compared; files are read once."""
        settings = {key: str(value) for key, value in asdict(self.settings).items()}
        start, truth = self.start, self.truth
        photos = [view.photo for view in self.views if view.photo]
        return settings | {
            "scene": digest_of_scene(start.scene),
            "truth": f"{digest_of_scene(truth.renderer.scene)} {truth.source} {self.upsampler}",
            "recipe": " ".join(f"{recipe.name} {recipe.digest}" for recipe in self.recipes or [start.recipe]),
            "views": digest_of_cameras(self.views),
            "training cameras": digest_of_cameras(start.training.cameras),
            "photographs": digest_of_files(photos) if truth.source == "photographs" else "",
            "background": str(start.background),
            "cull margin": str(start.training.cull_margin),
            "rasterizer": start.rasterizer.name,
        }


@dataclass(eq=False)
class State:
    """How far a run has come; changed in place, step by step.

    first_log_scales: of each Gaussian when the run or densification made it.
    bounds: sampling bounds; they are computed anew every `loop.BOUNDS_EVERY` steps and after each densification.
    gradients: sums over steps that densification needs, by name.
    averages: means of the leaves over the last steps, by name.  averaged: number of these steps.
    group: places of the Gaussians that train and are drawn; None for all.
    bad_steps: consecutive steps without finite gradients.
    curve: number, view and loss by scale of each step.  probes: PSNR measured on the way.
    """

    step: int
    leaves: Leaves
    adam: torch.optim.Adam
    first_log_scales: Float[Tensor, "n 3"]
    bounds: SamplingBounds
    gradients: dict[str, Tensor] = field(default_factory=dict)
    averages: dict[str, Tensor] = field(default_factory=dict)
    averaged: int = 0
    group: Int[Tensor, " k"] | None = None
    bad_steps: int = 0
    curve: list[dict[str, Any]] = field(default_factory=list)
    probes: list[dict[str, Any]] = field(default_factory=list)

    def scene(self, job: TuningJob) -> Gaussians:
        """The scene as it is now."""
        return scene_of({n: leaf.detach() for n, leaf in self.leaves.items()}, job.start.scene)

    def renderer(self, job: TuningJob) -> Renderer:
        """Draws the scene, or the group, as it is now; differentiable in the leaves."""
        scene, training = scene_of(self.leaves, job.start.scene), replace(job.start.training, bounds=self.bounds)
        renderer = replace(job.start, scene=scene, training=training)
        return renderer if self.group is None else part_of(renderer, self.group)

    def renderer_of_step(self, job: TuningJob) -> Renderer:
        """The same, by the recipe of the next step."""
        renderer = self.renderer(job)
        return replace(renderer, recipe=job.recipes[self.step % len(job.recipes)]) if job.recipes else renderer


def part_of(renderer: Renderer, places: Int[Tensor, " k"]) -> Renderer:
    """The same for some of its Gaussians, with their sampling bounds."""
    training = replace(renderer.training, bounds=renderer.training.bounds[places])
    return replace(renderer, scene=renderer.scene[places], training=training)


def begin(job: TuningJob) -> State:
    """The state before the first step; raises UsageError for an empty scene."""
    scene = job.start.scene
    if not len(scene):
        raise UsageError(scene.name, "has no Gaussians to tune")
    leaves = leaves_of(scene)
    return State(0, leaves, optimizer(leaves, job.settings), scene.log_scales, job.start.training.bounds)


def optimizer(leaves: Leaves, settings: Settings) -> torch.optim.Adam:
    """Adam over the leaves that move."""
    if DYNAMO not in sys.modules and DYNAMO_FOLDER not in os.environ:
        with scratch() as folder:  # else it makes one that stays, though nothing is compiled
            os.environ[DYNAMO_FOLDER] = str(folder)
            import_module(DYNAMO)
            del os.environ[DYNAMO_FOLDER]
    moving = [name for name in settings.rates if leaves[name].numel()]
    groups = [{"params": [leaves[name].requires_grad_()], "lr": 0.0, "name": name} for name in moving]
    return torch.optim.Adam(groups, eps=EPSILON)


def save(path: Path, job: TuningJob, state: State) -> None:
    """Write the state; if that fails, an older checkpoint is still whole."""
    leaves = {name: leaf.detach() for name, leaf in state.leaves.items()}
    values = vars(state) | {"leaves": leaves, "adam": state.adam.state_dict(), "bounds": vars(state.bounds)}
    with replacing(path, overwrite=True) as stream:
        torch.save({"format": FORMAT, "version": VERSION, "job": job.facts, "state": values}, stream)


def load(path: Path, job: TuningJob) -> State:
    """The state of a run of this job.

    Raises FormatError if the file is none of this version, and UsageError, which names a difference, for another job.
    """
    try:
        content = torch.load(path, weights_only=True)
        version, expected = f"{content['format']} {content.get('version', '')}".strip(), f"{FORMAT} {VERSION}"
        if version != expected:
            problem = f"is a checkpoint of another version: expected {expected}, got {printable(version)}"
            raise FormatError(path, f"{problem}; {START_AGAIN}")
        for key, value in job.facts.items():
            if (before := content["job"].get(key)) != value:
                problem = f"is of another run: {key} changed from {printable(str(before))} to {value}"
                raise UsageError(str(path), f"{problem}; repeat that run, or {START_AGAIN}")
        values = content["state"]
        adam = optimizer(values["leaves"], job.settings)
        adam.load_state_dict(values["adam"])
        return State(**values | {"adam": adam, "bounds": SamplingBounds(**values["bounds"])})
    except AaplugError:
        raise
    except Exception as error:  # torch raises all kinds over a damaged file
        raise FormatError(path, "is damaged, or no checkpoint") from error
