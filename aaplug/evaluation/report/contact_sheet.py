"""A grid of images of different sizes, all shown at one height, so that the pixels of small ones are visible.

Images are [h, w, 3] in [0, 1].  OpenCV's built-in font has ASCII alone: other signs are spelled by it.
"""

import unicodedata
from collections.abc import Mapping, Sequence
from itertools import accumulate, count

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.cameras import Camera
from aaplug.core.imaging import levels, quantised
from aaplug.evaluation.metrics import PSNR, psnr
from aaplug.evaluation.results import elided, scale_name
from aaplug.evaluation.truth import Truth
from aaplug.rendering.renderer import Renderer

CELL_HEIGHT = 320  # px
GAP = 12  # px
PANE_GAP = 4  # px: between images side by side
HEADING = 36  # px: height of a line of text
INK = (40, 40, 40)
LIGHT_INK = (245, 245, 245)
FRAME, FRAME_INK = 2, (128, 128, 128)  # px: edge of an inset
MIN_ROOM = 2 * HEADING  # px: above what is enlarged, for its own two lines of text
ERROR_FULL = 32  # levels of 255 at the end of the error scale, as on the report's page
HEAT = ((0, 0, 4), (86, 16, 110), (187, 55, 84), (249, 140, 10), (252, 255, 164))  # colours of the error scale
BYTE = 255
SPELLING = str.maketrans({"×": "x", "–": "-", "−": "-", "∞": "inf", "…": "..."})


