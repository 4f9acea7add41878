"""PlayCanvas' SOG, versions 1 and 2: meta.json and lossless WebP images, in a folder or in a .sog zip.

A Gaussian is a pixel of each image, row by row.  means: 16 bits per coordinate in two images, between mins and maxs of
sign(x)·ln(1 + |x|); quats: three bytes and the index of the largest component; scales and sh0 (colour, opacity):
indices into a codebook, in version 1 bytes between mins and maxs; shN: 16-bit indices into a palette of 64 entries per
row.  Images are read only if meta.json names plain files beside it.

Version 2 is written, in Morton order: as one .sog, or as a meta.json with the images beside it.  meta.json's `model`
tells that training compensated; the rest stays in a record of ours.
"""

import io
import json
import math
import re
import warnings
import zipfile
from collections.abc import Callable, Iterable, Mapping
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from aaplug.core.gaussians import MAX_LOG_SCALE, Gaussians
from aaplug.io.atomic import replacing
from aaplug.io.limits import whole_limit
from aaplug.io.scenes.codebooks import codebook, nearest_value, palette
from aaplug.io.scenes.packed import byte_opacities, bytes_of, floats, largest_last, replacing_group, without_largest
from aaplug.io.scenes.record import KEY, Facts, along_curve, read_record, record_of, warn_of_moves, whole
from aaplug.io.scenes.rows import SceneFileOptions, by_name, check_count, check_growth, library_errors
from aaplug.io.scenes.scene import COMPENSATED, KERNEL_LOST, Scene
from aaplug.io.values import Entry, natural, number, object_of, parse_json, read_bounded
from aaplug.system.errors import FormatError

META = "meta.json"
FILE_NAME = re.compile(r"[\w\-][\w\-.]{0,99}", re.ASCII)
ZIP_SIGNATURE = b"PK\x03\x04"
PALETTE_ROW = 64  # entries
MAX_PALETTE_PIXELS = PALETTE_ROW * 15 * (1 << 10)  # 64 entries of 15 coefficients in each of 1024 rows
MOST_DEGREE = 3
MAX_COUNT = 1 << 40  # Gaussians: more is nonsense
LEVELS = 256  # of a codebook
MAX_PALETTE = 1 << 16  # entries: labels have two bytes
WEBP_EFFORT, WEBP_METHOD = 50, 4  # of 100 and 6: a tenth larger than the most, in a tenth of the time
W_LARGEST = 252  # alpha of a quaternion whose w is largest; 253 to 255 stand for x, y, z
BYTES_PER_PIXEL = 4
SPARE_PIXELS = 1 << 16  # pixels allowed beyond twice the number of Gaussians

name = "sog"
keeps = ("harmonics", "record")

Fetch = Callable[[str, int], bytes]


@dataclass(frozen=True, eq=False)
class Part:
    """An entry of meta.json of a version, with its images as RGBA, a row per pixel, and the width of the first."""

    version: int
    entry: Entry
    pixels: list[np.ndarray]
    width: int

    def values(self, pixels: np.ndarray) -> Float[Tensor, "*n c"]:
        """Bytes as indices into the codebook, or in version 1 as fractions from mins to maxs."""
        if self.version > 1:
            return self.entry.vector("codebook", 256).float()[torch.from_numpy(pixels.astype(np.int64))]
        low, high = (self.entry.vector(key, pixels.shape[1]).float() for key in ("mins", "maxs"))
        return torch.lerp(low, high, floats(pixels) / 255)


def sniff(path: Path, head: bytes) -> bool:
    """True for a meta.json, and for a zip with the suffix .sog or .zip."""
    zipped = head.startswith(ZIP_SIGNATURE) and path.suffix.lower() in (".sog", ".zip")
    return zipped or (_is_meta(path) and head.lstrip().startswith(b"{"))


