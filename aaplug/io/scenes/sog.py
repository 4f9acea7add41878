"""PlayCanvas' SOG, versions 1 and 2: meta.json and lossless WebP images, in a folder or in a .sog zip.

A Gaussian is a pixel of each image, row by row.  means: 16 bits per coordinate in two images, between mins and maxs of
sign(x)·ln(1 + |x|); quats: three bytes and the index of the largest component; scales and sh0 (colour, opacity):
indices into a codebook, in version 1 bytes between mins and maxs; shN: 16-bit indices into a palette of 64 entries per
row.  Images are read only if meta.json names plain files beside it.
"""

import io
import json
import re
import warnings
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from aaplug.core.conventions import CLASSIC, Convention
from aaplug.core.gaussians import MAX_LOG_SCALE, Gaussians
from aaplug.io.limits import whole_limit
from aaplug.io.scenes.options import SceneFileOptions
from aaplug.io.scenes.packed import byte_opacities, check_growth, floats, largest_last
from aaplug.io.scenes.scene import COMPENSATED, KERNEL_LOST, Scene, check_count, library_errors
from aaplug.io.values import Entry, number, object_of, parse_json, read_bounded
from aaplug.system.errors import FormatError

META = "meta.json"
FILE_NAME = re.compile(r"[\w\-][\w\-.]{0,99}", re.ASCII)
ZIP_SIGNATURE = b"PK\x03\x04"
PALETTE_ROW = 64  # entries
MAX_PALETTE_PIXELS = PALETTE_ROW * 15 * (1 << 10)  # 64 entries of 15 coefficients in each of 1024 rows
W_LARGEST = 252  # alpha of a quaternion whose w is largest; 253 to 255 stand for x, y, z
BYTES_PER_PIXEL = 4
SPARE_PIXELS = 1 << 16  # pixels allowed beyond twice the number of Gaussians

name = "sog"

Fetch = Callable[[str, int], bytes]


@dataclass(frozen=True, eq=False)
class Part:
    """An entry of meta.json, with its images as RGBA, a row per pixel, and the width of the first."""

    entry: Entry
    pixels: list[np.ndarray]
    width: int

    def between(self, channels: int, rows: slice) -> Float[Tensor, "n c"]:
        """Version 1: bytes as fractions from mins to maxs."""
        low, high = (self.entry.vector(key, channels).float() for key in ("mins", "maxs"))
        return torch.lerp(low, high, floats(self.pixels[0][rows, :channels]) / 255)

    def coded(self, pixels: np.ndarray) -> Float[Tensor, "*n 3"]:
        """Version 2: bytes as indices into the codebook."""
        return self.entry.vector("codebook", 256).float()[torch.from_numpy(pixels.astype(np.int64))]


def sniff(path: Path, head: bytes) -> bool:
    """True for a meta.json, and for a zip with the suffix .sog or .zip."""
    zipped = head.startswith(ZIP_SIGNATURE) and path.suffix.lower() in (".sog", ".zip")
    return zipped or (path.name == META and head.lstrip().startswith(b"{"))


def open_scene(path: Path, options: SceneFileOptions) -> Scene:
    """See `SceneFormat`."""
    with library_errors(path):
        if path.name == META:
            meta = parse_json(read_bounded(path, whole_limit("JSON")), path)
            return _scene(path, meta, partial(_from_folder, path))
        with zipfile.ZipFile(path) as archive:
            meta = parse_json(_from_zip(path, archive, META, whole_limit("JSON")), path)
            return _scene(path, meta, partial(_from_zip, path, archive))


def _from_folder(path: Path, file: str, most: int) -> bytes:
    image = path.parent / file
    if not image.resolve().is_relative_to(path.parent.resolve()):
        raise FormatError(path, f"names {file!r}, a link that leads out of its folder")
    return read_bounded(image, most)


def _from_zip(path: Path, archive: zipfile.ZipFile, file: str, most: int) -> bytes:
    inside = [i for i in archive.infolist() if i.filename.rpartition("/")[2] == file]
    if len(inside) != 1:
        raise FormatError(path, f"should hold {file} once, and holds it {len(inside)} times")
    check_growth(path, inside[0].file_size, inside[0].compress_size)
    if inside[0].file_size > most:
        raise FormatError(path, f"{file} has {inside[0].file_size:,} bytes, more than {most:,}")
    with archive.open(inside[0]) as stream:
        return stream.read(most + 1)


def _scene(path: Path, meta: Any, fetch: Fetch) -> Scene:
    root = object_of(meta, path, META, "means, scales, quats and sh0")
    version = root.fields.get("version", 1)
    root.place.expect(version in (1, 2) and (version == 2) == ("version" in meta), "version", "2, or left out", version)
    value = root.get("count", number) if version > 1 else root.entry("means").fields.get("shape", [0])
    value = value[0] if isinstance(value, list) and value else value
    if not isinstance(value, int | float) or value < 0 or value != int(value):
        raise root.place.wrong("count", "a whole number", value)
    count = int(value)
    check_count(path, count)
    used = [key for key in ("means", "quats", "scales", "sh0", "shN") if meta.get(key)]
    parts = {key: _part(path, root, key, count, fetch) for key in used}
    lacking = [key for key in ("means", "quats", "scales", "sh0") if key not in parts]
    if lacking:
        raise root.place.error(f"{lacking[0]} is missing")
    palette = _palette(parts["shN"], version) if "shN" in parts else torch.zeros(1, 0, 3)
    degree = round((palette.shape[1] + 1) ** 0.5) - 1
    convention, evidence, flat = _meaning(meta)
    load, notes = partial(_rows, parts, palette, version, flat), (f"version {version}",)
    files = [file for part in parts.values() for file in part.entry.value("files")] if path.name == META else []
    others = tuple(path.parent / file for file in files)
    return Scene(path, name, count, degree, load, evidence, convention, flat=flat, notes=notes, others=others)


