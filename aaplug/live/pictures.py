"""The pictures of one page, drawn step by step: quick ones while the camera moves, ever finer ones at rest.

Each step is one `next` of a generator, some 30 ms long; whoever takes the steps may drop the rest of them for a newer
wish.  A picture goes to the page as one binary message: the length of a header (4 bytes, little endian), the header as
JSON, and the files of its parts, one after another.
"""

import json
import struct
import time
from collections.abc import Generator, Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.cameras import Camera
from aaplug.core.choices import QUALITIES
from aaplug.core.imaging import quantised, resampled
from aaplug.evaluation.metrics import psnr
from aaplug.io.images import encode_jpeg, encode_png
from aaplug.io.photographs import read_photo
from aaplug.live.messages import See, Side, Still
from aaplug.live.paints import PAINTS
from aaplug.live.subject import Subject
from aaplug.rendering.renderer import Renderer
from aaplug.rendering.strips import strips

MOVING_QUALITY, RESTING_QUALITY = 85, 95  # of JPEG
LOSSLESS = 400_000  # px up to which a picture at rest is sent as PNG, so that single pixels are true
FRAME = 0.040  # seconds that a frame may take while the camera moves, in all
LEAST_SCALE = 0.25  # of a side's resolution while the camera moves
UNIT = 1 << 18, 400_000  # samples, and Gaussians, that an effort of 1 draws
LEAST_GAUSSIANS = 40_000
EFFORTS = 1 / 16, 16.0
STEP = 0.6, 1.4  # by which the effort changes from frame to frame, at most
MOST_SAMPLES = 1 << 24  # of one side: about a second
PROBED = 20_000  # Gaussians by which a moving picture's sampling rate is estimated

Span = tuple[int, int]  # columns of the picture: the first, and one past the last
Steps = Generator[bytes | None, None, None]


class Part(NamedTuple):
    """A part of a picture: what it is of ("0" and "1" are the sides), its columns, and its file."""

    of: str
    span: Span
    file: bytes


@dataclass(frozen=True)
class _Wish:
    """What decides the pixels of both sides: a `See` without the words around it."""

    see: See

    @classmethod
    def of(cls, see: See) -> "_Wish":
        return cls(replace(see, id=0, split=0.0, moving=False, paint=None, photo=False))


