"""RAD, version 1: one file with a tree of Gaussians, as Spark 2.1 and later streams it.

No text specifies the format; this is what Spark's encoder and decoder (rad.rs) agree on.  "RAD0", the length of a JSON
header and the header, then chunks of 65,536 Gaussians: "RADC", a header likewise, the payload's length, and property
after property.  All parts are padded to 8 bytes; a property is deflated and holds one component after another.

Gaussian 0 is the root.  The children of each lie side by side, so their count and the place of the first tell which
they are.  Spark starts at the root and replaces the Gaussian that looks largest by its children, until none is larger
than a pixel: see `node_sizes`.
"""

import json
import struct
import zlib
from collections.abc import Mapping
from dataclasses import replace
from itertools import accumulate
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from aaplug.core.gaussians import Gaussians, joined
from aaplug.core.placing import box_of
from aaplug.core.runs import starts_of

VERSION = 1
CHUNK_GAUSSIANS = 1 << 16
MEAN_SIGMAS = 2.0  # a Gaussian's size for Spark, as a multiple of the mean of its three standard deviations
MAX_NODE_SIZE = 1.0  # px: Spark replaces what is larger by its children
MAX_CHILDREN = CHUNK_GAUSSIANS - 1  # a count has two bytes
ROOT_SIGMAS = 3.0  # to which the root holds the Gaussians
ALIGNMENT = 8  # bytes
RAW_DEFLATE = -15  # zlib's window bits for data without a header
DEFLATE_LEVEL = 6  # of 9
INVISIBLE = -100.0  # logit of an opacity that is 0 in half precision
SPANNED = 0.999  # share of colours, scales and harmonics that Spark's 8 bits reach
MIN_SPAN = 1e-3  # of harmonics
MAX_S8 = 127
BANDS = (slice(1, 4), slice(4, 9), slice(9, 16))  # coefficients of degrees 1 to 3


class Tree(NamedTuple):
    """Gaussians from the root down, the children of each side by side.

    counts: of each one's children; 0 at a leaf.  starts: place of the first child.
    """

    scene: Gaussians
    counts: Int[Tensor, " n"]
    starts: Int[Tensor, " n"]


def node_sizes(scene: Gaussians) -> Float[Tensor, " n"]:
    """The size of each Gaussian by which Spark chooses, in world units."""
    return MEAN_SIGMAS * scene.scales.mean(dim=1)


def shown_of(sizes: Float[Tensor, " n"], parents: Int[Tensor, " n"]) -> Int[Tensor, " k"]:
    """Places of the Gaussians of a tree that Spark draws: small enough themselves, and their parents are not.

    sizes: see `node_sizes`, in px.  parents: place of each one's parent; -1 for none.
    """
    replaced = sizes > MAX_NODE_SIZE
    replaced[torch.ones_like(parents, dtype=torch.bool).index_fill_(0, parents[parents >= 0], False)] = False  # leaves
    shown, above = ~replaced, parents
    while bool((inner := above >= 0).any()):
        shown &= ~inner | replaced[above]
        above = torch.where(inner, parents[above], above)
    return shown.nonzero()[:, 0]


def tree_of(scene: Gaussians, parents: Int[Tensor, " n"]) -> Tree:
    """The tree of Gaussians; where there are too many siblings, or several without a parent, others come above them.

    Those are invisible and as large as the scene, so Spark replaces them until all of it is smaller than a pixel.

    parents: place of each one's parent; -1 for none.
    """
    means = scene.means
    while (family := _crowded(parents)) is not None:
        siblings = (parents == family).nonzero()[:, 0]
        owners = torch.arange(len(siblings)) // MAX_CHILDREN
        sizes = torch.bincount(owners)
        middles = means.new_zeros(len(sizes), 3).index_add(0, owners, means[siblings]) / sizes[:, None]
        moved = parents.index_copy(0, siblings, len(means) + owners)
        means, parents = torch.cat([means, middles]), torch.cat([moved, parents.new_full((len(sizes),), family)])
    low, high = box_of(scene, ROOT_SIGMAS)
    above = scene[torch.zeros(len(means) - len(scene), dtype=torch.int64)]
    shape = {"log_scales": (high - low).max().log().expand(len(above), 3), "sh": torch.zeros_like(above.sh)}
    shape |= {"logit_opacities": torch.full_like(above.logit_opacities, INVISIBLE)}
    scene = joined([scene, replace(above, means=means[len(scene) :], **shape)])
    counts = torch.bincount(parents + 1, minlength=len(scene) + 1)[1:]
    siblings = torch.argsort(parents, stable=True)  # first the root, then the children of each
    firsts, order = 1 + starts_of(counts), [siblings[:1]]  # the first children's places among the siblings
    while len(above := order[-1]):  # the root, its children, theirs
        first = (firsts[above] - starts_of(counts[above])).repeat_interleave(counts[above])
        order.append(siblings[first + torch.arange(len(first))])
    along = torch.cat(order)
    counts = counts[along]
    return Tree(scene[along], counts, (1 + starts_of(counts)) * counts.sign())


