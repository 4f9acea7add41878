"""One small scene in every format: written by splat-transform where it can (tests/data), or else packed here."""

import gzip
import json
import shutil
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.lib import recfunctions as rfn

from aaplug import SH_C0, Gaussians, read_scene, write_scene
from aaplug.core.conventions import CLASSIC
from aaplug.core.placing import mirrored, placed
from aaplug.io.scenes.lcc import FAR_RECORD, Z_UP

DATA = Path(__file__).resolve().parent / "data"
ORACLE = DATA / "oracle.ply"  # random, 40 Gaussians of degree 3, tagged mip; the others are made of it
half_turn_about_x = partial(mirrored, signs=(1.0, -1.0, -1.0))


def write_json(path: Path, document: object) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(document))
    return path


def with_value(document: Any, place: Sequence[str | int], value: object) -> Any:
    """A copy of a document of JSON with another value at a place, which is told by keys and indices."""
    changed = part = json.loads(json.dumps(document))
    for key in place[:-1]:
        part = part[key]
    part[place[-1]] = value
    return changed


def oracle() -> Gaussians:
    return read_scene(ORACLE).gaussians()


def bytes_of(values: torch.Tensor, gain: float, offset: float) -> np.ndarray:
    return (values * gain + offset).round().clamp(0, 255).to(torch.uint8).numpy()


def spz(version: int, zipped: bool = True, flags: int = 1, degree: int = 3) -> bytes:
    """Versions 1 and 2, and what is common to all before 4, in OpenGL's axes."""
    s = oracle()
    flip = torch.tensor([1.0, -1.0, -1.0])
    means, k = s.means * flip, (degree + 1) ** 2
    signs = [(-1.0) ** ((m < 0) + d - abs(m)) for d in range(degree + 1) for m in range(-d, d + 1)]
    sh = torch.zeros(len(s), k, 3)
    sh[:, : min(k, 16)] = s.sh[:, :k]
    sh = sh * torch.tensor(signs)[:, None]
    fixed = (means.double() * 4096).round().to(torch.int32).numpy().astype("<i4")
    positions = fixed.view(np.uint8).reshape(len(s), 3, 4)[..., :3].tobytes()
    if version == 1:
        positions = means.half().numpy().astype("<f2").tobytes()
    w, *xyz = s.unit_quats.T
    turned = torch.stack(xyz, 1) * flip * torch.where(w < 0, -1.0, 1.0)[:, None]
    body = [
        positions,
        bytes_of(s.opacities, 255, 0).tobytes(),
        bytes_of(s.sh[:, 0], 0.15 * 255, 127.5).tobytes(),
        bytes_of(s.log_scales, 16, 160).tobytes(),
        bytes_of(turned, 127.5, 127.5).tobytes(),
        bytes_of(sh[:, 1:], 128, 128).tobytes(),
    ]
    data = struct.pack("<4sIIBBBB", b"NGSP", version, len(s), degree, 12, flags, 0) + b"".join(body)
    return gzip.compress(data, mtime=0) if zipped else data


def splat() -> bytes:
    s = oracle()
    shapes = torch.cat([s.means, s.scales], 1).numpy().astype("<f4").view(np.uint8)
    return np.concatenate([shapes, rgba_bytes(s), bytes_of(s.unit_quats, 128, 128)], axis=1).tobytes()


def rgba_bytes(s: Gaussians) -> np.ndarray:
    return bytes_of(torch.cat([0.5 + SH_C0 * s.sh[:, 0], s.opacities[:, None]], 1), 255, 0)


def ksplat(level: int, degree: int = 2, per_bucket: int = 16) -> bytes:
    """One section in buckets of 16, the last one filled in part."""
    s, block, steps = oracle(), 8.0, 32767
    n, k = len(s), (degree + 1) ** 2
    full, left = divmod(n, per_bucket)
    centres = np.array([[0.1, -0.2, 0.3]] * (full + 1), "<f4")
    bands = [s.sh[:, d * d : (d + 1) ** 2].transpose(1, 2).reshape(n, -1) for d in range(1, degree + 1)]
    rest = torch.cat([torch.zeros(n, 0), *bands], dim=1).numpy()
    assert rest.shape[1] == 3 * (k - 1)
    wide, sh_type = ("<f4", "<f4") if level == 0 else ("<f2", "<f2" if level == 1 else "u1")
    position = "<f4" if level == 0 else "<u2"
    shapes = [("p", position, 3), ("s", wide, 3), ("q", wide, 4), ("c", "u1", 4), ("h", sh_type, rest.shape[1])]
    record = np.dtype(shapes)
    rows = np.zeros(n, record)
    means = s.means.numpy()
    rows["p"] = means if level == 0 else np.round((means - centres[0]) * steps / (block / 2) + steps)
    rows["s"], rows["q"] = s.scales.numpy(), s.unit_quats.numpy()
    rows["c"] = rgba_bytes(s)
    rows["h"] = rest if level < 2 else np.round((rest + 1.5) / 3 * 255).clip(0, 255)
    main = bytearray(4096)
    struct.pack_into("<BBxxIIIIHxx", main, 0, 0, 1, 1, 1, n, n, level)
    struct.pack_into("<ff", main, 36, -1.5, 1.5)
    section = bytearray(1024)
    buckets = (0, 0, 0, 0) if level == 0 else (per_bucket, full + 1, full, 1)
    struct.pack_into(
        "<IIIIfHxxIxxxxIIH", section, 0, n, n, *buckets[:2], block, 12 * (level > 0), steps, *buckets[2:], degree
    )
    body = b"" if level == 0 else struct.pack("<I", left) + centres.tobytes()
    return bytes(main + section) + body + rows.tobytes()


