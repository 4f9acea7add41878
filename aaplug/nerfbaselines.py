"""aaplug as a method of nerfbaselines (Kulhanek & Sattler 2024), which finds this module by its entry point.

nerfbaselines trains, saves, renders and evaluates.  There is nothing to train here: "training" takes a scene's file and
the data set's cameras, and saves both, with the recipe, as a checkpoint:

    scene.ply         the scene as its file stores it
    transforms.json   its training cameras
    aaplug.json       recipe, quality and background
"""

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from aaplug.core.cameras import BLACK, Camera
from aaplug.core.errors import UsageError, not_one_of
from aaplug.core.imaging import levels
from aaplug.io.cameras import read_cameras
from aaplug.io.scenes import read_scene, write_scene
from aaplug.rendering.renderer import Renderer

from nerfbaselines import register  # pyright: ignore  # isort: skip

SCENE, CAMERAS, SETTINGS = "scene.ply", "transforms.json", "aaplug.json"
DEFAULTS = {"recipe": "auto", "quality": "balanced"}
FACTS = {
    "method_id": "aaplug",
    "required_features": frozenset(),
    "supported_camera_models": frozenset({"pinhole"}),
    "supported_outputs": ("color", "accumulation"),
    "can_resume_training": False,
}
ALIKE = 1e-4  # relative; focal lengths of a data set that lie closer are one
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])  # y up and z backward, as transforms.json has them
LARGEST_LEVEL = 255


class Aaplug:
    """A scene that was trained elsewhere, drawn by one of aaplug's recipes."""

    def __init__(
        self,
        *,
        checkpoint: str | None = None,
        train_dataset: Mapping[str, Any] | None = None,
        config_overrides: Mapping[str, Any] | None = None,
    ) -> None:
        """Take a scene and its cameras.

        Args:
            checkpoint: a folder that `save` wrote; None for a new one.
            train_dataset: nerfbaselines' data set that the scene was trained on; needed without a checkpoint.
            config_overrides: scene (its file), recipe and quality.

        Raises:
            UsageError: something is missing, or not known.
        """
        chosen = dict(config_overrides or {})
        path = chosen.pop("scene", None)
        unknown = next((name for name in chosen if name not in DEFAULTS), None)
        if unknown is not None:
            raise UsageError(f"--set {unknown}", not_one_of(unknown, ["scene", *DEFAULTS]))
        self.checkpoint = checkpoint
        if checkpoint is not None:
            folder = Path(checkpoint)
            self.settings = json.loads((folder / SETTINGS).read_text()) | chosen
            self.scene, self.cameras = read_scene(folder / SCENE), read_cameras(folder / CAMERAS).all
        elif path is None or train_dataset is None:
            raise UsageError("--set scene", "name the file of the scene that was trained on this data set")
        else:
            colour = train_dataset["metadata"].get("background_color")
            background = BLACK if colour is None else [float(level) / LARGEST_LEVEL for level in colour]
            self.settings = DEFAULTS | chosen | {"background": background}
            self.scene, self.cameras = read_scene(path), _training_cameras(train_dataset)
        settings: dict[str, Any] = self.settings
        red, green, blue = settings["background"]
        recipe, quality = settings["recipe"], settings["quality"]
        self.renderer = Renderer.of(self.scene, self.cameras, recipe, quality=quality, background=(red, green, blue))

    @classmethod
    def get_method_info(cls) -> dict[str, Any]:
        """What the method needs and gives, for nerfbaselines."""
        return dict(FACTS)

    def get_info(self) -> dict[str, Any]:
        """The same, and what was chosen."""
        step = None if self.checkpoint is None else 0
        return FACTS | {
            "num_iterations": 0,
            "loaded_step": step,
            "loaded_checkpoint": self.checkpoint,
            "hparams": dict(self.settings),
        }

    def get_train_embedding(self, index: int) -> None:
        """There are no embeddings."""

    def optimize_embedding(self, dataset: Mapping[str, Any], *, embedding: Any = None) -> dict[str, Any]:
        """There are none to optimize."""
        raise UsageError("aaplug", "has no embeddings to optimize")

    def render(self, camera: Any, *, options: Mapping[str, Any] | None = None) -> dict[str, np.ndarray]:
        """Render one of nerfbaselines' cameras: color [h, w, 3] and accumulation [h, w].

        Colours are rounded to bytes, or in [0, 1] if `output_type_dtypes` asks for floats.  Those nerfbaselines would
        cut to bytes without rounding: 0.01 dB on the chair.

        A view with the focal length of the training cameras is taken for a pose of the data set, every other one for a
        free camera.
        """
        view = _camera(camera.item(), "view")
        trained = [c for c in self.cameras if abs(c.focal / view.focal - 1) < ALIKE]
        with torch.no_grad():
            image = self.renderer(view.as_trained() if trained else view)
        kinds = (options or {}).get("output_type_dtypes", {})
        as_bytes = kinds.get("color", "uint8") == "uint8"
        colour = levels(image.rgb, 8).to(torch.uint8) if as_bytes else image.rgb.clamp(0, 1)
        return {"color": colour.numpy(), "accumulation": image.alpha.numpy()}

    def train_iteration(self, step: int) -> dict[str, float]:
        """There is nothing to train.

        Raises:
            UsageError: always.
        """
        raise UsageError("aaplug", "trains nothing: it renders a scene that was trained elsewhere")

    def save(self, path: str) -> None:
        """Write the scene, its training cameras and the recipe into a folder."""
        folder = Path(path)
        folder.mkdir(parents=True, exist_ok=True)
        write_scene(folder / SCENE, self.scene, overwrite=True)
        frames = [_frame(camera) for camera in self.cameras]
        (folder / CAMERAS).write_text(json.dumps({"frames": frames}))
        (folder / SETTINGS).write_text(json.dumps(self.settings))


def _training_cameras(dataset: Mapping[str, Any]) -> Sequence[Camera]:
    """The cameras of a data set, by the names of their photographs in its folder."""
    root = dataset["image_paths_root"]
    pairs = zip(dataset["image_paths"], dataset["cameras"], strict=True)
    return [_camera(camera, os.path.relpath(path, root)).as_trained() for path, camera in pairs]


def _camera(camera: Any, name: str) -> Camera:
    """One of nerfbaselines' cameras: camera to world with OpenCV's axes, fx, fy, cx, cy, and width and height."""
    fx, fy, cx, cy = camera.intrinsics.astype(float).tolist()
    width, height = camera.image_sizes.tolist()
    world_from_cam = torch.eye(4, dtype=torch.float64)
    world_from_cam[:3] = torch.from_numpy(camera.poses.astype(np.float64))[:3, :4]
    return Camera(name, width, height, fx, fy, cx, cy, torch.linalg.inv(world_from_cam))


def _frame(camera: Camera) -> dict[str, Any]:
    """A camera's entry in transforms.json."""
    pose = torch.linalg.inv(camera.cam_from_world).numpy() @ OPENGL
    sizes = {"w": camera.width, "h": camera.height, "cx": camera.cx, "cy": camera.cy}
    return sizes | {"file_path": camera.name, "fl_x": camera.fx, "fl_y": camera.fy, "transform_matrix": pose.tolist()}


register(  # pyright: ignore[reportCallIssue]
    {
        "id": "aaplug",
        "method_class": "aaplug.nerfbaselines:Aaplug",
        "backends_order": ["python"],
        "metadata": {
            "name": "aaplug",
            "description": "Anti-aliased rendering of pretrained 3D Gaussian Splatting scenes, on the CPU.",
            "licenses": [{"name": "Apache 2.0"}],
        },
    }
)