def open_scene(path: Path, options: SceneFileOptions) -> Scene:
    """See `SceneFormat`."""
    with library_errors(path), nullcontext() if _is_meta(path) else zipfile.ZipFile(path) as archive:
        fetch = partial(_from_folder, path) if archive is None else partial(_from_zip, path, archive)
        meta = parse_json(fetch(META if archive else path.name, whole_limit("JSON")), path)
        root = object_of(meta, path, META, "means, scales, quats and sh0")
        version = root.fields.get("version", 1)
        right = version in (1, 2) and (version == 2) == ("version" in meta)
        root.place.expect(right, "version", "2, or left out", version)
        value = root.value("count") if version > 1 else root.entry("means").fields.get("shape", [0])
        value = value[0] if isinstance(value, list) and value else value
        count = natural(value, root.place, "count", MAX_COUNT)
        check_count(path, count)
        used = ["means", "quats", "scales", "sh0", *["shN"] * bool(meta.get("shN"))]
        parts = {key: _part(path, version, root.entry(key), count, fetch) for key in used}
        palette = _palette(parts["shN"]) if "shN" in parts else torch.zeros(1, 0, 3)
        facts = read_record(path, meta, _meaning(meta))
    degree = round((palette.shape[1] + 1) ** 0.5) - 1
    load, notes = partial(_rows, parts, palette, facts.flat), (f"version {version}",)
    files = [file for part in parts.values() for file in part.entry.value("files")] if _is_meta(path) else []
    others = tuple(path.parent / file for file in files)
    return Scene(path, name, count, degree, load, *facts, notes=notes, others=others)


def _is_meta(path: Path) -> bool:
    return f".{path.name.lower()}".endswith(f".{META}")


def _from_folder(path: Path, file: str, most: int) -> bytes:
    image = path.parent / file
    if not image.resolve().is_relative_to(path.parent.resolve()):
        raise FormatError(path, f"names {file!r}, a link that leads out of its folder")
    return read_bounded(image, most)


def _from_zip(path: Path, archive: zipfile.ZipFile, file: str, most: int) -> bytes:
    inside = [i for i in archive.infolist() if i.filename.rpartition("/")[2] == file]
    if not inside and file == META:
        what = f"is an archive without {META}, which a .sog has"
        raise FormatError(path, f"{what}; if a scene's file is in it, unpack it and name that file")
    if len(inside) != 1:
        raise FormatError(path, f"should hold {file} once, and holds it {len(inside)} times")
    check_growth(path, inside[0].file_size, inside[0].compress_size)
    if inside[0].file_size > most:
        raise FormatError(path, f"{file} has {inside[0].file_size:,} bytes, more than {most:,}")
    with archive.open(inside[0]) as stream:
        return stream.read(most + 1)


def _part(path: Path, version: int, entry: Entry, count: int, fetch: Fetch) -> Part:
    key, files = entry.place.entry, entry.value("files")
    wanted = 2 if key in ("means", "shN") else 1
    entry.place.expect(isinstance(files, list) and len(files) == wanted, "files", f"{wanted} names", files)
    images = list[np.ndarray]()
    for file in files:
        plain = isinstance(file, str) and bool(FILE_NAME.fullmatch(file))
        entry.place.expect(plain, "files", "names of plain files beside meta.json", file)
        palette = key == "shN" and not images
        least, most = (1, MAX_PALETTE_PIXELS) if palette else (max(1, count), 2 * count + SPARE_PIXELS)
        data = fetch(file, BYTES_PER_PIXEL * most + whole_limit("SLACK"))
        if key == "means" and not images:  # low bytes do not compress: the size tells the count
            check_growth(path, BYTES_PER_PIXEL * count, len(data))
        # Pillow warns about large images; the check below is stricter
        with warnings.catch_warnings(action="ignore"), Image.open(io.BytesIO(data), formats=["WEBP"]) as image:
            width, height = image.size
            if not least <= width * height <= most:
                wanted = most if palette else count
                raise FormatError(path, f"{file} has {width}x{height} px, and {wanted:,} are wanted")
            images.append(np.asarray(image.convert("RGBA")))
    return Part(version, entry, [image.reshape(-1, BYTES_PER_PIXEL) for image in images], images[0].shape[1])


