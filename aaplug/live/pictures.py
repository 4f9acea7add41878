"""The pictures of one page, drawn step by step: quick ones while the camera moves, ever finer ones at rest.

Each step is one `next` of a generator, some 30 ms long; whoever takes the steps may drop the rest of them for a newer
request.  A picture goes to the page as one binary message: the length of a header (4 bytes, little endian), the header
as JSON, and the files of its parts, one after another.
"""

import asyncio
import json
import logging
import math
import struct
import time
from collections import deque
from collections.abc import Generator
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.cameras import Camera
from aaplug.core.colours import Colour
from aaplug.core.imaging import quantised
from aaplug.evaluation.metrics import psnr
from aaplug.io.cameras.camera_path import EXACT
from aaplug.io.images import encoded, image_size
from aaplug.io.photographs import photo_of
from aaplug.live.messages import Order, PickRequest, PictureRequest, Side
from aaplug.live.overlays import OVERLAYS, depth_map
from aaplug.live.subject import Subject
from aaplug.methods import QUALITIES
from aaplug.rendering.renderer import Renderer
from aaplug.rendering.strips import strips
from aaplug.system.errors import AaplugError, UsageError, printable

PREVIEW_QUALITY, RESTING_QUALITY = 85, 95  # of JPEG
MAX_LOSSLESS_PIXELS = 400_000  # of a picture at rest that is sent as PNG, so that single pixels are true
FRAME_SECONDS = 0.040  # that a frame may take while the camera moves, in all
MIN_PREVIEW_SCALE = 0.25  # of a side's resolution while the camera moves
MIN_PREVIEW_GAUSSIANS = 40_000
UNIT_SAMPLES, UNIT_GAUSSIANS = 1 << 18, 400_000  # that an effort of 1 draws
EFFORT_RANGE = 1 / 16, 16.0
EFFORT_STEP_RANGE = 0.6, 1.4  # factors from frame to frame
MAX_SAMPLES = 1 << 24  # of one side: about a second
PROBE_GAUSSIANS = 20_000  # by which a moving picture's sampling rate is estimated
MAX_IN_FLIGHT = 2  # pictures that are sent and have not arrived, so that a slow line delays no newer one
MAX_WAITING_ORDERS = 4  # more are refused

Span = tuple[int, int]  # columns of the picture: the first, and one past the last
Steps = Generator[bytes | None, None, None]

log = logging.getLogger("aaplug")


class Part(NamedTuple):
    """A part of a picture: its subject ("0" and "1" are the sides), its columns, and its file."""

    of: str
    span: Span
    file: bytes


