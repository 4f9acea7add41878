"""Damaged and hostile files end as what they hold or in one of our errors, quickly, in little memory.

Some files of each reader run here; `python -m tests.bench campaign` runs as many as one asks for.
"""

import io
import sys
import zipfile
import zlib
from collections.abc import Callable

import pytest

from tests.bench.campaign import cameras, damaged, others, paths, scenes
from tests.hostile import check

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="limits are Linux's")
TARGETS = {**scenes(), **cameras(), **paths(), **others()}
FILES = 50  # of each reader
USD_FILES = 5  # each is read in a process of its own


@pytest.mark.parametrize("name", [name for name in TARGETS if name != "scene of usd"])  # it is read as .usdc is
def test_damage_does_no_harm(name: str):
    files = USD_FILES if name.startswith("scene of usd") else FILES
    assert damaged(name, TARGETS[name], files, seed=0)["refused"] > 0


def gzip_of(start: bytes, zeros: int) -> bytes:
    squeeze = zlib.compressobj(9, wbits=31)
    body = b"".join(squeeze.compress(bytes(1 << 20)) for _ in range(zeros >> 20))
    return squeeze.compress(start) + body + squeeze.flush()


def zip_of(name: str, size: int) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(name, bytes(size))
    return stream.getvalue()


PLY = b"ply\nformat binary_little_endian 1.0\n"
TEXT = b"ply\nformat ascii 1.0\n"
SPZ = b"NGSP\x03\0\0\0%b\0\x0c\0\0"
BOMBS: dict[str, tuple[str, Callable[[], bytes]]] = {
    "100 kB for 100 MB": ("a.spz", lambda: gzip_of(SPZ % b"\x01\0\0\0", 100 << 20)),
    "100 MB as promised": ("a.spz", lambda: gzip_of(SPZ % b"\0\0\x56\0", 100 << 20)),
    "4e9 points": ("a.spz", lambda: gzip_of(SPZ % b"\xff\xff\xff\xff", 0)),
    "zip": ("a.sog", lambda: zip_of("meta.json", 60 << 20)),
    "checkpoint": ("a.pt", lambda: zip_of("archive/data.pkl", 60 << 20)),
    "count 1e12": ("a.ply", lambda: PLY + b"element vertex 1000000000000\nproperty float x\nend_header\n"),
    "text of 1e12": ("a.ply", lambda: TEXT + b"element vertex 1000000000000\nproperty float x\nend_header\n0\n"),
    "list of 4e9": ("a.ply", lambda: PLY + b"element face 1\nproperty list uint float v\nend_header\n\xff\xff\xff\xff"),
    "64 MiB header": ("a.ply", lambda: PLY + b"comment " + b"a" * (64 << 20)),
    "deep JSON": ("meta.json", lambda: b'{"a":' * 100_000),
}  # fmt: skip


@pytest.mark.parametrize("bomb", BOMBS)
def test_bombs_are_duds(bomb: str):
    name, content = BOMBS[bomb]
    assert check(name, [content()]) == {"refused": 1}