def contact_sheet(
    columns: Sequence[str], rows: Sequence[tuple[float, Sequence[Float[Tensor, "_ _ 3"]]]], errors: bool = False
) -> Float[Tensor, "H W 3"]:
    """A grid of images: a row a scale, which begins with the truth; below each other image stands its PSNR.

    columns: headings.  rows: the scale and its images; widths are those of the first row.
    errors: show a map of its errors beside each image that is not the truth.
    """
    headings, sheet_rows = [columns[0]], []
    for heading in columns[1:]:
        headings += [heading, "error"] if errors else [heading]
    for scale, (truth, *images) in rows:
        cells = [(truth, "")]
        for image in images:
            decibels = psnr(quantised(image), quantised(truth))
            cells.append((image, "equal" if decibels is None else f"{PSNR.text(decibels)} {PSNR.unit}"))
            cells += [(error_map(image, truth), "")] if errors else []
        height, width, _ = truth.shape
        label = f"{scale_name(scale)}: {width}x{height}"
        sheet_rows.append((label, [(_enlarged(image), caption) for image, caption in cells]))
    widths = [image.shape[1] for image, _ in sheet_rows[0][1]]
    margin = max(_text_width(label) for label, _ in sheet_rows) + 2 * GAP
    *lefts, total = accumulate((w + GAP for w in widths), initial=margin)
    row_height = CELL_HEIGHT + HEADING
    sheet = np.full((HEADING + len(rows) * row_height, total, 3), 255, dtype=np.uint8)
    for left, room, heading in zip(lefts, widths, headings, strict=True):
        _write(sheet, _fitting(heading, room), left, HEADING - GAP)
    for top, (label, cells) in zip(count(HEADING, row_height), sheet_rows, strict=False):
        _write(sheet, label, GAP, top + CELL_HEIGHT // 2)
        for left, room, (image, caption) in zip(lefts, widths, cells, strict=True):
            part = image[:, :room]
            sheet[top : top + CELL_HEIGHT, left : left + part.shape[1]] = part
            if caption:
                _write(sheet, caption, left, top + row_height - GAP)
    return torch.from_numpy(sheet).float() / BYTE


def sheet_of(
    truth: Truth,
    view: Camera,
    scales: Sequence[float],
    renderers: Mapping[str, Renderer],
    heading: str,
    errors: bool = False,
) -> Float[Tensor, "H W 3"]:
    """A view at every scale: the truth under this heading, then each renderer's image by name; see `contact_sheet`."""
    with torch.no_grad():
        rows = [(s, [truth(view, s), *(draw(view.scaled(s)).rgb for draw in renderers.values())]) for s in scales]
    return contact_sheet((heading, *renderers), rows, errors)


def error_map(image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w 3"]:
    """The worst channel's difference at each pixel as a colour, from black to yellow at `ERROR_FULL` levels."""
    error = (levels(image, 8) - levels(truth, 8)).abs().amax(dim=2).cpu().numpy()
    stops, shades = np.linspace(0, ERROR_FULL, len(HEAT)), np.array(HEAT) / BYTE
    return torch.from_numpy(np.stack([np.interp(error, stops, shade) for shade in shades.T], axis=2)).float()


def side_by_side(
    images: Sequence[Float[Tensor, "h _ 3"]], labels: Sequence[str], rate: float = 1.0, sampling: float = 1.0
) -> Float[Tensor, "h w 3"]:
    """Images from left to right, each with its label; a single image stays as it is.

    rate: size of things against the data set's view.  Where it falls, the middle is also shown enlarged in the bottom
        right corner, each pixel as a sharp square.  The inset stays outside of these things, and shows half of them
        along each side, or a little more; without `MIN_ROOM` px around them there is none.
    sampling: the images' sampling rate relative to training, which stands below the label then.
    """
    if len(images) == 1:
        return images[0]
    part, panes = min(1.0, rate), list[np.ndarray]()
    for image, label in zip(images, labels, strict=True):
        pixels = _bytes(image)
        height, width, _ = pixels.shape
        room = int((1 - part) / 2 * min(height, width)) - FRAME
        times = int((1 - part) / part)
        if times > 1 and room >= MIN_ROOM:
            side = room // times
            top, left = (height - side) // 2, (width - side) // 2
            inset = pixels[top : top + side, left : left + side].repeat(times, axis=0).repeat(times, axis=1)
            y, x = height - len(inset), width - len(inset)
            pixels[y - FRAME :, x - FRAME :] = FRAME_INK
            pixels[y:, x:] = inset
            _write_on_strip(pixels, f"{sampling:.2g} of training's sampling, {times}x", 0, HEADING)
        _write_on_strip(pixels, label, 0, 0)
        panes += [np.zeros((height, PANE_GAP, 3), dtype=np.uint8), pixels]
    return torch.from_numpy(np.concatenate(panes[1:], axis=1)).float() / BYTE


def _write_on_strip(pixels: np.ndarray, text: str, left: int, top: int) -> None:
    strip = pixels[top : top + HEADING, left : left + _text_width(text) + 2 * GAP]
    strip[:] = strip // 4
    _write(pixels, text, left + GAP, top + HEADING - GAP, LIGHT_INK)


def _enlarged(image: Float[Tensor, "h w 3"]) -> np.ndarray:
    """8 bits, CELL_HEIGHT px high; pixels of small images stay sharp squares, those of large ones are averaged."""
    pixels = _bytes(image)
    width = max(1, round(pixels.shape[1] * CELL_HEIGHT / pixels.shape[0]))
    kernel = cv2.INTER_NEAREST if pixels.shape[0] < CELL_HEIGHT else cv2.INTER_AREA
    return cv2.resize(pixels, (width, CELL_HEIGHT), interpolation=kernel)


def _bytes(image: Float[Tensor, "h w 3"]) -> np.ndarray:
    return levels(image, 8).byte().cpu().numpy()


def _in_font(text: str) -> str:
    """The text in ASCII: signs spelled, letters without accents, "?" for others."""
    letters = unicodedata.normalize("NFKD", text.translate(SPELLING))
    return "".join(c for c in letters if not unicodedata.combining(c)).encode("ascii", "replace").decode()


def _text_width(text: str) -> int:
    return cv2.getTextSize(_in_font(text), cv2.FONT_HERSHEY_SIMPLEX, 0.6, 1)[0][0]


def _fitting(text: str, room: int) -> str:
    """The text, without its middle where it is wider than so many px."""
    return next((short for n in range(len(text), 1, -1) if _text_width(short := elided(text, n)) <= room), text[:1])


def _write(sheet: np.ndarray, text: str, left: int, bottom: int, ink: tuple[int, int, int] = INK) -> None:
    cv2.putText(sheet, _in_font(text), (left, bottom), cv2.FONT_HERSHEY_SIMPLEX, 0.6, ink, 1, cv2.LINE_AA)