def _crowded(parents: Int[Tensor, " n"]) -> int | None:
    """The parent of too many; -1 where several have none."""
    counts = torch.bincount(parents + 1, minlength=len(parents) + 1)
    counts[0] = counts[0] > 1 and CHUNK_GAUSSIANS
    most = int(counts.argmax())
    return most - 1 if counts[most] > MAX_CHILDREN else None


def rad_of(tree: Tree) -> bytes:
    """The file of a tree, its harmonics up to degree 3."""
    degree = min(len(BANDS), tree.scene.sh_degree)
    facts = {"version": VERSION, "maxSh": degree, "lodTree": True, "splatEncoding": _spans(tree.scene, degree)}
    chunks = [_chunk(tree, facts, base) for base in range(0, len(tree.scene), CHUNK_GAUSSIANS)]
    sizes = [len(chunk) for chunk in chunks]
    places = [{"offset": end - size, "bytes": size} for size, end in zip(sizes, accumulate(sizes), strict=True)]
    whole = {"type": "gsplat", "count": len(tree.scene), "chunkSize": CHUNK_GAUSSIANS, "comment": "aaplug"}
    return b"".join([_headed(b"RAD0", facts | whole | {"allChunkBytes": sum(sizes), "chunks": places}), *chunks])


def _spans(scene: Gaussians, degree: int) -> dict[str, Any]:
    """The ranges of Spark's 8 bits: of colours all of 0 to 1, of scales up to the largest, which the tree rests on."""
    low, high = np.quantile(scene.base_colours, (1 - SPANNED, SPANNED)).tolist()
    thick = scene.log_scales[scene.log_scales.isfinite()]  # JSON has no infinity, the log of no thickness
    thick = thick if len(thick) else torch.zeros(1)
    least, most = float(np.quantile(thick, 1 - SPANNED)), float(thick.max())
    spans = {"rgbMin": min(0.0, low), "rgbMax": max(1.0, high), "lnScaleMin": least, "lnScaleMax": most}
    for band, coefficients in enumerate(BANDS[:degree], 1):
        spans[f"sh{band}Max"] = max(MIN_SPAN, float(np.quantile(scene.sh[:, coefficients].abs(), SPANNED)))
    return spans | {"lodOpacity": True}


def _chunk(tree: Tree, facts: Mapping[str, Any], base: int) -> bytes:
    """The chunk of the Gaussians from `base` on."""
    payload, entries, spans = bytearray(), [], facts["splatEncoding"]
    rows = slice(base, base + CHUNK_GAUSSIANS)
    part = Tree(tree.scene[rows], tree.counts[rows], tree.starts[rows])
    for name, (encoding, values) in _properties(part, spans).items():
        data = zlib.compress(values.t().contiguous().numpy().tobytes(), DEFLATE_LEVEL, RAW_DEFLATE)
        ends = {"min": -spans[f"{name}Max"], "max": spans[f"{name}Max"]} if encoding == "s8" else {}
        about = {"offset": len(payload), "bytes": len(data), "compression": "gz", "property": name}
        entries.append({**about, "encoding": encoding, **ends})
        payload += data + bytes(-len(data) % ALIGNMENT)
    about = {"base": base, "count": len(part.scene), "payloadBytes": len(payload), "properties": entries}
    return _headed(b"RADC", dict(facts) | about) + struct.pack("<Q", len(payload)) + payload


def _properties(tree: Tree, spans: Mapping[str, float]) -> dict[str, tuple[str, Tensor]]:
    """Encoding and values of each property, by name."""
    scene, half, quats = tree.scene, torch.float16, tree.scene.unit_quats
    upper = quats[:, 1:] * torch.where(quats[:, :1] < 0, -1, 1)  # w is the rest
    properties = {
        "center": ("f32_lebytes", scene.means.float().t().flatten().view(torch.uint8).view(-1, 4)),  # the lowest first
        "alpha": ("f16", scene.opacities.to(half)),
        "rgb": ("f16", scene.base_colours.to(half)),
        "scales": ("ln_f16", scene.log_scales.to(half)),
        "orientation": ("f32", upper.float()),
    }
    for band, coefficients in enumerate(BANDS, 1):
        if (span := spans.get(f"sh{band}Max")) is not None:
            values = (scene.sh[:, coefficients].flatten(1) * (MAX_S8 / span)).round().clamp(-MAX_S8, MAX_S8)
            properties[f"sh{band}"] = "s8", values.to(torch.int8)
    properties["child_count"] = "u16", tree.counts.to(torch.uint16)
    properties["child_start"] = "u32", tree.starts.to(torch.uint32)
    return properties


def _headed(magic: bytes, header: Mapping[str, Any]) -> bytes:
    text = json.dumps(header).encode()
    return magic + struct.pack("<I", len(text)) + text + bytes(-len(text) % ALIGNMENT)
