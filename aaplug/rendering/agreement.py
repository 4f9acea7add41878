"""How well a scene and its cameras fit.

Cameras of another capture may see a scene too, and a scene may be turned over.  Photographs tell at once; without them,
cameras are expected to look at the scene's middle or, where each shows a part of it alone, at what lies near them.
"""

import math
from dataclasses import dataclass
from statistics import median

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.cameras import Camera, CameraSet, spread
from aaplug.core.colours import BLACK, WHITE
from aaplug.core.rules import NEAR
from aaplug.io.cameras import inria, read_cameras
from aaplug.io.cameras.sets import described_sizes
from aaplug.io.photographs import photo_of
from aaplug.io.scenes.columns import usable
from aaplug.io.scenes.scene import Scene
from aaplug.rendering.renderer import Renderer, background_colour, own_look
from aaplug.system.errors import AaplugError, counted
from aaplug.system.monitor import SILENT, Monitor

SAMPLE = 50_000  # Gaussians whose places are looked at
VIEWS = 20  # cameras that look at them
PHOTOGRAPHS = 3  # that are compared
SIDE = 100  # px: longer side of the images that are compared
FLAT = (0.5 / 255) ** 2  # variance of an image up to which it is one colour, rounded to 8 bits
LARGEST = 3_000_000  # Gaussians: a larger scene is not rendered for this
NEAR_SHARE = 0.02  # of the Gaussians ahead, which lie near a camera
HALF_A_SIDE = 0.5  # distance from the image's centre beyond which the scene's middle is outside of it
MAX_SIZE_ERROR = 0.02  # relative difference of two training sizes that rounding explains
MIN_SHARE_LEAD = 0.1  # of Gaussians seen, by which a reading fits better


@dataclass(frozen=True)
class Agreement:
    """How well a scene and its cameras fit.

    seen: share of the Gaussians that any camera sees.
    size: median standard deviation along a Gaussian's middle axis at its highest training rate, in px; None if unseen.
    offset: distance of the scene's middle, or of the middle of what lies near, from the image's centre in the median
        view, as a share of the side; infinite where no Gaussian lies ahead.
    gain: how much closer renders come to the photographs than one flat colour does, in dB; None without photographs.
    """

    seen: float
    size: float | None
    offset: float
    gain: float | None

    @property
    def doubt(self) -> str | None:
        """Why the cameras seem to be of another capture, in words; None if they do not."""
        if self.gain is not None:
            if self.gain > 0:
                return None
            return f"renders are {-self.gain:.1f} dB farther from the photographs than one flat colour is"
        if math.isinf(self.offset):
            return f"in half of the views no Gaussian lies farther ahead than {NEAR:g} units; nearer ones are not drawn"
        if self.offset > HALF_A_SIDE:
            return "in half of the views the middle of the scene lies outside of the image"
        return None

    def __str__(self) -> str:
        size = "" if self.size is None else f", their median size is {self.size:.2g} px"
        gain = ""
        if self.gain is not None:
            closer = "closer to" if self.gain > 0 else "farther from"
            gain = f", renders are {abs(self.gain):.1f} dB {closer} photographs than a flat colour"
        return f"the cameras see {self.seen:.0%} of the Gaussians{size}{gain}"