def _part(path: Path, root: Entry, key: str, count: int, fetch: Fetch) -> Part:
    entry = root.entry(key)
    files = entry.value("files")
    wanted = 2 if key in ("means", "shN") else 1
    entry.place.expect(isinstance(files, list) and len(files) == wanted, "files", f"{wanted} names", files)
    images = []
    for index, file in enumerate(files):
        plain = isinstance(file, str) and bool(FILE_NAME.fullmatch(file))
        entry.place.expect(plain, "files", "names of plain files beside meta.json", file)
        palette = key == "shN" and index == 0
        noisy = key == "means" and index == 0  # low bytes do not compress: the size tells the count
        images.append(_image(path, file, fetch, None if palette else count, noisy))
    return Part(entry, [pixels for pixels, _ in images], images[0][1])


def _image(path: Path, file: str, fetch: Fetch, count: int | None, noisy: bool) -> tuple[np.ndarray, int]:
    """RGBA of a lossless WebP, a row per pixel, and its width; refuses more pixels than `count` Gaussians need."""
    most = 2 * count + SPARE_PIXELS if count is not None else MAX_PALETTE_PIXELS
    data = fetch(file, BYTES_PER_PIXEL * most + whole_limit("SLACK"))
    if noisy:
        check_growth(path, BYTES_PER_PIXEL * (count or 0), len(data))
    # Pillow warns about large images; the check below is stricter
    with warnings.catch_warnings(action="ignore"), Image.open(io.BytesIO(data), formats=["WEBP"]) as image:
        width, height = image.size
        if width * height > most or width * height < (count or 1):
            raise FormatError(path, f"{file} has {width}x{height} px, and {count or most:,} are wanted")
        return np.asarray(image.convert("RGBA")).reshape(-1, 4), width


def _meaning(meta: dict[str, Any]) -> tuple[Convention, str, bool]:
    model = meta.get("model")
    if model is None:
        return CLASSIC, "no model in meta.json: assumed classic (3DGS default)", False
    said = f"model in meta.json: {json.dumps(model)[:40]}"
    if model == "antialiased":
        return COMPENSATED, f"{said}; {KERNEL_LOST}", False
    if model == "2dgs":
        return CLASSIC, f"{said}: 2D Gaussians, taken for classic", True
    return CLASSIC, said + ("" if model == "default" else " is unknown: assumed classic"), False


def _palette(part: Part, version: int) -> Float[Tensor, "p c 3"]:
    """The harmonics that labels index."""
    coefficients, rest = divmod(part.width, PALETTE_ROW)
    if coefficients not in (3, 8, 15) or rest:
        raise part.entry.place.error(f"the palette's image is {part.width} px wide; 192, 512 or 960 expected")
    pixels = part.pixels[0][:, :3].reshape(-1, coefficients, 3)
    if version > 1:
        return part.coded(pixels)
    low, high = (part.entry.get(key, number) for key in ("mins", "maxs"))
    return floats(pixels) / 255 * (high - low) + low


def _rows(
    parts: dict[str, Part], palette: Float[Tensor, "p c 3"], version: int, flat: bool, start: int, stop: int
) -> Gaussians:
    rows = slice(start, stop)
    means, quats, scales, sh0 = (parts[key] for key in ("means", "quats", "scales", "sh0"))
    alpha = sh0.pixels[0][rows, 3]
    if version > 1:
        log_scales, colours, logits = (
            scales.coded(scales.pixels[0][rows, :3]),
            sh0.coded(sh0.pixels[0][rows, :3]),
            byte_opacities(alpha),
        )
    else:
        log_scales, both = scales.between(3, rows), sh0.between(4, rows)
        colours, logits = both[:, :3], both[:, 3]
    sh = torch.zeros(len(alpha), 1 + palette.shape[1], 3)
    sh[:, 0] = colours
    if "shN" in parts:
        labels = parts["shN"].pixels[1][rows].astype(np.int64)
        index = torch.from_numpy(labels[:, 0] + 256 * labels[:, 1])
        sh[:, 1:] = palette[index.clamp(max=len(palette) - 1)] * (index < len(palette))[:, None, None]
    if flat:
        log_scales[:, 2] = -MAX_LOG_SCALE
    return Gaussians(_means(means, rows), _quats(quats.pixels[0][rows]), log_scales, logits, sh)


def _means(part: Part, rows: slice) -> Float[Tensor, "n 3"]:
    low, high = (part.pixels[i][rows, :3].astype(np.float64) for i in range(2))
    least, most = part.entry.vector("mins", 3), part.entry.vector("maxs", 3)
    span = torch.where(most == least, 1.0, most - least)
    logs = least + span * torch.from_numpy((low + 256 * high) / 65535)
    return (logs.sign() * logs.abs().expm1()).float()


def _quats(pixels: np.ndarray) -> Float[Tensor, "n 4"]:
    rest = (floats(pixels[:, :3]) / 255 - 0.5) * 2**0.5
    valid = torch.from_numpy(pixels[:, 3] >= W_LARGEST)
    largest = torch.from_numpy(pixels[:, 3].astype(np.int64)) - W_LARGEST
    quats = largest_last(rest, largest.clamp(min=0))
    return torch.where(valid[:, None], quats, torch.tensor([1.0, 0.0, 0.0, 0.0]))
