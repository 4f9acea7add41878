"""Parts of formats other than .ply: values as they store them, axes, and files of several files.

n: rows.  Arrays are numpy's, as they come from files.

Functions raise FormatError for a file that breaks its format.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from glob import escape
from hashlib import sha256
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from aaplug.core.gaussians import MIN_OPACITY, Gaussians, joined
from aaplug.core.placing import mirrored, placed
from aaplug.core.spherical_harmonics import COLOUR_OFFSET, SH_C0
from aaplug.io.atomic import check_output, write_file
from aaplug.io.values import Place
from aaplug.system.contracts import contract

MAX_BYTE = 255
HASH_DIGITS = 8  # in the name of a file that another one names
UNALIKE = 1e-4  # of the scale: a difference between axes that counts as rounding
half_turn_about_z = partial(mirrored, signs=(-1.0, -1.0, 1.0))  # from glTF's axes to OpenCV's, and back


class Piece(NamedTuple):
    """Rows of a scene: how many, the degree of their harmonics, and what reads those from start up to stop."""

    length: int
    degree: int
    load: Callable[[int, int], Gaussians]

    @classmethod
    def of(cls, parts: Sequence[Gaussians]) -> "Piece":
        """All rows of these parts, at least one, in memory, with harmonics up to the highest degree."""
        scene = joined([of_degree(part, max(p.sh_degree for p in parts)) for part in parts])
        return cls(len(scene), scene.sh_degree, lambda start, stop: scene[start:stop])


def largest_last(rest: Float[Tensor, "n 3"], largest: Tensor) -> Float[Tensor, "n 4"]:
    """Unit quaternions from three components in order, and the index of the largest, which is not stored."""
    missing = (1 - rest.square().sum(dim=1)).clamp(min=0).sqrt()
    order = torch.tensor([[3, 0, 1, 2], [0, 3, 1, 2], [0, 1, 3, 2], [0, 1, 2, 3]])
    return torch.cat([rest, missing[:, None]], dim=1).gather(1, order[largest.long()])


def word_quats(words: np.ndarray, *fields: tuple[int, int]) -> Float[Tensor, "n 4"]:
    """Unit quaternions from words: two bits for the largest component, and fields (see `fractions`) for the others."""
    return largest_last((fractions(words, *fields) - 0.5) * 2**0.5, floats(words >> 30))


def without_largest(quats: Float[Tensor, "n 4"]) -> tuple[Float[Tensor, "n 3"], Int[Tensor, " n"]]:
    """The inverse of `largest_last`: the three smaller components, where the largest is positive, and its index."""
    largest = quats.abs().argmax(dim=1)
    others = torch.tensor([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])[largest]
    negative = quats.gather(1, largest[:, None]) < 0
    return quats.gather(1, others) * torch.where(negative, -1.0, 1.0), largest


def bytes_of(values: Tensor) -> np.ndarray:
    """Values rounded to bytes, those beyond cut off."""
    return values.clamp(0, MAX_BYTE).round().to(torch.uint8).numpy()


def byte_opacities(alpha: np.ndarray) -> Float[Tensor, " n"]:
    """Logits of opacities stored as bytes."""
    return logit_of(floats(alpha) / MAX_BYTE)


@contract
def logit_of(opacity: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
    """Logits of opacities; finite at 0 and 1."""
    return opacity.clamp(MIN_OPACITY, 1 - MIN_OPACITY).logit()


@contract
def sh_of_colour(rgb: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
    """Harmonics of degree 0 of colours in [0, 1]."""
    return (rgb - COLOUR_OFFSET) / SH_C0


def fractions(words: np.ndarray, *fields: tuple[int, int]) -> Float[Tensor, "*n c"]:
    """Fields of words, each a place and a number of bits, as fractions of the largest value."""
    masks = [(shift, (1 << bits) - 1) for shift, bits in fields]
    return torch.stack([floats(words >> shift & mask) / mask for shift, mask in masks], dim=-1)


def floats(values: np.ndarray) -> Tensor:
    """A copy as a float32 tensor."""
    return torch.from_numpy(values.astype(np.float32))


def replacing_group(
    path: Path, beside: Mapping[str, bytes], whole: Callable[[Mapping[str, str]], bytes], overwrite: bool
) -> None:
    """Write a file that names others beside it, so that it and they appear together.

    The others' names carry a hash of their content, so that a file that is replaced never names a new one of them.
    Those of an earlier version are removed at the end, where no other file of the same suffix names them.

    path: of the file that names the others.  beside: their contents by plain name.
    whole: makes its content of their names in the folder, by plain name.
    """
    check_output(path, overwrite)
    names, earlier = dict[str, str](), set[Path]()
    for plain, content in beside.items():
        stem, _, suffix = plain.rpartition(".")
        names[plain] = f"{stem}-{sha256(content).hexdigest()[:HASH_DIGITS]}.{suffix}"
        earlier |= set(path.parent.glob(f"{escape(stem)}-{'[0-9a-f]' * HASH_DIGITS}.{suffix}"))
        write_file(path.with_name(names[plain]), content, overwrite=True)
    write_file(path, whole(names), overwrite)
    stale = {json.dumps(file.name).strip('"').encode(): file for file in earlier if file.name not in names.values()}
    for other in filter(Path.is_file, path.parent.glob(f"*{path.suffix}") if stale else ()):
        try:
            content = other.read_bytes()
        except OSError:  # nobody knows what it names
            return
        stale = {name: file for name, file in stale.items() if name not in content}
    for file in stale.values():
        file.unlink(missing_ok=True)


def standing(scene: Gaussians, motion: Float[Tensor, "4 4"], place: Place) -> Gaussians:
    """A scene in axes with y up and z forward where a transform in these axes puts it, in OpenCV's axes.

    Raises FormatError if the transform does more than turn, move and scale alike along all axes.
    """
    if not torch.equal(motion, torch.eye(4, dtype=torch.float64)):
        axes = motion[:3, :3]
        scale = float(torch.linalg.det(axes).clamp(min=0) ** (1 / 3))
        error = (axes @ axes.T - scale**2 * torch.eye(3)).abs().max().item()
        alike = scale > 0 and error <= UNALIKE * scale**2
        place.expect(alike, "its transform", "a turn, a move and one scale", motion.tolist())
        scene = placed(scene, axes / scale, scale, motion[:3, 3].tolist())
    return half_turn_about_z(scene)


def of_degree(scene: Gaussians, degree: int) -> Gaussians:
    """The scene with harmonics up to this degree: those above are left out, those that it lacks are 0."""
    if not (missing := (degree + 1) ** 2 - scene.sh.shape[1]):
        return scene
    return replace(scene, sh=torch.nn.functional.pad(scene.sh, (0, 0, 0, missing)))


def in_a_row(pieces: Sequence[Piece]) -> Piece:
    """All rows of these pieces, with harmonics up to the highest degree."""
    degree = max((piece.degree for piece in pieces), default=0)

    def rows(start: int, stop: int) -> Gaussians:
        read, first = list[Gaussians](), 0
        for count, _, load in pieces:
            begin, end = max(start - first, 0), min(stop - first, count)
            if begin < end or (start == stop and not read):
                read.append(of_degree(load(begin, max(begin, end)), degree))
            first += count
        return joined(read)

    return Piece(sum(piece.length for piece in pieces), degree, rows)