def agreement(look: Renderer, cameras: CameraSet) -> Agreement:
    """How well a scene, drawn as training did, fits its cameras."""
    scene, bounds = look.scene, look.training.bounds
    seen = bounds.seen
    middle = scene.scales.median(dim=1).values
    size = float((middle * bounds.highest)[seen].median()) if seen.any() else None
    sample = scene.means[:: max(1, len(scene) // SAMPLE)]
    offsets = [_offset(sample, camera) for camera in spread(look.training.cameras, VIEWS)]
    return Agreement(float(seen.float().mean()), size, median(offsets), _gain(look, cameras))


def _offset(means: Float[Tensor, "n 3"], camera: Camera) -> float:
    """`Agreement.offset` in one view: of the middle of all that lies ahead, or of the nearer part, as is smaller."""
    places, depths = camera.project(means)
    ahead = depths > NEAR
    if not ahead.any():
        return math.inf
    places = places[ahead] / places.new_tensor([camera.width, camera.height])
    distances = (means[ahead].double() - camera.centre).norm(dim=1)
    near = places[distances <= distances.quantile(NEAR_SHARE)]
    return min(float((part.median(dim=0).values - 0.5).abs().max()) for part in (places, near))


def settled(scene: Scene, cameras: CameraSet, monitor: Monitor = SILENT) -> Scene:
    """The reading of a file that fits the cameras, where the file does not say which of two is meant.

    Each reading is decoded once, and what is odd in it is left to whoever uses it.  Assumed cameras decide nothing.
    """
    if scene.other is None or cameras.assumed:
        return scene
    readings = scene.decoded(), scene.other.decoded()
    looks = (own_look(usable(reading.raw(0, reading.count)), cameras) for reading in readings)
    first, second = fits = [agreement(look, cameras) for look in looks]
    if first.gain is not None and second.gain is not None:
        better = second.gain > first.gain
    else:
        better = second.seen > first.seen + MIN_SHARE_LEAD or (first.doubt is not None and second.doubt is None)
    reading = readings[better]
    how, _, _ = reading.notes[-1].partition(" (")
    monitor.say(f"{scene.title}: {how}, as fits the cameras: {fits[better]}")
    return reading


def contradictions(scene: Scene, cameras: CameraSet) -> list[str]:
    """What the settings in a scene's own model folder say of its training that cameras from elsewhere do not.

    Cameras are told apart by name.  A model whose files cannot be read says nothing.
    """
    path, files = scene.camera_path, {file.absolute() for file in cameras.files}
    if path is None or not inria.Model.sniff(path) or (path / inria.FILE).absolute() in files:
        return []
    try:
        own = read_cameras(path)
    except AaplugError:
        return []
    views, trained, found = {view.name: view for view in own.all}, {view.name for view in own.train}, list[str]()
    pairs = [(view, views[view.name]) for view in cameras.train if view.name in views]
    if any(abs(view.width / of_own.width - 1) > MAX_SIZE_ERROR for view, of_own in pairs):
        here, there = (described_sizes(each) for each in zip(*pairs, strict=True))
        found.append(f"trained at {there}, and these cameras say {here}; --images or --train-scale sets it")
    held_out = {view.name for view in cameras.test} - {view.name for view in cameras.train}
    if both := held_out & trained:
        found.append(f"trained on {len(both)} of the {counted(len(held_out), 'test view')} of these cameras")
    if own.background not in (None, background_colour("auto", cameras)):
        found.append(f"trained on {'white' if own.background == WHITE else 'black'}")
    return found


@torch.no_grad()
def _gain(look: Renderer, cameras: CameraSet) -> float | None:
    """PSNR of small renders over that of the photographs' mean colours, in dB, each on the background that fits.

    It is the median over a few photographs; those that cannot be read or have one colour alone do not count.
    """
    views = [view for view in cameras.all if view.photo is not None]
    if not views or not 0 < len(look.scene) <= LARGEST:
        return None
    gains = []
    for view in spread(views, PHOTOGRAPHS):
        small = view.scaled(min(1.0, SIDE / max(view.hw)))
        try:
            truth, (rgb, alpha) = photo_of(view, look.background)(small), look(small)
        except AaplugError:
            continue
        behind = (1 - alpha)[..., None] * truth.new_tensor([[[colour]] for colour in (BLACK, WHITE, look.background)])
        images = (rgb - behind[2] + behind).clamp(0, 1)
        error = (images - truth).square().mean(dim=(1, 2, 3)).min()
        flat = (truth - truth.mean(dim=(0, 1))).square().mean()
        if flat > FLAT:
            gains.append(float(10 * (flat / error.clamp(min=torch.finfo().tiny)).log10()))
    return median(gains) if gains else None
