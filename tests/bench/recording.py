"""The recording above README, captured from the live page: python -m tests.bench.recording [-o PATH].

Headless Chromium shows the bundled sample at 1/8 of its training size, enlarged.  The camera turns and the divider goes
to and fro; each frame is a screenshot of the page at rest.
"""

import argparse
import io
import math

from PIL import Image
from playwright.sync_api import Page, ViewportSize, sync_playwright

from aaplug.verbs.view import serving

WINDOW = (960, 540)  # px
FRAMES, MILLISECONDS = 72, 90  # of a frame
VIEW = "r_32"  # in which the capture begins
TURN = 260  # px, how far the scene is dragged
SWEEP = 0.28  # of the width, how far the divider goes to either side
QUALITY = 72  # of the WebP file
CHROMIUM = "/usr/bin/chromium"


def rested(page: Page) -> None:
    """Wait for the newest picture, complete."""
    page.wait_for_function(
        "(({stage, asked, id}) => stage === 'done' && asked === id)(document.querySelector('#picture').dataset)"
    )


def captured(page: Page) -> list[Image.Image]:
    """The frames."""
    page.select_option("#view", label=VIEW)
    page.locator("#scales input").first.check(force=True)
    box = page.locator("#picture").bounding_box()
    assert box is not None
    left, top = box["x"] + box["width"] / 2 - TURN / 2, box["y"] + 60
    page.mouse.move(left, top)
    page.mouse.down()
    found = []
    for frame in range(FRAMES):
        phase = 2 * math.pi * frame / FRAMES
        page.mouse.move(left + TURN * (1 - math.cos(phase)) / 2, top)
        page.fill("#split", str(round(200 * (0.5 + SWEEP * math.sin(phase))) / 2))
        rested(page)
        found.append(Image.open(io.BytesIO(page.screenshot())).convert("RGB"))
    page.mouse.up()
    return found


def main() -> None:
    """Capture and write."""
    parser = argparse.ArgumentParser()
    parser.add_argument("-o", "--output", default="examples/guides/pictures/view.webp")
    output = parser.parse_args().output
    with serving(port=0, no_browser=True) as address, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        size: ViewportSize = {"width": WINDOW[0], "height": WINDOW[1]}
        page = browser.new_context(viewport=size, bypass_csp=True).new_page()  # playwright's waiting evaluates strings
        page.goto(address)
        rested(page)
        first, *others = captured(page)
    first.save(output, save_all=True, append_images=others, duration=MILLISECONDS, loop=0, quality=QUALITY, method=6)


if __name__ == "__main__":
    main()