class Pictures:
    """Draws what one page wants to see."""

    def __init__(self, subject: Subject):
        self._subject = subject
        self._effort = 0.5
        self._previewed: PictureRequest | None = None
        self._complete: tuple[PictureRequest, list[Tensor], list[int]] | None = None  # both sides, whole; their samples

    @torch.no_grad()
    def steps(self, request: PictureRequest) -> Steps:
        """Draw what is wanted; yields pictures to send, and None between the strips of one."""
        started, camera = time.perf_counter(), self._subject.camera(request)
        pixels = replace(request, id=0, split=0.0, moving=False, overlay=None, photo=False)  # what decides both sides
        is_complete = self._complete is not None and self._complete[0] == pixels
        if not is_complete and self._previewed != pixels:
            yield self._preview(request, camera)
            self._previewed = pixels
        if request.moving:
            return
        if not is_complete:
            images, counts = yield from self._refined(request, camera, started)
            self._complete = pixels, images, counts
        assert self._complete is not None
        _, images, counts = self._complete
        exact = {name: getattr(camera, field) for name, field in EXACT.items()}
        facts: dict[str, Any] = {"camera": exact}
        parts: list[Part] = []
        if request.at is not None and request.photo and self._subject.views[request.at].photo is not None:
            yield None
            part, figures = self._photograph(request, images)
            parts.append(part)
            facts |= figures
        if request.overlay is not None:
            yield None
            levels, legend = OVERLAYS[request.overlay](self._subject.renderer(request.sides[1]), camera, counts[1])
            parts.append(Part("paint", (0, camera.width), encoded(".png", levels[..., None], 1)))
            facts |= {"legend": legend}
        yield _picture(request, parts, started, stage="done", samples=counts, **facts)

    @torch.no_grad()
    def ordered(self, request: PictureRequest, order: Order) -> Steps:
        """Serve an order: a picture as a file of its own, or the depth of what a place shows, null for nothing."""
        camera = self._subject.camera(request)
        if isinstance(order, PickRequest):
            left, top = int(order.x * camera.width), int(order.y * camera.height)
            around = replace(camera, width=3, height=3, cx=camera.cx - left + 1, cy=camera.cy - top + 1)
            depth = float(depth_map(self._subject.renderer(request.sides[0]), around)[1, 1])
            yield message({"picked": [order.x, order.y], "depth": depth if math.isfinite(depth) else None}, [])
            return
        camera = camera.framed(order.width, order.height)  # the shorter side keeps its field of view
        renderer = self._subject.renderer(request.sides[order.side], request.background)
        render = yield from strips(renderer, camera, _bounded_samples(renderer, camera))
        name = f"{request.sides[order.side].recipe}-{order.width}x{order.height}.png"
        yield message({"still": name}, [encoded(".png", render.rgb, 1)])

    def _preview(self, request: PictureRequest, camera: Camera) -> bytes:
        """Both visible parts, in the time of a frame: coarser, with fewer Gaussians, or as they are if they fit."""
        started, scale, gaussians = time.perf_counter(), 1.0, 0
        max_samples = self._effort * UNIT_SAMPLES
        max_gaussians = max(MIN_PREVIEW_GAUSSIANS, round(self._effort * UNIT_GAUSSIANS))
        probes = [self._subject.preview_renderer(side, None, PROBE_GAUSSIANS) for side in request.sides]
        counts = [_bounded_samples(probe, camera) for probe in probes]
        spans = [(i, span) for i, span in enumerate(_spans(request)) if span[0] < span[1]]
        too_many = sum((b - a) * camera.height * counts[i] ** 2 for i, (a, b) in spans) > max_samples
        if too_many:
            counts = [1, 1]
            scale = min(1.0, max(MIN_PREVIEW_SCALE, (max_samples / (camera.width * camera.height)) ** 0.5))
        parts = []
        for i, (left, right) in spans:
            renderer = self._subject.preview_renderer(request.sides[i], request.background, max_gaussians)
            recipe = replace(renderer.recipe, target_rate=0.0, grid=counts[i], neighbours=0.0)
            view = replace(camera, width=right - left, cx=camera.cx - left)
            view = view.resized(max(1, round(view.width * scale)), max(1, round(view.height * scale)))
            rgb = replace(renderer, recipe=recipe)(view).rgb
            parts.append(Part(str(i), (left, right), encoded(".jpg", rgb, PREVIEW_QUALITY)))
            gaussians = max(gaussians, len(renderer.scene))
        is_limited = too_many or max_gaussians < len(self._subject.look.scene)
        self._effort = _adapted(self._effort, time.perf_counter() - started, is_limited)
        facts = {"stage": "moving", "samples": counts, "scale": scale, "gaussians": gaussians}
        return _picture(request, parts, started, **facts)

    def _refined(
        self, request: PictureRequest, camera: Camera, started: float
    ) -> Generator[bytes | None, None, tuple[list[Tensor], list[int]]]:
        """Draw the visible parts in rising quality, then the hidden ones; returns both sides, and their samples."""
        spans = _spans(request)
        ladders = [self._ladder(side, request.background, camera) for side in request.sides]
        images, counts = [torch.empty(*camera.hw, 3) for _ in ladders], [0, 0]
        height = max(map(len, ladders))
        rungs = [[(i, spans[i], *x[step]) for i, x in enumerate(ladders) if step < len(x)] for step in range(height)]
        rungs.append([(i, spans[1 - i], *x[-1]) for i, x in enumerate(ladders)])
        for step, rung in enumerate(rungs):
            parts = []
            for i, span, renderer, samples in rung:
                counts[i] = samples
                if span[0] < span[1]:
                    render = yield from strips(renderer, camera, samples, span)
                    images[i][:, slice(*span)] = render.rgb
                    parts.append(_part_at_rest(str(i), span, render.rgb))
            if parts:
                stage = "refining" if step + 1 < height else "complete"
                yield _picture(request, parts, started, stage=stage, samples=counts)
        return images, counts

    def _ladder(self, side: Side, background: Colour | None, camera: Camera) -> list[tuple[Renderer, int]]:
        """Renderers in rising quality up to the chosen one, each with more samples than the one before."""
        names = list(QUALITIES)
        ladder: list[tuple[Renderer, int]] = []
        for quality in names[: names.index(side.quality) + 1]:
            renderer = self._subject.renderer(replace(side, quality=quality), background)
            samples = _bounded_samples(renderer, camera)
            if ladder and samples <= ladder[-1][1] and renderer.cutter is None:
                ladder.pop()
            ladder.append((renderer, samples))
            if samples < renderer.samples(camera) or not renderer.recipe.takes_quality:
                break
        return ladder

    def _photograph(self, request: PictureRequest, images: list[Tensor]) -> tuple[Part, dict[str, Any]]:
        """The photograph at the picture's size; PSNR of both sides against what of it is seen, None above its size."""
        assert request.at is not None
        view, (placed, left, top) = self._subject.views[request.at], self._subject.placed_view(request)
        assert view.photo is not None
        photo = photo_of(view, request.background or self._subject.look.background)(placed).clamp(0, 1)
        rows = max(0, top), min(request.height, top + placed.height)
        columns = max(0, left), min(request.width, left + placed.width)
        photo = photo[rows[0] - top : rows[1] - top, columns[0] - left : columns[1] - left]
        values = [psnr(quantised(image[slice(*rows), slice(*columns)]), photo) for image in images]
        values = None if placed.width > image_size(view.photo)[0] else values
        whole = placed.hw == (rows[1] - rows[0], columns[1] - columns[0])
        return _part_at_rest("photo", columns, photo), {"psnr": values, "rows": rows, "whole": whole}


