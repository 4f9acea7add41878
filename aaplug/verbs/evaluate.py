"""Evaluate: measure recipes over scales, against photographs or against the scene's own supersampled look."""

import hashlib
import json
import math
import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from os import PathLike
from pathlib import Path
from typing import Any, get_args

from aaplug.core.cameras import Camera, CameraSet
from aaplug.core.errors import OutputError, UsageError
from aaplug.core.gaussians import Gaussians
from aaplug.core.interfaces import MatchesRates, Rasterizer
from aaplug.core.monitor import SILENT, Monitor
from aaplug.core.sampling import MIN_SEEN_SHARE
from aaplug.core.training import TrainingViews
from aaplug.evaluation.engine import Task
from aaplug.evaluation.engine import evaluate as measure
from aaplug.evaluation.image_store import Images
from aaplug.evaluation.metric import LpipsFlavour, Metric, SsimFlavour
from aaplug.evaluation.metrics import default_metrics, find_metrics, metric_option
from aaplug.evaluation.protocols import PROTOCOLS, Protocol
from aaplug.evaluation.report.files import PAGE, RESULTS, write_page, write_results
from aaplug.evaluation.results import Report
from aaplug.inspection.coverage import coverage
from aaplug.io.cameras import select_views
from aaplug.io.folders import refuse_existing
from aaplug.methods.recipe import Recipe
from aaplug.methods.recipes import RECIPES, USER_RECIPES, find_recipe, suited
from aaplug.rendering.renderer import Background
from aaplug.verbs.inputs import (
    CamerasLike,
    SceneLike,
    background_of,
    cameras_of,
    processor,
    rasterizer_of,
    scene_of,
)

HASH_BLOCK = 1 << 20  # bytes read at once
JOURNAL = "progress.jsonl"
LAYOUTS = ("plain", "inria")
ALL = "all"  # instead of a recipe's name: every recipe that the scene suits
DEFAULT_RECIPES = ("classic", "mip", "matched", "auto")
FLAVOURS = {"ssim": get_args(SsimFlavour), "lpips": get_args(LpipsFlavour)}
PACKAGES = ("aaplug", "torch", "numpy", "scikit-image", "opencv-contrib-python-headless")

Weights = tuple[str | PathLike[str], str | PathLike[str]]


def evaluate(
    scene: SceneLike, cameras: CamerasLike = None, *,
    recipe: Sequence[str] = DEFAULT_RECIPES, scale: Sequence[float] | None = None, views: str = "test",
    protocol: str = "default", truth: str = "auto",
    metric: Sequence[str] | None = None, lpips: Weights | None = None,
    quality: str = "balanced", rate_reference: str | None = None,
    background: Background = "auto", rasterizer: str | Rasterizer = "auto",
    threads: int | None = None, memory: float | None = None,
    cull_margin: float = math.inf, min_seen: float = MIN_SEEN_SHARE,
    output: str | PathLike[str] | None = None, report: bool = False, show: str = "3", layout: str = "plain",
    resume: bool = False, overwrite: bool = False, name: str | None = None, monitor: Monitor = SILENT,
) -> Report:  # fmt: skip
    """Measure recipes at several scales; the parameters are the options of `aaplug evaluate --help`.

    Args:
        recipe: names of `RECIPES`, or "all".
        metric: names of `METRICS`, with a flavour where one is wanted: "ssim:3dgs"; None for `default_metrics`.
        lpips: files of LPIPS's trunk and heads.
        name: of the scene, in the results (default: its file's).

    Raises:
        UsageError: a name is not known, or the request contradicts itself.
        FormatError: a file cannot be read.
        FrameError: the cameras see little of the scene.
        OutputError: the output exists already, or cannot be written.
    """
    out = Output(output and Path(output), report, layout, resume, overwrite)
    out.check()
    rules = find_protocol(protocol)
    metrics, rules = chosen_metrics(metric, rules, lpips)
