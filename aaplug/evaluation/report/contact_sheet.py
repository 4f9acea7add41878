"""A grid of images of different sizes, all shown at one height, so that the pixels of small ones are visible.

Images are [h, w, 3] in [0, 1].  Labels must be ASCII, the only characters of OpenCV's built-in font.
"""

from collections.abc import Sequence
from itertools import accumulate

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.imaging import levels

CELL_HEIGHT = 320  # px
GAP = 12  # px
HEADING = 36  # px: height of a line of text
INK = (40, 40, 40)
LIGHT_INK = (245, 245, 245)
FRAME, FRAME_INK = 2, (128, 128, 128)  # px: edge of an inset
MIN_INSET = 64  # px
ERROR_FULL = 32  # levels of 255 at the end of the error scale, as on the report's page
HEAT = ((0, 0, 4), (86, 16, 110), (187, 55, 84), (249, 140, 10), (252, 255, 164))  # colours of the error scale
BYTE = 255


def contact_sheet(
    columns: Sequence[str], rows: Sequence[tuple[str, Sequence[Float[Tensor, "_ _ 3"]]]]
) -> Float[Tensor, "H W 3"]:
    """Images with a heading over every column and a label left of every row; widths are those of the first row."""
    cells = [[_enlarged(image) for image in images] for _, images in rows]
    widths = [cell.shape[1] for cell in cells[0]]
    margin = max(_text_width(label) for label, _ in rows) + 2 * GAP
    *lefts, width = accumulate((w + GAP for w in widths), initial=margin)
    sheet = np.full((HEADING + len(rows) * (CELL_HEIGHT + GAP), width, 3), 255, dtype=np.uint8)
    for left, heading in zip(lefts, columns, strict=True):
        _write(sheet, heading, left, HEADING - GAP)
    for r, ((label, _), images) in enumerate(zip(rows, cells, strict=True)):
        top = HEADING + r * (CELL_HEIGHT + GAP)
        _write(sheet, label, GAP, top + CELL_HEIGHT // 2)
        for left, room, image in zip(lefts, widths, images, strict=True):
            part = image[:, :room]
            sheet[top : top + CELL_HEIGHT, left : left + part.shape[1]] = part
    return torch.from_numpy(sheet).float() / BYTE


def error_map(image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w 3"]:
    """The worst channel's difference at each pixel as a colour, from black to yellow at `ERROR_FULL` levels."""
    error = (levels(image, 8) - levels(truth, 8)).abs().amax(dim=2).cpu().numpy()
    stops, shades = np.linspace(0, ERROR_FULL, len(HEAT)), np.array(HEAT) / BYTE
    return torch.from_numpy(np.stack([np.interp(error, stops, shade) for shade in shades.T], axis=2)).float()


def labelled(image: Float[Tensor, "h w 3"], label: str) -> Float[Tensor, "h w 3"]:
    """A copy of the image with a label on a dark strip in its top left corner."""
    pixels = _bytes(image)
    _write_on_strip(pixels, label, 0, 0)
    return torch.from_numpy(pixels).float() / BYTE


def magnified(image: Float[Tensor, "h w 3"], part: float, label: str) -> Float[Tensor, "h w 3"]:
    """A copy of the image with its middle enlarged in the bottom right corner, each pixel to a sharp square.

    part: share of the image that is of interest, in the middle, along each side.  The inset stays outside of it and
        shows half of it along each side, or a little more; without room for `MIN_INSET` px there is none.
    label: stands above the inset; {times} in it becomes the enlargement.
    """
    pixels = _bytes(image)
    height, width, _ = pixels.shape
    room = int((1 - part) / 2 * min(height, width)) - FRAME
    times = int((1 - part) / part)
    if times > 1 and room >= MIN_INSET:
        side = room // times
        top, left = (height - side) // 2, (width - side) // 2
        inset = pixels[top : top + side, left : left + side].repeat(times, axis=0).repeat(times, axis=1)
        y, x = height - len(inset), width - len(inset)
        pixels[y - FRAME :, x - FRAME :] = FRAME_INK
        pixels[y:, x:] = inset
        words = label.format(times=times)
        _write_on_strip(pixels, words, max(0, width - _text_width(words) - 2 * GAP), y - FRAME - HEADING)
    return torch.from_numpy(pixels).float() / BYTE


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


def _text_width(text: str) -> int:
    return cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.6, 1)[0][0]


def _write(sheet: np.ndarray, text: str, left: int, bottom: int, ink: tuple[int, int, int] = INK) -> None:
    cv2.putText(sheet, text, (left, bottom), cv2.FONT_HERSHEY_SIMPLEX, 0.6, ink, 1, cv2.LINE_AA)