def _meaning(meta: dict[str, Any]) -> Facts:
    model = meta.get("model")
    if model is None:
        return Facts("no model in meta.json: assumed classic (3DGS default)")
    said = f"model in meta.json: {json.dumps(model)[:40]}"
    if model == "antialiased":
        return Facts(f"{said}; {KERNEL_LOST}", COMPENSATED)
    if model == "2dgs":
        return Facts(f"{said}: 2D Gaussians, taken for classic", flat=True)
    return Facts(said + ("" if model == "default" else " is unknown: assumed classic"))


def _palette(part: Part) -> Float[Tensor, "p c 3"]:
    """The harmonics that labels index."""
    coefficients, rest = divmod(part.width, PALETTE_ROW)
    if coefficients not in (3, 8, 15) or rest:
        raise part.entry.place.error(f"the palette's image is {part.width} px wide; 192, 512 or 960 expected")
    pixels = part.pixels[0][:, :3].reshape(-1, coefficients, 3)
    if part.version > 1:
        return part.values(pixels)
    low, high = (part.entry.get(key, number) for key in ("mins", "maxs"))
    return floats(pixels) / 255 * (high - low) + low


def _rows(parts: dict[str, Part], palette: Float[Tensor, "p c 3"], flat: bool, start: int, stop: int) -> Gaussians:
    rows = slice(start, stop)
    means, quats, scales, sh0 = (parts[key] for key in ("means", "quats", "scales", "sh0"))
    log_scales = scales.values(scales.pixels[0][rows, :3])
    colours = sh0.values(sh0.pixels[0][rows, : 3 if sh0.version > 1 else 4])
    logits = byte_opacities(sh0.pixels[0][rows, 3]) if sh0.version > 1 else colours[:, 3]
    sh = torch.zeros(len(logits), 1 + palette.shape[1], 3)
    sh[:, 0] = colours[:, :3]
    if "shN" in parts:
        labels = parts["shN"].pixels[1][rows].astype(np.int64)
        index = torch.from_numpy(labels[:, 0] + 256 * labels[:, 1])
        sh[:, 1:] = palette[index.clamp(max=len(palette) - 1)] * (index < len(palette))[:, None, None]
    if flat:
        log_scales[:, 2] = -MAX_LOG_SCALE
    turns = quats.pixels[0][rows]
    largest = torch.from_numpy(turns[:, 3].astype(np.int64)) - W_LARGEST
    unit = largest_last((floats(turns[:, :3]) / 255 - 0.5) * 2**0.5, largest.clamp(min=0))
    unit = torch.where(largest[:, None] < 0, torch.tensor([1.0, 0.0, 0.0, 0.0]), unit)
    low, high = (means.pixels[i][rows, :3].astype(np.float64) for i in range(2))
    least, most = means.entry.vector("mins", 3), means.entry.vector("maxs", 3)
    span = torch.where(most == least, 1.0, most - least)
    centres = _unsquashed(least + span * torch.from_numpy((low + 256 * high) / 65535)).float()
    return Gaussians(centres, unit, log_scales, logits, sh)


