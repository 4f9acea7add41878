"""Cameras of glTF 2.0, .gltf and .glb: the first that an animation moves, or else the first.

A perspective camera looks along -z with y up (OpenGL), at the place of its node, in the file's world; yfov is the
vertical angle in rad.  Of an animation, translations and rotations of the camera's node and those above it are read.
Scales do not matter to a camera.  Buffers are read from the file itself, or from files in its folder, never beyond.
The frame rate is that of the densest even keys, else 30 a second.  Focal lengths that KHR_animation_pointer moves stay.
"""

import base64
import binascii
import struct
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.io.cameras import keyframes
from aaplug.io.cameras.camera_path import CameraPath
from aaplug.io.cameras.keyframes import FPS, UNSIZED, cameras_of, frame_times, hermite, rigid_motions, segments, slerp
from aaplug.io.cameras.poses import OPENCV_FROM_OPENGL, pose
from aaplug.io.limits import whole_limit
from aaplug.io.values import Entry, Place, entries, number, object_of, parse_json, read_bounded, text
from aaplug.system.errors import FormatError

MAGIC, JSON_CHUNK, BINARY_CHUNK = b"glTF", 0x4E4F534A, 0x004E4942
HEADER, CHUNK = struct.Struct("<4sII"), struct.Struct("<II")
FLOAT = 5126  # componentType
WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
PATHS = {"translation": "VEC3", "rotation": "VEC4"}  # that move a camera
MAX_RATE = 240.0  # frames per second
EVEN = 1e-3  # of the spacing between keys, which counts as rounding

name = "gltf"


def sniff(path: Path) -> bool:
    """True for a file of that name."""
    return path.suffix.lower() in (".glb", ".gltf")


def path_of(path: Path) -> CameraPath:
    """The camera at each frame of its animation, or at rest as a path of one frame."""
    file = _File(path)
    nodes = file.items("nodes")
    holders = [index for index, node in enumerate(nodes) if "camera" in node]
    if not holders:
        raise FormatError(path, "holds no camera that a node places")
    channels = _channels(file)
    chains = {index: _chain(file, nodes, index) for index in holders}
    moved = [index for index in holders if any(node in channels for node in chains[index])]
    chosen = (moved or holders)[0]
    moving = [channel for node in chains[chosen] for channel in channels.get(node, {}).values()]
    place, fps = nodes[chosen].place, max((_rate(times) for times, _, _ in moving), default=0.0) or FPS
    first, last = (pick((float(t[end]) for t, _, _ in moving), default=0.0) for pick, end in ((min, 0), (max, -1)))
    at = frame_times(first, last, fps, place)
    motions = torch.eye(4, dtype=torch.float64).expand(len(at), 4, 4)
    for node in chains[chosen]:
        motions = _local(nodes[node], channels.get(node, {}), at) @ motions
    axes = motions[:, :3, :3] / motions[:, :3, :3].norm(dim=1, keepdim=True)
    rows = zip(axes * OPENCV_FROM_OPENGL, motions[:, :3, 3], strict=True)
    poses = torch.stack([pose(turn, where, place, "its transform") for turn, where in rows])
    tangent, aspect = _lens(file, nodes[chosen])
    size = UNSIZED if aspect is None else (max(1, round(UNSIZED[1] * aspect)), UNSIZED[1])
    cameras = cameras_of(poses, torch.full((len(at),), tangent), lambda size: size[1], place, size)
    return CameraPath(cameras, fps, unsized=aspect is None)


