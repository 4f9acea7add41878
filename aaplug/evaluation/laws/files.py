"""Laws of metrics and losses, and of formats of scenes and cameras."""

import math
import tempfile
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from aaplug.core.imaging import quantised
from aaplug.evaluation.metric import Metric
from aaplug.io.cameras import CameraFormat
from aaplug.io.scenes import SCENE_FORMATS, SceneFormat, WritableFormat
from aaplug.io.scenes.rows import SceneFileOptions
from aaplug.system.errors import FormatError, UsageError
from aaplug.system.locks import OUR_PREFIX

from .base import copies_of, make_scene, require, require_same

COUNT = 20  # Gaussians
HEADS = (b"", b"\0" * 64, b"\xff" * 64, b"ply\n" + b"comment " * 8, b"PK\3\4" + bytes(60), b"{" * 64)


def _images() -> list[Tensor]:
    """Two images of noise."""
    return [*torch.rand(2, 64, 64, 3, generator=torch.Generator().manual_seed(0))]


def is_ideal_for_the_truth(metric: Metric) -> None:
    """`measure` gives `ideal` or None for the truth, a worse value for noise, the same again, and keeps both images."""
    if metric.measure is None:
        return
    truth, noise = map(quantised, _images())
    try:
        metric.measure(truth, truth)
    except UsageError:  # it needs files that are not here
        return
    ideal, value, again = (metric.compare(image, truth) for image in (truth, noise, noise))
    require(value == again, f"gives {value}, then {again}")
    kept = all(a.equal(quantised(b)) for a, b in zip((truth, noise), _images(), strict=True))
    require(kept, "changes an image")
    close = ideal is None or math.isclose(ideal, metric.ideal, abs_tol=1e-4)
    require(close, f"the truth has {ideal} instead of {metric.ideal}")
    worse = value is None or ideal is None or metric.loss(value) > metric.loss(ideal)
    require(worse, f"noise has {value}, which is no worse than {ideal}")


def is_least_for_the_truth(loss: Callable[[Tensor, Tensor], Tensor]) -> None:
    """It is 0 for the truth itself, above 0 for noise, and keeps both images."""
    image, truth = _images()
    with torch.no_grad():
        least, more = float(loss(truth, truth)), float(loss(image, truth))
    require(abs(least) < 1e-6 < more < math.inf, f"is {least:g} for the truth itself, {more:g} for noise")
    kept = all(a.equal(b) for a, b in zip((image, truth), _images(), strict=True))
    require(kept, "changes an image")


def has_gradients_of_images(loss: Callable[[Tensor, Tensor], Tensor]) -> None:
    """Its gradient tells how fast it rises away from the truth, and is finite for the truth itself."""
    image, truth = _images()
    away = 0.01 * (image - truth)
    with torch.no_grad():
        rise = float(loss(image + away, truth) - loss(image - away, truth)) / 2
    leaves = [each.clone().requires_grad_() for each in (image, truth)]
    told, same = (torch.autograd.grad(loss(leaf, truth), leaf)[0] for leaf in leaves)
    along = float((told * away).sum())
    require(math.isclose(rise, along, rel_tol=0.05), f"rises by {rise:g} where its gradient says {along:g}")
    require(same.isfinite().all(), "the gradient is NaN or infinite for the truth itself")


def tells_scenes_apart(format: SceneFormat) -> None:
    """`sniff` never raises, and `open_scene` refuses an empty or foreign file with FormatError, if `sniff` takes it."""
    with tempfile.TemporaryDirectory() as folder:
        for head in HEADS:
            path = Path(folder) / f"scene.{format.name}"
            path.write_bytes(head)
            if not format.sniff(path, head):
                continue
            try:
                scene = format.open_scene(path, SceneFileOptions())
                require(len(scene.load(0, scene.count)) == scene.count, f"{head[:8]!r}: not as many rows as it says")
            except FormatError:
                pass


def reads_what_it_writes(format: SceneFormat) -> None:
    """It reads what it writes and keeps it, with as many Gaussians, at their places to 1 %, in any order."""
    if not isinstance(format, WritableFormat):
        return
    scene = make_scene(COUNT)
    before = copies_of(scene)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"scene.{format.name}"
        format.write(path, [scene[:12], scene[12:]], COUNT, False, SceneFileOptions())
        require_same(scene, before)
        read_as = getattr(format, "read_as", None)  # another format, which reads both
        reader = format if read_as is None else SCENE_FORMATS[read_as]
        require(reader.sniff(path, path.read_bytes()[:64]), "does not take its own file")
        opened = format.open_scene(path, SceneFileOptions())
        require(opened.count == COUNT, f"wrote {COUNT} Gaussians and reads {opened.count}")
        loaded = opened.load(0, COUNT)
        degrees = opened.sh_degree, loaded.sh_degree
        require(degrees[0] == degrees[1], f"says degree {degrees[0]} and reads {degrees[1]}")
        means = loaded.means.float()
        nearest = torch.cdist(means, scene.means).argmin(dim=1)
        require(len(nearest.unique()) == COUNT, "Gaussians are doubled or lost")
        torch.testing.assert_close(means, scene.means[nearest], rtol=0.01, atol=0.01)
        require(len(opened.load(5, 9)) == 4, "`load` does not return the rows from start up to stop")


def writes_the_same_files_again(format: SceneFormat) -> None:
    """The same scene gives the same names and bytes, and no other file is left beside them."""
    if not isinstance(format, WritableFormat):
        return
    scene, files = make_scene(COUNT), list[dict[str, bytes]]()
    for _ in range(2):
        with tempfile.TemporaryDirectory() as folder:
            format.write(Path(folder) / f"scene.{format.name}", [scene], COUNT, False, SceneFileOptions())
            files.append({path.name: path.read_bytes() for path in Path(folder).rglob("*") if path.is_file()})
    left = [name for name in files[0] if name.startswith(OUR_PREFIX)]
    require(not left, f"leaves {left}")
    require(files[0] == files[1], "writes other names or bytes the second time")


def tells_cameras_apart(format: CameraFormat) -> None:
    """`sniff` never raises: for a missing path, an empty folder, or a file of bytes."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cameras"
        format.sniff(path)
        format.sniff(Path(folder))
        for head in HEADS:
            path.write_bytes(head)
            format.sniff(path)
