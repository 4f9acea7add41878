"""aaplug as a method of nerfbaselines (Kulhanek & Sattler 2024), which finds this module by its entry point.

nerfbaselines trains, saves, renders and evaluates.  There is nothing to train here: "training" takes a scene's file and
the data set's cameras, and saves both, with the recipe, as a checkpoint:

    scene.ply         the scene as its file stores it
    transforms.json   its training cameras
    aaplug.json       recipe, quality and background
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from aaplug.core.cameras import Camera
from aaplug.core.colours import BLACK
from aaplug.core.imaging import levels
from aaplug.evaluation.report.files import as_json, write_texts
from aaplug.io.atomic import make_folder
from aaplug.io.cameras import read_cameras
from aaplug.io.scenes import read_scene, write_scene
from aaplug.io.values import object_of, read_json, text
from aaplug.rendering.renderer import Renderer
from aaplug.system.errors import UsageError, not_one_of

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
FOCAL_TOLERANCE = 1e-4  # relative: focal lengths of a data set that lie closer are one
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
        """Take a scene and its cameras; raises AaplugError if something is missing or not known.

        checkpoint: a folder that `save` wrote; None for a new one.
        train_dataset: nerfbaselines' data set that the scene was trained on; needed without a checkpoint.
        config_overrides: scene (its file), recipe and quality.
        """
        overrides = dict(config_overrides or {})
        path = overrides.pop("scene", None)
        for name in overrides.keys() - DEFAULTS.keys():
            raise UsageError(f"--set {name}", not_one_of(name, ["scene", *DEFAULTS]))
        self.checkpoint = checkpoint
        if checkpoint is not None:
            folder = Path(checkpoint)
            file = folder / SETTINGS
            entry = object_of(read_json(file), file, "the settings", "recipe, quality and background", "background")
            background = entry.vector("background", 3)
            right = bool(((background >= 0) & (background <= 1)).all())
            entry.place.expect(right, "background", "three numbers from 0 to 1", background.tolist())
            stored = {name: entry.get(name, text) for name in DEFAULTS} | {"background": background.tolist()}
            self.settings = stored | overrides
            self.scene, self.cameras = read_scene(folder / SCENE).gaussians(), read_cameras(folder / CAMERAS).all
        elif path is None or train_dataset is None:
            raise UsageError("--set scene", "name the file of the scene that was trained on this data set")
        else:
            colour = train_dataset["metadata"].get("background_color")
            background = BLACK if colour is None else [float(level) / LARGEST_LEVEL for level in colour]
            self.settings = DEFAULTS | overrides | {"background": background}
            cameras = enumerate(train_dataset["cameras"])  # photographs may lie anywhere, so numbers name them
            self.cameras = [_camera(camera, f"view_{index:05}").as_trained() for index, camera in cameras]
            self.scene = read_scene(path).gaussians()
        settings: dict[str, Any] = self.settings
        red, green, blue = settings["background"]
        recipe, quality = settings["recipe"], settings["quality"]
        self.renderer = Renderer.of(self.scene, self.cameras, recipe, quality=quality, background=(red, green, blue))

    @classmethod
    def get_method_info(cls) -> dict[str, Any]:
        """Needs and outputs of the method, for nerfbaselines."""
        return dict(FACTS)

    def get_info(self) -> dict[str, Any]:
        """The same, and the settings."""
        loaded = {"loaded_step": None if self.checkpoint is None else 0, "loaded_checkpoint": self.checkpoint}
        return FACTS | {"num_iterations": 0, **loaded, "hparams": dict(self.settings)}

    def get_train_embedding(self, index: int) -> None:
        """There are no embeddings."""

    def optimize_embedding(self, dataset: Mapping[str, Any], *, embedding: Any = None) -> dict[str, Any]:
        """Raise UsageError: there are none."""
        raise UsageError("aaplug", "has no embeddings to optimize")

    def render(self, camera: Any, *, options: Mapping[str, Any] | None = None) -> dict[str, np.ndarray]:
        """Render one of nerfbaselines' cameras: color [h, w, 3] and accumulation [h, w].

        Colours are rounded to bytes, or in [0, 1] if `output_type_dtypes` asks for floats.  Those nerfbaselines would
        cut to bytes without rounding: 0.01 dB on the chair.

        A view with the focal length of the training cameras is taken for a pose of the data set, every other one for a
        free camera.
        """
        view = _camera(camera.item(), "view")
        of_training = any(abs(c.focal / view.focal - 1) < FOCAL_TOLERANCE for c in self.cameras)
        with torch.no_grad():
            image = self.renderer(view.as_trained() if of_training else view)
        as_bytes = (options or {}).get("output_type_dtypes", {}).get("color", "uint8") == "uint8"
        colour = levels(image.rgb, 8).to(torch.uint8) if as_bytes else image.rgb.clamp(0, 1)
        return {"color": colour.numpy(), "accumulation": image.alpha.numpy()}

    def train_iteration(self, step: int) -> dict[str, float]:
        """Raise UsageError: there is nothing to train."""
        raise UsageError("aaplug", "trains nothing: it renders a scene that was trained elsewhere")

    def save(self, path: str) -> None:
        """Write the scene, its training cameras and the recipe into a folder."""
        folder = make_folder(path)
        write_scene(folder / SCENE, self.scene, overwrite=True)
        frames = []
        for c in self.cameras:
            pose = torch.linalg.inv(c.cam_from_world).numpy() @ OPENGL
            sizes = {"w": c.width, "h": c.height, "cx": c.cx, "cy": c.cy, "fl_x": c.fx, "fl_y": c.fy}
            frames.append({"file_path": c.name, **sizes, "transform_matrix": pose.tolist()})
        write_texts(folder, {CAMERAS: as_json({"frames": frames}), SETTINGS: as_json(self.settings)}, overwrite=True)


def _camera(camera: Any, name: str) -> Camera:
    """One of nerfbaselines' cameras: camera to world with OpenCV's axes, fx, fy, cx, cy, and width and height."""
    fx, fy, cx, cy = camera.intrinsics.astype(float).tolist()
    width, height = camera.image_sizes.tolist()
    world_from_cam = torch.eye(4, dtype=torch.float64)
    world_from_cam[:3] = torch.from_numpy(camera.poses.astype(np.float64))[:3, :4]
    return Camera(name, width, height, fx, fy, cx, cy, torch.linalg.inv(world_from_cam))


register(  # pyright: ignore[reportCallIssue]
    {
        "id": "aaplug",
        "method_class": "aaplug.evaluation.nerfbaselines:Aaplug",
        "backends_order": ["python"],
        "metadata": {
            "name": "aaplug",
            "description": "Anti-aliased rendering of pretrained 3D Gaussian Splatting scenes, on the CPU.",
            "licenses": [{"name": "Apache 2.0"}],
        },
    }
)