class _File:
    """The document and its buffers."""

    def __init__(self, path: Path) -> None:
        data, self.binary = read_bounded(path, whole_limit("JSON")), b""
        self.path = path
        if data.startswith(MAGIC):
            data, self.binary = _chunks(data, path)
        self.root = object_of(parse_json(data, path), path, "it", "'asset', as glTF has", "asset")
        version = self.root.entry("asset").get("version", text)
        self.root.place.expect(version.startswith("2."), "asset.version", "2", version)

    def items(self, key: str) -> list[Entry]:
        """The objects of a list of the document."""
        return entries(self.path, key, self.root.value(key)) if key in self.root else []

    def item(self, key: str, owner: Entry, field: str) -> Entry:
        """The object that a field points to."""
        items = self.items(key)
        return items[natural(owner.value(field), owner.place, field, len(items) - 1)]

    def numbers(self, owner: Entry, field: str, kind: str) -> Float[Tensor, "n c"]:
        """The floats of the accessor that a field names."""
        accessor, width = self.item("accessors", owner, field), WIDTHS[kind]
        found = [accessor.fields.get("type"), accessor.fields.get("componentType"), "sparse" in accessor]
        accessor.place.expect(found == [kind, FLOAT, False], "it", f"dense floats of type {kind}", accessor.fields)
        view = self.item("bufferViews", accessor, "bufferView")
        data = self._buffer(self.item("buffers", view, "buffer"))
        start, inner, length, count = (
            natural(entry.fields.get(key, 0), entry.place, key, len(data))
            for entry, key in (
                (view, "byteOffset"),
                (accessor, "byteOffset"),
                (view, "byteLength"),
                (accessor, "count"),
            )
        )
        fits = count > 0 and inner + 4 * width * count <= length <= len(data) - start
        accessor.place.expect(fits, "it", f"values inside its buffer of {len(data)} bytes", accessor.fields)
        values = np.frombuffer(data, "<f4", count * width, start + inner).reshape(count, width)
        accessor.place.expect(bool(np.isfinite(values).all()), "it", "finite", "NaN or infinity")
        return torch.from_numpy(values.astype(np.float64))

    def _buffer(self, buffer: Entry) -> bytes:
        if "uri" not in buffer:
            return self.binary
        address = buffer.get("uri", text)
        if address.startswith("data:"):
            try:
                return base64.b64decode(address.partition(",")[2], validate=True)
            except binascii.Error as error:
                raise buffer.place.wrong("uri", "Base64", address[:40]) from error
        try:
            file, home = (self.path.parent / address).resolve(), self.path.parent.resolve()
        except (OSError, RuntimeError, ValueError) as error:
            raise buffer.place.wrong("uri", "a file's name", address) from error
        buffer.place.expect(file.is_relative_to(home), "uri", "a file in the same folder", address)
        return read_bounded(file, whole_limit("JSON"))


def natural(value: object, place: Place, field: str, most: int) -> int:
    """`value` as a whole number from 0 to `most`."""
    real = number(value, place, field)
    place.expect(0 <= real <= most and real.is_integer(), field, f"a whole number from 0 to {most}", value)
    return int(real)


def _chunks(data: bytes, path: Path) -> tuple[bytes, bytes]:
    """The JSON and the binary chunk of a .glb."""
    found: dict[int, bytes] = {}
    at = HEADER.size
    while at + CHUNK.size <= len(data):
        length, kind = CHUNK.unpack_from(data, at)
        at += CHUNK.size
        if length > len(data) - at:
            raise FormatError(path, f"a chunk of {length} bytes expected, {len(data) - at} left; the file is cut short")
        found.setdefault(kind, data[at : at + length])
        at += length
    if JSON_CHUNK not in found:
        raise FormatError(path, "should hold a JSON chunk, as .glb files do")
    return found[JSON_CHUNK], found.get(BINARY_CHUNK, b"")


Channel = tuple[Tensor, Tensor, str]  # times in s, values, interpolation


def _channels(file: _File) -> dict[int, dict[str, Channel]]:
    """What the animations move, by node and path; the first wins."""
    found: dict[int, dict[str, Channel]] = {}
    nodes = len(file.items("nodes"))
    for animation in file.items("animations"):
        samplers = [
            Entry(animation.place, e.fields) for e in entries(file.path, "sampler", animation.value("samplers"))
        ]
        for channel in entries(file.path, "channel", animation.value("channels")):
            target = channel.entry("target")
            kind = target.fields.get("path")
            if not isinstance(kind, str) or kind not in PATHS or "node" not in target:
                continue
            node = natural(target.value("node"), target.place, "node", nodes - 1)
            sampler = samplers[natural(channel.value("sampler"), channel.place, "sampler", len(samplers) - 1)]
            times = file.numbers(sampler, "input", "SCALAR")[:, 0]
            keyframes.rising(times, sampler.place, "times")
            values, way = file.numbers(sampler, "output", PATHS[kind]), sampler.get("interpolation", text, "LINEAR")
            sampler.place.expect(way in ("LINEAR", "STEP", "CUBICSPLINE"), "interpolation", "glTF's", way)
            rows = len(times) * (3 if way == "CUBICSPLINE" else 1)
            sampler.place.expect(len(values) == rows, "output", f"{rows} values", len(values))
            found.setdefault(node, {}).setdefault(kind, (times, values, way))
    return found


