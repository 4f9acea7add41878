"""A plain scene file with anti-aliasing fused in."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path

from aaplug.core.errors import UsageError
from aaplug.core.gaussians import Gaussians
from aaplug.core.interfaces import Rasterizer
from aaplug.core.monitor import SILENT, Monitor
from aaplug.core.sampling import MIN_SEEN_SHARE
from aaplug.core.training import TrainingViews
from aaplug.evaluation.results import Report
from aaplug.evaluation.truth import Truth, back_projected, own_look
from aaplug.finetuning.fitting import fit, steps_for
from aaplug.inspection.survey import check_frame_of
from aaplug.io.cameras import select_views
from aaplug.io.scenes import SpzAxes, check_scene_output, find_scene, open_scene, write_parts, write_scene
from aaplug.io.scenes.scene_file import SceneFile
from aaplug.methods.viewers import FORMS, MATCHED_ENERGY, VIEWERS, Form, Viewer, fuse, fused_in
from aaplug.rendering.renderer import Background, Renderer
from aaplug.verbs.in_parts import LARGE, convert_parts
from aaplug.verbs.inputs import CamerasLike, background_of, cameras_of, processor, rasterizer_of
