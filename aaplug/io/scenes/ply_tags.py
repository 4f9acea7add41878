"""What a .ply header's comments and columns say about how a scene was trained and what has been fused into it.

Sources, strongest first:
    comment aaplug [fused=<method>] key=value ... [convention=<name>]   aaplug's own record
    a vertex column filter_3D                                           Mip-Splatting, not yet fused
    two scales, or comment SplatRenderMode: 2dgs                        2D Gaussians, treated as classic
    comment SplatRenderMode: mip | antialiased | default                Brush, splat-transform
    comment antialiased 1 | 0                                           Postshot
Of several comments of a kind the last one counts.  Viewers know only SplatRenderMode; aaplug's record tells a kernel of
0.1 px² from one of 0.3 px².

Functions raise FormatError for a file that breaks its format.
"""

import re
from dataclasses import dataclass

from aaplug.core.errors import FormatError
from aaplug.core.gaussians import ANTIALIASED, CLASSIC, CONVENTIONS, MIP, Convention, Fusion
from aaplug.io.scenes.ply_header import Header
from aaplug.io.scenes.scene_file import FILTER_COLUMN

RECORD = re.compile(r"aaplug\s+(?=fused=|convention=)(.*)")
RENDER_MODE = re.compile(r"SplatRenderMode\s*:\s*(\S*)", re.IGNORECASE)
POSTSHOT = re.compile(r"antialiased\s+([01])\s*", re.IGNORECASE)
MIP_TAG = "SplatRenderMode: mip"
FLAT = "2dgs"  # the mode of 2D Gaussians
WORD = re.compile(r"[!-~]+")  # printable ASCII without spaces
KEY = re.compile(r"[!-<>-~]+")  # the same without "="

# In Brush, which introduced the tag, "mip" blurs by 0.1 px²; "antialiased" is gsplat's word for 0.3 px²
MODES = {"mip": MIP, "antialiased": ANTIALIASED, "default": CLASSIC}


@dataclass(frozen=True)
class Meaning:
    """What the header says; evidence: its source, for the user."""

    convention: Convention
    evidence: str
    fused: tuple[Fusion, ...]
    flat: bool = False


def meaning(header: Header, compressed: bool = False) -> Meaning:
    """Read the header's tags; `compressed`: the columns are packed and say nothing about scales."""
    records = [_record(header.path, words) for words in _found(header, RECORD)]
    settings = [{k: v for k, v in record.items() if k != "convention"} for record in records if "fused" in record]
    fused = tuple(Fusion(each.pop("fused"), each) for each in settings)
    mode = _last(header, RENDER_MODE)
    two = not compressed and "scale_2" not in header.vertex.names
    flat = two or bool(mode and mode.lower() == FLAT)
    recorded = [record["convention"] for record in records if "convention" in record]
    if recorded:
        if recorded[-1] not in CONVENTIONS:
            known = ", ".join(CONVENTIONS)
            raise FormatError(header.path, f"its aaplug comment has convention={recorded[-1]}; known are {known}")
        convention = CONVENTIONS[recorded[-1]]
        return Meaning(convention, f"aaplug's record in the file: {convention.name}", fused, flat)
    return Meaning(*_from_others(header, mode, two), fused, flat)


def stating(header: Header, read: Header | None, convention: Convention, fused: tuple[Fusion, ...]) -> Header:
    """The header with tags for this convention and these fusions; unchanged if both it and `read` already say so."""
    assert convention in CONVENTIONS.values(), convention
    said = [(m.convention, m.fused) for m in (meaning(each) for each in (header, read) if each)]
    if read and all(each == (convention, fused) for each in said):
        return header
    header = header.without_comments(RECORD.fullmatch)
    if convention.compensated:
        header = header.without_comments(_is_tag).with_comments([MIP_TAG])
    elif _tagged(header).compensated:
        header = header.without_comments(_is_tag)
    header = header.with_comments(_fused_line(fusion, convention) for fusion in fused)
    if meaning(header).convention != convention:  # no common tag says this
        header = header.with_comments([f"aaplug convention={convention.name}"])
    return header


def _from_others(header: Header, mode: str | None, two: bool) -> tuple[Convention, str]:
    postshot = _last(header, POSTSHOT)
    if FILTER_COLUMN in header.vertex.names:
        return MIP, f"column {FILTER_COLUMN} in the file: Mip-Splatting, not yet fused"
    if mode is not None and mode.lower() == FLAT:
        return CLASSIC, f"tag in the file, SplatRenderMode: {mode}: 2D Gaussians, treated as classic"
    if mode is None and two:
        return CLASSIC, "two scales in the file: 2D Gaussians (2DGS), treated as classic"
    if mode is not None and mode.lower() in MODES:
        return MODES[mode.lower()], f"tag in the file: SplatRenderMode: {mode}"
    if mode is not None:
        return CLASSIC, f"tag in the file, SplatRenderMode: {mode}, is unknown: assumed classic"
    if postshot is not None:
        return (ANTIALIASED if postshot == "1" else CLASSIC), f"tag in the file: antialiased {postshot}"
    return CLASSIC, "no tag in the file: assumed classic (3DGS default)"


def _tagged(header: Header) -> Convention:
    """What the viewers' tags alone say."""
    mode, postshot = _last(header, RENDER_MODE), _last(header, POSTSHOT)
    if mode is not None:
        return MODES.get(mode.lower(), CLASSIC)
    return ANTIALIASED if postshot == "1" else CLASSIC


def _is_tag(comment: str) -> bool:
    return bool(RENDER_MODE.fullmatch(comment) or POSTSHOT.fullmatch(comment))


def _found(header: Header, pattern: re.Pattern[str]) -> list[str]:
    return [m[1] for comment in header.comments if (m := pattern.fullmatch(comment))]


def _last(header: Header, pattern: re.Pattern[str]) -> str | None:
    return (_found(header, pattern) or [None])[-1]


def _record(path: str, words: str) -> dict[str, str]:
    pairs = [word.partition("=") for word in words.split()]
    for key, _, value in pairs:
        if not (KEY.fullmatch(key) and WORD.fullmatch(value)):
            raise FormatError(path, f"comment {'aaplug ' + words!r} is damaged: expected key=value pairs")
    return {key: value for key, _, value in pairs}


def _fused_line(fusion: Fusion, convention: Convention) -> str:
    pairs = {"fused": fusion.method, **fusion.settings, "convention": convention.name}
    assert pairs["fused"] == fusion.method, "a setting is called fused"
    for key, value in pairs.items():
        assert KEY.fullmatch(key), key
        assert WORD.fullmatch(value), value
    return "aaplug " + " ".join(f"{key}={value}" for key, value in pairs.items())