def _unsquashed(logs: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    return logs.sign() * logs.abs().expm1()


# Writing


def write(path: Path, parts: Iterable[Gaussians], count: int, overwrite: bool, options: SceneFileOptions) -> None:
    """Write one .sog, a zip of meta.json and the images; or a meta.json with the images beside it."""
    meta, images = encoded(path, parts)
    if _is_meta(path):
        replacing_group(path, images, partial(_json, meta), overwrite)
        return
    with replacing(path, overwrite) as stream, zipfile.ZipFile(stream, "w") as archive:
        for file, content in {**images, META: _json(meta, {file: file for file in images})}.items():
            archive.writestr(zipfile.ZipInfo(file), content)


class _Unbundled:
    """The meta.json of a folder; it is read as `sog`."""

    name, keeps, read_as = META, keeps, name
    sniff, open_scene, write = staticmethod(by_name()), staticmethod(open_scene), staticmethod(write)


UNBUNDLED = _Unbundled()


def encoded(path: Path, parts: Iterable[Gaussians]) -> tuple[dict[str, Any], dict[str, bytes]]:
    """The meta.json of a scene, and its images by name; raises OutputError for what SOG cannot hold."""
    scene = along_curve(whole(path, parts, name, MOST_DEGREE, flat=True))
    logs = scene.means.double().sign() * scene.means.double().abs().log1p()
    least, most = logs.amin(dim=0), logs.amax(dim=0)
    span = torch.where(most > least, most - least, 1.0)
    steps = ((logs - least) / span * 65535).round().long()
    warn_of_moves(path, name, scene, _unsquashed(least + span * steps / 65535) - scene.means)
    rest, largest = without_largest(scene.unit_quats)
    log_scales = scene.log_scales.clamp(-MAX_LOG_SCALE, MAX_LOG_SCALE)
    scale_levels, colour_levels = codebook(log_scales.flatten(), LEVELS), codebook(scene.sh[:, 0].flatten(), LEVELS)
    colours, alphas = nearest_value(scene.sh[:, 0], colour_levels), bytes_of(scene.opacities[:, None] * 255)
    quats = np.concatenate([bytes_of((rest / 2**0.5 + 0.5) * 255), (largest[:, None] + W_LARGEST).numpy()], axis=1)
    tables = {
        "means_l": (steps % 256).numpy(),
        "means_u": (steps // 256).numpy(),
        "scales": nearest_value(log_scales, scale_levels).numpy(),
        "quats": quats,
        "sh0": np.concatenate([colours.numpy(), alphas], axis=1),
    }
    width = -(-math.isqrt(len(scene)) // 4) * 4 + 4
    images = {f"{key}.webp": _webp(table, width) for key, table in tables.items()}
    meta = {
        "version": 2,
        "asset": {"generator": "aaplug"},
        "count": len(scene),
        **({"model": "2dgs"} if scene.flat else {"model": "antialiased"} if scene.convention.compensated else {}),
        "means": {"mins": least.tolist(), "maxs": most.tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": scale_levels.tolist(), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": colour_levels.tolist(), "files": ["sh0.webp"]},
        KEY: record_of(scene),
    }
    if scene.sh_degree:
        centres, labels = palette(scene.sh[:, 1:].flatten(1), MAX_PALETTE)
        levels = codebook(centres.flatten(), LEVELS)
        centres = nearest_value(centres, levels).reshape(-1, 3).numpy()
        files = {"shN_centroids.webp": _webp(centres, PALETTE_ROW * (scene.sh.shape[1] - 1))}
        files["shN_labels.webp"] = _webp(torch.stack([labels % 256, labels // 256], dim=1).numpy(), width)
        images |= files
        facts = {"count": len(centres) // (scene.sh.shape[1] - 1), "bands": scene.sh_degree}
        meta["shN"] = {**facts, "codebook": levels.tolist(), "files": list(files)}
    return meta, images


def _json(meta: dict[str, Any], names: Mapping[str, str]) -> bytes:
    """meta.json, with these names for the images."""
    parts = {key: value | {"files": [names[file] for file in value["files"]]} for key, value in meta.items()
             if isinstance(value, dict) and "files" in value}  # fmt: skip
    return json.dumps(meta | parts, separators=(",", ":")).encode()


def _webp(table: np.ndarray, width: int) -> bytes:
    """A lossless image of rows of at most four bytes, opaque if they have no fourth; colours under alpha 0 stay."""
    height = -(-len(table) // width)
    pixels = np.zeros((height * width, 4), np.uint8)
    pixels[:, 3] = 255
    pixels[: len(table), : table.shape[1]] = table
    image, stream = Image.fromarray(pixels.reshape(height, width, 4)), io.BytesIO()
    image.save(stream, "WEBP", lossless=True, exact=True, quality=WEBP_EFFORT, method=WEBP_METHOD)
    return stream.getvalue()
