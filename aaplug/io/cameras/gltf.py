"""Cameras of glTF 2.0, .gltf and .glb: the first that an animation moves, or else the first.

A perspective camera looks along -z with y up (OpenGL), at the place of its node, in the file's world; yfov is the
vertical angle in rad.  Of an animation, the motions of the camera's node and those above it are read.  The frame rate
is that of the densest even keys, else 30 a second.  Focal lengths that KHR_animation_pointer moves stay.
"""

import math
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.io.cameras import keyframes
from aaplug.io.cameras.camera_path import CameraPath
from aaplug.io.cameras.keyframes import FPS, UNSIZED, cameras_of, frame_times, hermite, segments, slerp
from aaplug.io.cameras.poses import pose
from aaplug.io.gltf import PARTS, Gltf, local
from aaplug.io.values import Entry, Place, entries, natural, number, text, unit
from aaplug.system.errors import FormatError

MIN_RATE, MAX_RATE = 10.0, 240.0  # frames per second; sparser keys are no frames
EVEN = 1e-3  # of the spacing between keys, which counts as rounding


def sniff(path: Path) -> bool:
    """True for a file of that name."""
    return path.suffix.lower() in (".glb", ".gltf")


def path_of(path: Path, fps: float | None = None) -> CameraPath:
    """The camera at each frame of its animation, or at rest as a path of one frame.

    fps: frames per second; None for the rate of even keys, else 30.
    """
    file = Gltf(path)
    nodes = file.items("nodes")
    holders = [index for index, node in enumerate(nodes) if "camera" in node]
    if not holders:
        raise FormatError(path, "holds no camera that a node places")
    channels, moves = _channels(file), dict[int | None, bool]()
    for node, above in file.parents.items():
        moves[node] = node in channels or moves.get(above, False)
    chosen = next(filter(moves.get, holders), holders[0])
    chain = [chosen]
    while (above := file.parents[chain[-1]]) is not None:
        chain.append(above)
    moving = [channel for node in chain for channel in channels.get(node, {}).values()]
    place, fps = nodes[chosen].place, fps or max((_rate(times) for times, _, _ in moving), default=0.0) or FPS
    first, last = (pick((float(t[end]) for t, _, _ in moving), default=0.0) for pick, end in ((min, 0), (max, -1)))
    at = frame_times(first, last, fps, place)
    motions = torch.eye(4, dtype=torch.float64).expand(len(at), 4, 4)
    for node in chain:
        own, tracks = nodes[node], channels.get(node, {})
        moved = {part: _sampled(each, at, own.place, part == "rotation") for part, each in tracks.items()}
        motions = local(own, moved) @ motions
    motions[:, :3, :3] /= motions[:, :3, :3].norm(dim=1, keepdim=True)
    poses = torch.stack([pose(motion, place, "its transform", opengl=True) for motion in motions])
    camera = file.item("cameras", nodes[chosen], "camera")
    kind = camera.fields.get("type")
    camera.place.expect(kind == "perspective", "type", "perspective", kind)
    lens = camera.entry("perspective")
    angle = lens.get("yfov", number)
    lens.place.expect(0 < angle < math.pi, "yfov", "above 0 and below π, in radians", angle)
    aspect = lens.get("aspectRatio", number, UNSIZED[0] / UNSIZED[1])
    lens.place.expect(1 / 64 <= aspect <= 64, "aspectRatio", "from 1/64 to 64", aspect)
    size = max(1, round(UNSIZED[1] * aspect)), UNSIZED[1]
    focals = size[1] / 2 / torch.full((len(at),), angle / 2, dtype=torch.float64).tan()
    return CameraPath(cameras_of(poses, focals, place, size), fps, unsized=True)


Channel = tuple[Tensor, Tensor, str]  # times in s, values, interpolation


def _channels(file: Gltf) -> dict[int, dict[str, Channel]]:
    """The animated channels, by node and path; the first animation wins."""
    found: dict[int, dict[str, Channel]] = {}
    nodes = len(file.items("nodes"))
    for animation in file.items("animations"):
        listed = entries(file.path, "sampler", animation.value("samplers"))
        samplers = [Entry(animation.place, each.fields) for each in listed]
        for channel in entries(file.path, "channel", animation.value("channels")):
            target = channel.entry("target")
            kind = target.fields.get("path")
            if not isinstance(kind, str) or kind not in PARTS or "node" not in target:
                continue
            node = natural(target.value("node"), target.place, "node", nodes - 1)
            sampler = samplers[natural(channel.value("sampler"), channel.place, "sampler", len(samplers) - 1)]
            times = file.numbers(sampler, "input", "SCALAR")[:, 0]
            keyframes.rising(times, sampler.place)
            values = file.numbers(sampler, "output", f"VEC{PARTS[kind]}")
            way = sampler.get("interpolation", text, "LINEAR")
            sampler.place.expect(way in ("LINEAR", "STEP", "CUBICSPLINE"), "interpolation", "glTF's", way)
            rows = len(times) * (3 if way == "CUBICSPLINE" else 1)
            sampler.place.expect(len(values) == rows, "output", f"{rows} values", len(values))
            found.setdefault(node, {}).setdefault(kind, (times, values, way))
    return found


def _sampled(channel: Channel, at: Float[Tensor, " f"], place: Place, turns: bool) -> Float[Tensor, "f c"]:
    """The values of a channel; quaternions xyzw if it turns."""
    times, values, way = channel
    index, after, share = segments(times, at)
    if way == "CUBICSPLINE":
        into, values, out = values.view(len(times), 3, -1).unbind(dim=1)
        width = (times[after] - times[index])[:, None]
        return hermite(values[index], out[index] * width, into[after] * width, values[after], share)
    if way == "STEP":
        return values[torch.where(share < 1 - EVEN, index, after)]  # times are float32
    if turns:
        values = unit(values, place)
        return slerp(values[index], values[after], share)
    return values[index].lerp(values[after], share[:, None])


def _rate(times: Float[Tensor, " n"]) -> float:
    """Keys per second, where there are several and even ones, as dense as frames; else 0."""
    steps = times.diff()
    if len(steps) < 2 or float((steps - steps.mean()).abs().max()) > EVEN * float(steps.mean()):
        return 0.0
    rate = round(1 / float(steps.mean()), 3)
    return min(MAX_RATE, rate) if rate >= MIN_RATE else 0.0