def lcc(folder: Path) -> Path:
    """Two parts of space in an index of two levels, and the last Gaussians as the environment, z up."""
    s, first, far = placed(oracle(), Z_UP.T, 1.0, (0.0, 0.0, 0.0)), 25, 5
    low, high, span = s.scales.amin(dim=0), s.scales.amax(dim=0), s.sh[:, 1:].abs().max().item()
    xyzw = s.unit_quats.roll(-1, dims=1)
    largest = xyzw.abs().argmax(dim=1)
    positive = xyzw * xyzw.gather(1, largest[:, None]).sign()
    rest = torch.stack([torch.cat([q[:i], q[i + 1 :]]) for q, i in zip(positive, largest.tolist(), strict=True)])
    tenth = torch.cat([((rest / 2**0.5 + 0.5) * 1023).round().long(), largest[:, None]], dim=1)
    channels = ((s.sh[:, 1:] / span + 1) / 2 * torch.tensor([2047, 1023, 2047])).round().long()
    rows = np.zeros(len(s), FAR_RECORD)
    rows["means"], rows["rgba"] = s.means, rgba_bytes(s)
    rows["scales"] = ((s.scales - low) / (high - low) * 65535).round()
    rows["quats"] = (tenth << torch.tensor([0, 10, 20, 30])).sum(dim=1)
    rows["sh"][:, :15] = (channels << torch.tensor([0, 11, 21])).sum(dim=2)
    near, index = rows[:-far], b""
    for number, part in enumerate((near[:first], near[first:])):
        start = 32 * (number * first)
        index += struct.pack("<IIQIIQI", number << 16, len(part), start, 32 * len(part), 1, start, 32)
    base, ends = [name for name in FAR_RECORD.names if name != "sh"], {"shcoef": ([-span] * 3, [span] * 3)}
    ends["scale"] = low.tolist(), high.tolist()
    attributes = [{"name": f"{sky}{k}", "min": v[0], "max": v[1]} for k, v in ends.items() for sky in ("", "env")]
    (folder / "Index.bin").write_bytes(index)
    (folder / "data.bin").write_bytes(rfn.repack_fields(near[base]).tobytes())
    (folder / "shcoef.bin").write_bytes(near["sh"].tobytes())
    (folder / "environment.bin").write_bytes(rows[-far:].tobytes())
    meta = {"fileType": "Quality", "totalLevel": 2, "indexDataSize": 36, "attributes": attributes}
    return write_json(folder / "scene.lcc", meta)


def streamed_sog(folder: Path) -> Path:
    """Two nodes of one SOG, and a coarser level that is missing."""
    shutil.copytree(DATA / "oracle_sog", folder / "0_0", dirs_exist_ok=True)
    lods = [{"0": {"file": 0, "offset": 0, "count": 25}, "1": {"file": 1, "offset": 0, "count": 3}}]
    lods.append({"0": {"file": 0, "offset": 25, "count": 15}})
    meta = {"version": 1, "filenames": ["0_0/meta.json", "1_0/meta.json"]}
    return write_json(folder / "lod-meta.json", meta | {"tree": {"children": [{"lods": each} for each in lods]}})


def lcc2(folder: Path) -> Path:
    """A node of a .sog above two leaves of a .spz, z up."""
    scene = replace(placed(oracle(), Z_UP.T, 1.0, (0.0, 0.0, 0.0)), origin=None, convention=CLASSIC)
    write_scene(folder / "a.spz", scene[:30], overwrite=True, spz_axes="opencv")
    write_scene(folder / "b.spz", scene[30:], overwrite=True, spz_axes="opencv")
    leaves = {"a": {"data": {"3dgs": {"name": 0, "start": 0, "count": 20}}}}
    leaves["b"] = {"data": {"3dgs": {"name": 0, "start": 20}}, "child": []}
    tree = {"splatFiles": ["a.spz", "b.spz", "c.sog"], "data": {"env": {"name": 1}}}
    tree["child"] = [{"data": {"3dgs": {"name": 2}}, "child": leaves}]
    path = write_json(folder / "scene.lcc2", {"root": tree})
    path.write_text(path.read_text().replace("}]}", "},]}"))  # as some writers leave it
    return path


def splats() -> dict[str, torch.Tensor]:
    """The scene as gsplat's trainer holds it."""
    s = oracle()
    columns = {"means": s.means, "scales": s.log_scales, "quats": s.quats, "opacities": s.logit_opacities}
    return {key: value.clone() for key, value in (columns | {"sh0": s.sh[:, :1], "shN": s.sh[:, 1:]}).items()}


MADE: Mapping[str, Callable[[], bytes]] = {
    "v1.spz": lambda: spz(1),
    "v2.spz": lambda: spz(2),
    "raw.spz": lambda: spz(2, zipped=False),
    "degree4.spz": lambda: spz(2, degree=4),
    "plain.splat": splat,
    "level0.ksplat": lambda: ksplat(0),
    "level1.ksplat": lambda: ksplat(1),
    "level2.ksplat": lambda: ksplat(2),
}
STORED = ("oracle.ply", "oracle.compressed.ply", "oracle_v3.spz", "oracle_v4.spz", "oracle.sog", "oracle_sog/meta.json")


SEVERAL: Mapping[str, Callable[[Path], Path]] = {"scene.lcc": lcc, "lod-meta.json": streamed_sog, "scene.lcc2": lcc2}


def write_file(folder: Path, name: str) -> Path:
    """The file of that name of MADE, STORED or SEVERAL, or a checkpoint, in a folder."""
    if name in SEVERAL:
        return SEVERAL[name](folder)
    path = folder / name
    if name.endswith(".pt"):
        torch.save({"step": 1, "splats": splats()}, path)
    elif name in MADE:
        path.write_bytes(MADE[name]())
    else:
        return DATA / name
    return path
