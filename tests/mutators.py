"""Mutations of a file's structure: payloads inside gzip, members of a zip, trees of JSON, lines of text, header words.

Noise of bytes rarely gets past a checksum or a parser; these do.
"""

import gzip
import io
import json
import math
import random
import struct
import warnings
import zipfile
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

HEADER_BYTES = 256
ODD_INTEGERS = (0, 1, -1, 2**31 - 1, 2**31, 2**32 - 1, 2**63)
ODD_NUMBERS = (*ODD_INTEGERS, 10**30, 0.5, 1e-320, 1e308, math.nan, math.inf, -math.inf)
ODD_VALUES = (*ODD_NUMBERS, None, True, "", "..", "a\0b", "x" * 10_000, [], {}, [[]] * 1000)


def structured(data: bytes, seed: int, count: int) -> Iterator[bytes]:
    """Copies of a file, each with one part of its innermost known structure changed."""
    rng = random.Random(seed)
    for _ in range(count):
        yield changed(data, rng)


def changed(data: bytes, rng: random.Random) -> bytes:
    """A copy with one part of its innermost known structure changed."""
    if data.startswith(b"\x1f\x8b"):
        return gzip.compress(changed(gzip.decompress(data), rng), 1)
    if data.startswith(b"PK\3\4"):
        return _changed_zip(data, rng)
    if data.startswith(b"glTF") and rng.random() < 0.7:
        end = 20 + int.from_bytes(data[12:16], "little")
        tree = _changed_tree(json.loads(data[20:end]), rng)
        return data[:12] + struct.pack("<I", len(tree)) + data[16:20] + tree + data[end:]
    with suppress(ValueError):
        return _changed_tree(json.loads(data), rng)
    header, end, body = data.partition(b"end_header\n")
    if end and rng.random() < 0.5:
        return _changed_lines(header, rng) + end + body
    return _changed_lines(data, rng) if data.isascii() and b"\0" not in data else _changed_words(data, rng)


def _changed_zip(data: bytes, rng: random.Random) -> bytes:
    """One member changed, left out, doubled or under another name."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = [(info.filename, archive.read(info), info.compress_type) for info in archive.infolist()]
    at = rng.randrange(len(members))
    name, content, kind = members[at]
    change = rng.randrange(8)
    if change == 0:
        del members[at]
    elif change == 1:
        members.append((name, changed(content, rng), kind))
    elif change == 2:
        members[at] = (rng.choice(members)[0], content, kind)
    elif change == 3:
        members[at] = (f"../{name}", content, kind)
    else:
        members[at] = (name, changed(content, rng), kind)
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive, warnings.catch_warnings(action="ignore"):  # of doubled names
        for name, content, kind in members:
            archive.writestr(zipfile.ZipInfo(name), content, kind)
    return stream.getvalue()


def _changed_tree(document: Any, rng: random.Random) -> bytes:
    """One value of a JSON document replaced, removed, wrapped, moved or doubled."""
    tree = [document]
    node, key = rng.choice(list(_places(tree)))
    change = rng.randrange(8)
    if change == 0 and node is not tree:
        del node[key]
    elif change == 1:
        node[key] = [node[key]]
    elif change == 2:
        other, place = rng.choice(list(_places(tree)))
        node[key] = json.loads(json.dumps(other[place]))
    elif change == 3 and isinstance(node[key], list):
        node[key] = node[key] * 2
    else:
        node[key] = rng.choice(ODD_VALUES)
    return json.dumps(tree[0]).encode()


def _places(node: Any) -> Iterator[tuple[Any, Any]]:
    """Every container under a node with each of its keys or indices."""
    keys = list(node) if isinstance(node, dict) else range(len(node)) if isinstance(node, list) else ()
    for key in keys:
        yield node, key
        yield from _places(node[key])


def _changed_lines(text: bytes, rng: random.Random) -> bytes:
    """One line removed, doubled or moved, or one of its words replaced."""
    lines = text.splitlines(keepends=True) or [b"\n"]
    at, change = rng.randrange(len(lines)), rng.randrange(8)
    line = lines.pop(at)
    if change in (1, 2):
        lines.insert(rng.randrange(len(lines) + 1), line)
        lines[at:at] = [line] * (change == 1)
    elif change > 2:
        words = line.split(b" ")
        words[rng.randrange(len(words))] = str(rng.choice(ODD_VALUES[:-1])).encode()
        lines.insert(at, b" ".join(words).rstrip(b"\n") + b"\n")
    return b"".join(lines)


def _changed_words(data: bytes, rng: random.Random) -> bytes:
    """One aligned word replaced by an odd number, or by its neighbour in value; most often in the header."""
    size = rng.choice((1, 2, 4, 8))
    last = (len(data) if rng.random() < 0.3 else min(len(data), HEADER_BYTES)) // size
    at = size * rng.randrange(max(1, last))
    if size >= 4 and rng.random() < 0.3:
        word = struct.pack("<f" if size == 4 else "<d", min(rng.choice(ODD_NUMBERS), 3e38))
    else:
        value = int.from_bytes(data[at : at + size], "little")
        number = rng.choice((*ODD_INTEGERS, value - 1, value + 1, 2 * value))
        word = (number % 256**size).to_bytes(size, "little")
    return data[:at] + word + data[at + size :]