class Pictures:
    """Draws what one page wants to see."""

    def __init__(self, subject: Subject):
        self._subject = subject
        self._effort = 0.5
        self._previewed: _Wish | None = None
        self._images: tuple[_Wish, list[Tensor], list[int]] | None = None  # both sides, whole

    @torch.no_grad()
    def steps(self, see: See) -> Steps:
        """Draw a wish; yields pictures to send, and None between the strips of one."""
        wish, started = _Wish.of(see), time.perf_counter()
        camera = self._subject.camera(see)
        if self._images is None or self._images[0] != wish:
            if self._previewed != wish:
                yield self._preview(see, camera)
                self._previewed = wish
            if see.moving:
                return
            yield from self._refined(see, camera, started)
        elif see.moving:
            return
        yield from self._extras(see, camera, started)

    @torch.no_grad()
    def still(self, see: See, still: Still) -> Steps:
        """The picture as a file of its own, of any size: the shorter side keeps its field of view."""
        camera = self._subject.camera(see).framed(still.width, still.height)
        renderer = self._subject.renderer(see.sides[still.side])
        samples, _ = _bounded(renderer.samples(camera), camera)
        drawn = yield from strips(renderer, camera, samples)
        name = f"{see.sides[still.side].recipe}-{still.width}x{still.height}.png"
        yield message({"still": name}, [encode_png(drawn.rgb)])

    # ------------------------------------------------------------------------------------------------------ moving

    def _preview(self, see: See, camera: Camera) -> bytes:
        """Both visible parts, in the time of a frame: coarser, with fewer Gaussians, or as they are if they fit."""
        started = time.perf_counter()
        room, gaussians = (self._effort * unit for unit in UNIT)
        gaussians = max(LEAST_GAUSSIANS, round(gaussians))
        spans = _visible(see, camera.width)
        renderers = [self._subject.boldest(side, gaussians) for side in see.sides]
        samples = [self._probed(side, camera) for side in see.sides]
        wanted = sum((b - a) * camera.height * samples[i] ** 2 for i, (a, b) in spans.items())
        scale = 1.0
        if wanted > room:
            samples = [1, 1]
            scale = min(1.0, max(LEAST_SCALE, (room / (camera.width * camera.height)) ** 0.5))
        parts = []
        for i, span in spans.items():
            part = _part(camera, span, scale)
            recipe = replace(renderers[i].recipe, target_rate=0.0, grid=samples[i], neighbours=0.0)
            drawn = replace(renderers[i], recipe=recipe)(part)
            parts.append(Part(str(i), span, encode_jpeg(drawn.rgb, MOVING_QUALITY)))
        seconds = time.perf_counter() - started
        limited = wanted > room or gaussians < len(self._subject.look.scene)
        self._effort = _adapted(self._effort, seconds, limited)
        about = {"stage": "moving", "ms": 1000 * seconds, "samples": samples, "scale": scale}
        drawn_of = max((len(renderers[i].scene) for i in spans), default=0)
        return picture(see, camera, parts, about | {"gaussians": drawn_of})

    def _probed(self, side: Side, camera: Camera) -> int:
        """Samples along a pixel's side as a few Gaussians tell."""
        return _bounded(self._subject.boldest(side, PROBED).samples(camera), camera)[0]

    # ------------------------------------------------------------------------------------------------------ at rest

    def _refined(self, see: See, camera: Camera, started: float) -> Steps:
        """The visible parts in rising quality, then the hidden ones."""
        ladders = [self._ladder(side, camera) for side in see.sides]
        visible, images = _visible(see, camera.width), [torch.empty(*camera.hw, 3) for _ in see.sides]
        last = [ladder[-1][1] for ladder in ladders]
        for step in range(max(map(len, ladders))):
            parts = []
            for i, span in visible.items():
                if step < len(ladders[i]):
                    yield from self._drawn(images[i], camera, span, *ladders[i][step])
                    parts.append(_resting(str(i), span, images[i]))
            if parts:
                counts = [ladder[min(step, len(ladder) - 1)][1] for ladder in ladders]
                done = step + 1 == max(map(len, ladders))
                yield picture(see, camera, parts, _about(counts, "complete" if done else "refining", started))
        parts = []
        for i, ladder in enumerate(ladders):
            for span in _others(visible.get(i), camera.width):
                yield from self._drawn(images[i], camera, span, *ladder[-1])
                parts.append(_resting(str(i), span, images[i]))
        if parts:
            yield picture(see, camera, parts, _about(last, "complete", started))
        self._images = _Wish.of(see), images, last

    def _ladder(self, side: Side, camera: Camera) -> list[tuple[Renderer, int]]:
        """Renderers in rising quality up to the chosen one, each with more samples than the one before."""
        names = list(QUALITIES)
        found: list[tuple[Renderer, int]] = []
        for quality in names[: names.index(side.quality) + 1]:
            renderer = self._subject.renderer(replace(side, quality=quality))
            samples, cut = _bounded(renderer.samples(camera), camera)
            if not found or samples > found[-1][1] or renderer.cutter is not None:
                found.append((renderer, samples))
            else:
                found[-1] = renderer, samples
            if cut or not renderer.recipe.takes_quality:
                break
        return found

    def _drawn(
        self, image: Float[Tensor, "h w 3"], camera: Camera, span: Span, renderer: Renderer, samples: int
    ) -> Generator[None, None, None]:
        """Draw some columns of the image."""
        drawn = yield from strips(renderer, camera, samples, span)
        image[:, slice(*span)] = drawn.rgb

    # ------------------------------------------------------------------------------------------------------- extras

    def _extras(self, see: See, camera: Camera, started: float) -> Steps:
        """The photograph with figures, and what is painted over; at the end, word that all is done."""
        assert self._images is not None
        _, images, counts = self._images
        about: dict[str, Any] = {}
        parts: list[Part] = []
        if see.at is not None and see.photo and self._subject.views[see.at].photo is not None:
            yield None
            found, values = self._photographed(see, camera, images)
            about, parts = values, [found]
        if see.paint is not None:
            yield None
            samples = counts[1]
            levels, legend = PAINTS[see.paint](self._subject.renderer(see.sides[1]), camera, samples)
            parts.append(Part("paint", (0, camera.width), encode_png(levels[..., None])))
            about |= {"legend": legend}
        yield picture(see, camera, parts, _about(counts, "done", started) | about)

    def _photographed(self, see: See, camera: Camera, images: list[Tensor]) -> tuple[Part, dict[str, Any]]:
        """The photograph at the picture's size, and the PSNR of both sides against what is seen of it."""
        assert see.at is not None
        view = self._subject.views[see.at]
        assert view.photo is not None
        left, top, width, height = self._subject.frame(see)
        photo = read_photo(view.photo, self._subject.look.background, view.lens)
        photo = resampled(photo, see.focal / view.focal, (height, width)).clamp(0, 1)
        box = max(0, left), max(0, top), min(camera.width, left + width), min(camera.height, top + height)
        seen = photo[box[1] - top : box[3] - top, box[0] - left : box[2] - left]
        values = [psnr(quantised(image[box[1] : box[3], box[0] : box[2]]), seen) for image in images]
        part = Part("photo", (box[0], box[2]), _still_file(seen))
        whole = (width, height) == (box[2] - box[0], box[3] - box[1])
        return part, {"psnr": values, "rows": [box[1], box[3]], "whole": whole}