@dataclass(eq=False)
class Page:
    """A page that shows a subject; one thread takes its steps, another receives its messages.

    newer: True if no step for the request is taken yet.  changed: set when it wants something else.
    sent, received: counts of pictures.
    """

    subject: Subject
    request: PictureRequest | None = None
    newer: bool = False
    steps: Steps | None = None
    orders: deque[Order] = field(default_factory=deque)
    changed: asyncio.Event = field(default_factory=asyncio.Event)
    sent: int = 0
    received: int = 0

    def __post_init__(self) -> None:
        self.pictures = Pictures(self.subject)

    def receive(self, said: PictureRequest | Order | None) -> None:
        """Take a message of the page, as `parse` gives it; raises UsageError if it wants more than it may."""
        match said:
            case PictureRequest():
                self.request, self.newer = said, True
            case None:
                self.received = min(self.sent, self.received + 1)
            case _ if self.request is None or len(self.orders) >= MAX_WAITING_ORDERS:
                raise UsageError("still", "wait until the ones before are done")
            case _:
                self.orders.append(said)
        self.changed.set()

    @property
    def busy(self) -> bool:
        """True if there is a step to take now."""
        return self.sent - self.received < MAX_IN_FLIGHT and bool(self.newer or self.steps or self.orders)

    def step(self) -> bytes | None:
        """Take one step, and return what it has to send; a newer request replaces what is being drawn."""
        assert self.request is not None
        try:
            if self.newer:
                self.newer = False  # before the request is read: the next one may come at any time
                self.steps = self.pictures.steps(self.request)
            elif self.steps is None:
                self.steps = self.pictures.ordered(self.request, self.orders.popleft())
            return next(self.steps)
        except StopIteration:
            self.steps = None
            return None
        except Exception as error:  # one picture fails, the page goes on
            self.steps = None
            if not isinstance(error, AaplugError | MemoryError):
                log.warning("a picture failed: %r", error)
            return message({"problem": printable(str(error) or "out of memory")}, [])


def message(header: dict[str, Any], files: list[bytes]) -> bytes:
    """A header and files as one binary message."""
    text = json.dumps(header, allow_nan=False).encode()
    return b"".join([struct.pack("<I", len(text)), text, *files])


def _picture(request: PictureRequest, parts: list[Part], started: float, **facts: Any) -> bytes:
    """A picture, or some parts of it, as a message; started: when its drawing began."""
    header: dict[str, Any] = {"id": request.id, "size": [request.width, request.height]} | facts
    header["ms"] = 1000 * (time.perf_counter() - started)
    header["parts"] = [{"of": part.of, "span": part.span, "bytes": len(part.file)} for part in parts]
    return message(header, [part.file for part in parts])


def _part_at_rest(of: str, span: Span, rgb: Float[Tensor, "h w 3"]) -> Part:
    lossless = rgb.shape[0] * rgb.shape[1] <= MAX_LOSSLESS_PIXELS
    return Part(of, span, encoded(".png", rgb, 1) if lossless else encoded(".jpg", rgb, RESTING_QUALITY))


def _spans(request: PictureRequest) -> tuple[Span, Span]:
    """The columns of each side that can be seen; those of the other side are hidden."""
    cut = round(request.split * request.width)
    return (0, cut), (cut, request.width)


def _adapted(effort: float, seconds: float, is_limited: bool) -> float:
    """The effort for the next frame; it grows only where it was what limited this one."""
    smallest, largest = EFFORT_STEP_RANGE
    step = min(max(FRAME_SECONDS / seconds, smallest), largest if is_limited else 1.0)
    return min(max(effort * step, EFFORT_RANGE[0]), EFFORT_RANGE[1])


def _bounded_samples(renderer: Renderer, camera: Camera) -> int:
    """Samples along a pixel's side, no more than can be waited for."""
    most = max(1, int((MAX_SAMPLES / (camera.width * camera.height)) ** 0.5))
    return min(renderer.samples(camera), most)
