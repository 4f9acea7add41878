"""The formats that rendered views are written in, and what each can hold.

They are plain data and import no torch, so that the command line knows their names at once; `io.layers` writes them.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import PurePath

from aaplug.core.passes import PASSES, NormalAxes
from aaplug.system.errors import UsageError, listing
from aaplug.system.extras import check_installed


@dataclass(frozen=True)
class ImageFormat:
    """A format.

    suffixes: of its files, the usual one first.  passes: that it holds.  bit_depths: per channel, the default first.
    colours: of `COLOURS`, the default first.
    needs: the package that writes it, from aaplug's extra of the format's name; None if that is always there.
    """

    name: str
    suffixes: tuple[str, ...]
    passes: tuple[str, ...]
    bit_depths: tuple[int, ...]
    colours: tuple[str, ...] = ("srgb",)
    needs: str | None = None


# Values of colours, with the name of KHR_gaussian_splatting for each: those that a display takes (IEC 61966-2-1), as
# training has them, and those proportional to light.
COLOURS = {"srgb": "srgb_rec709_display", "linear": "lin_rec709_display"}
IMAGE_FORMATS = {
    "png": ImageFormat("png", (".png",), ("rgb", "alpha"), (8, 16)),
    "jpg": ImageFormat("jpg", (".jpg", ".jpeg"), ("rgb",), (8,)),
    "webp": ImageFormat("webp", (".webp",), ("rgb", "alpha"), (8,)),
    "exr": ImageFormat("exr", (".exr",), tuple(PASSES), (16, 32), ("linear", "srgb"), needs="OpenEXR"),
    "npz": ImageFormat("npz", (".npz",), tuple(PASSES), (32,), ("srgb", "linear")),
}


@dataclass(frozen=True)
class Storage:
    """How rendered views are stored."""

    format: ImageFormat = IMAGE_FORMATS["png"]
    passes: tuple[str, ...] = ("rgb",)
    bit_depth: int = 8
    colour: str = "srgb"
    normal_axes: NormalAxes = "camera"

    @classmethod
    def of(
        cls,
        output: PurePath,
        format: str | None = None,
        passes: Sequence[str] = ("rgb",),
        transparent: bool = False,
        bit_depth: int | None = None,
        colour: str | None = None,
        normal_axes: NormalAxes = "camera",
    ) -> "Storage":
        """The storage that options ask for, by the name of a format or else by the output's.

        transparent: adds alpha to the passes.

        Raises:
            UsageError: the format cannot hold a pass, that many bits or such colours, is not that of the output, or its
                package is not installed; or a choice is of a pass that is left out.
        """
        by_name = next((f.name for f in IMAGE_FORMATS.values() if output.suffix.lower() in f.suffixes), None)
        if format is not None and by_name not in (format, None):
            raise UsageError("format", f"is {format}, but {output.name} is named as a .{by_name}")
        chosen = IMAGE_FORMATS[format or by_name or "png"]
        if chosen.needs is not None:
            check_installed(chosen.needs, chosen.name, "format", f"{chosen.name} needs {chosen.needs}")
        asked = tuple(dict.fromkeys([*passes, *["alpha"] * transparent]))
        if normal_axes != "camera" and "normal" not in asked:
            raise UsageError("normal_axes", "are of the pass normal, which `passes` leaves out")
        if colour is not None and "rgb" not in asked:
            raise UsageError("colour", "is of the pass rgb, which `passes` leaves out")
        for name in asked:
            if name not in chosen.passes:
                holders = listing([f".{each.name}" for each in IMAGE_FORMATS.values() if name in each.passes])
                option = "passes" if name in passes else "transparent"
                raise UsageError(option, f"a .{chosen.name} cannot hold {name}; {holders} can")
        if bit_depth not in (*chosen.bit_depths, None):
            depths = " or ".join(map(str, chosen.bit_depths))
            raise UsageError("bit_depth", f"a .{chosen.name} has {depths} bits per channel, not {bit_depth}")
        if colour not in (*chosen.colours, None):
            holders = listing([f".{each.name}" for each in IMAGE_FORMATS.values() if colour in each.colours])
            raise UsageError("colour", f"a .{chosen.name} has no {colour} colours; {holders} can")
        return cls(chosen, asked, bit_depth or chosen.bit_depths[0], colour or chosen.colours[0], normal_axes)


PNG = Storage()