def _chain(file: _File, nodes: list[Entry], index: int) -> list[int]:
    """A node and those above it."""
    parents = {}
    for above, node in enumerate(nodes):
        children = node.fields.get("children", [])
        node.place.expect(isinstance(children, list), "children", "a list of nodes", children)
        for child in children:
            parents[natural(child, node.place, "children", len(nodes) - 1)] = above
    chain = [index]
    while chain[-1] in parents:
        chain.append(parents[chain[-1]])
        if len(chain) > len(nodes):
            raise FormatError(file.path, "its nodes lie in a circle")
    return chain


def _local(node: Entry, channels: dict[str, Channel], at: Float[Tensor, " f"]) -> Float[Tensor, "f 4 4"]:
    """A node's own motion at these times."""
    if "matrix" in node and not channels:
        return node.vector("matrix", 16).view(4, 4).T.expand(len(at), 4, 4)
    places = node.vector("translation", 3) if "translation" in node else torch.zeros(3, dtype=torch.float64)
    quats = (
        node.vector("rotation", 4) if "rotation" in node else torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64)
    )
    places, quats = places.expand(len(at), 3), quats.expand(len(at), 4)
    if "translation" in channels:
        places = _sampled(channels["translation"], at, node.place, False)
    if "rotation" in channels:
        quats = _sampled(channels["rotation"], at, node.place, True)
    motions = rigid_motions(keyframes.unit(quats, node.place, "rotation").roll(1, dims=1), places)
    if "scale" in node:
        motions = motions.clone()
        motions[:, :3, :3] *= node.vector("scale", 3)
    return motions


def _sampled(channel: Channel, at: Float[Tensor, " f"], place: Place, turns: bool) -> Float[Tensor, "f c"]:
    """The values of a channel; quaternions xyzw if it turns."""
    times, values, way = channel
    index, share = segments(times, at)
    after = (index + 1).clamp(max=len(times) - 1)
    if way == "CUBICSPLINE":
        into, values, out = values.view(len(times), 3, -1).unbind(dim=1)
        width = (times[after] - times[index])[:, None]
        return hermite(values[index], out[index] * width, into[after] * width, values[after], share)
    if way == "STEP":
        return values[torch.where(share < 1 - EVEN, index, after)]  # times are float32
    if turns:
        values = keyframes.unit(values, place, "rotation")
        return slerp(values[index], values[after], share)
    return values[index].lerp(values[after], share[:, None])


def _rate(times: Float[Tensor, " n"]) -> float:
    """Keys per second, where there are several and even ones; else 0."""
    steps = times.diff()
    if len(steps) < 2 or float((steps - steps.mean()).abs().max()) > EVEN * float(steps.mean()):
        return 0.0
    return min(MAX_RATE, round(1 / float(steps.mean()), 3))


def _lens(file: _File, node: Entry) -> tuple[float, float | None]:
    """Tangent of half the vertical angle, and width over height if the file says."""
    camera = file.item("cameras", node, "camera")
    kind: Any = camera.fields.get("type")
    camera.place.expect(kind == "perspective", "type", "perspective", kind)
    lens = camera.entry("perspective")
    angle = lens.get("yfov", number)
    lens.place.expect(0 < angle < np.pi, "yfov", "above 0 and below π, in radians", angle)
    aspect = lens.get("aspectRatio", number) if "aspectRatio" in lens else None
    lens.place.expect(aspect is None or 1 / 64 <= aspect <= 64, "aspectRatio", "from 1/64 to 64", aspect)
    return float(np.tan(angle / 2)), aspect