def picture(see: See, camera: Camera, parts: list[Part], about: dict[str, Any]) -> bytes:
    """A picture, or some parts of it, as a message."""
    header = {"id": see.id, "size": [camera.width, camera.height]} | about
    header["parts"] = [{"of": part.of, "span": part.span, "bytes": len(part.file)} for part in parts]
    return message(header, [part.file for part in parts])


def message(header: dict[str, Any], files: list[bytes]) -> bytes:
    """A header and files as one binary message."""
    text = json.dumps(header, allow_nan=False).encode()
    return b"".join([struct.pack("<I", len(text)), text, *files])


def _about(samples: list[int], stage: str, started: float) -> dict[str, Any]:
    return {"stage": stage, "ms": 1000 * (time.perf_counter() - started), "samples": samples}


def _resting(of: str, span: Span, image: Float[Tensor, "h w 3"]) -> Part:
    return Part(of, span, _still_file(image[:, slice(*span)]))


def _still_file(rgb: Float[Tensor, "h w 3"]) -> bytes:
    return encode_png(rgb) if rgb.shape[0] * rgb.shape[1] <= LOSSLESS else encode_jpeg(rgb, RESTING_QUALITY)


def _visible(see: See, width: int) -> dict[int, Span]:
    """The columns of each side that can be seen."""
    cut = round(see.split * width)
    return {i: span for i, span in enumerate([(0, cut), (cut, width)]) if span[0] < span[1]}


def _others(span: Span | None, width: int) -> Iterator[Span]:
    """The columns beside a span."""
    left, right = span or (0, 0)
    return iter([(a, b) for a, b in ((0, left), (right, width)) if a < b])


def _part(camera: Camera, span: Span, scale: float) -> Camera:
    """Some columns of a view, in fewer pixels."""
    left, right = span
    part = replace(camera, width=right - left, cx=camera.cx - left)
    return part.resized(max(1, round(part.width * scale)), max(1, round(part.height * scale)))


def _adapted(effort: float, seconds: float, limited: bool) -> float:
    """The effort for the next frame; it grows only where it was what limited this one."""
    low, high = STEP
    by = min(max(FRAME / seconds, low), high if limited else 1.0)
    return min(max(effort * by, EFFORTS[0]), EFFORTS[1])


def _bounded(samples: int, camera: Camera) -> tuple[int, bool]:
    """Samples along a pixel's side, no more than can be waited for, and whether they were more."""
    most = max(1, int((MOST_SAMPLES / (camera.width * camera.height)) ** 0.5))
    return min(samples, most), samples > most
