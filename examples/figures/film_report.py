"""Films the page of a replay while it is used: a click on the timeline, a turn of the view, a pair alone, a filter.

    warp-bsc replay assets/dancer.usd --report dancer.html
    python examples/figures/film_report.py dancer.html report.webp

Needs Chromium and Pillow.
"""

import io
import sys
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

sys.path += [str(Path(__file__).parents[2] / "tests" / "support"), str(Path(__file__).parent)]
import film
from chromium import Browser

_SIZE = 880, 780
_POINTER = np.array([[0, 0], [0, 17], [4, 13], [7, 20], [10, 19], [7, 12], [12, 12]])


class Visitor:
    """Uses a page with a pointer, and takes pictures on the way.

    Attributes:
        pictures: The pictures so far.
    """

    def __init__(self, browser, work):
        self.pictures = []
        self._browser, self._shot = browser, work / "shot.png"
        self._at, self._scroll = np.array([640.0, 300.0]), 0.0

    def look(self, frames=1):
        """Takes a picture, which is shown for some frames."""
        self._browser.value("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
        self._browser.screenshot(self._shot, whole=False)
        picture = Image.open(io.BytesIO(self._shot.read_bytes())).convert("RGB")
        finer = 4
        mask = Image.new("L", [finer * side for side in picture.size])
        ImageDraw.Draw(mask).polygon([tuple(finer * (self._at + corner)) for corner in _POINTER], fill=255)
        mask = mask.resize(picture.size, Image.Resampling.BOX)
        picture.paste("white", mask=mask.point(lambda value: 255 * (value > 0)))
        picture.paste("black", mask=mask)
        self.pictures += [picture] * frames

    def scroll(self, selector, above, steps=5):
        """Scrolls until an element is so far below the top of the window [pixels]."""
        start, end = self._scroll, self._scroll + self._browser.box(selector)[1] - above
        for share in _eased(steps):
            self._scroll = start + share * (end - start)
            self._browser.value(f"window.scrollTo(0, {self._scroll})")
            self._scroll = self._browser.value("window.scrollY")
            self.look()

    def point(self, selector, number=0, steps=5):
        """Moves the pointer to an element, one of those that a selector selects."""
        element = f"document.querySelectorAll({selector!r})[{number}].getBoundingClientRect()"
        left, top, width, height = self._browser.value(
            f"(({{x, y, width, height}}) => [x, y, width, height])({element})"
        )
        self._move(np.array([left + 0.5 * width, top + 0.5 * height]), steps)

    def press(self, *, down=True, up=True):
        """Presses the button of the mouse, releases it, or both."""
        for kind in ["mousePressed"] * down + ["mouseReleased"] * up:
            self._send(kind, button="left", clickCount=1)

    def drag(self, by, steps=12):
        """Drags the mouse by so many pixels."""
        self.press(up=False)
        self._move(self._at + by, steps)
        self.press(down=False)

    def type(self, text):
        """Types a text, letter by letter."""
        for letter in text:
            self._browser.type(letter)
            self.look(2)

    def _move(self, end, steps):
        start = self._at
        for share in _eased(steps):
            self._at = start + share * (end - start)
            self._send("mouseMoved")
            self.look()

    def _send(self, kind, **more):
        self._browser.call("Input.dispatchMouseEvent", type=kind, x=self._at[0], y=self._at[1], **more)


def _eased(steps):
    """Returns shares of a way that begins and ends slowly."""
    return 0.5 - 0.5 * np.cos(np.pi * np.arange(1, steps + 1) / steps)


def visit(visitor):
    """Uses the page."""
    visitor.look(12)
    visitor.scroll("#timeline", 20)
    visitor.point("#intervals .hover", 3)
    visitor.press()
    visitor.look(8)
    visitor.point("#intervals .hover", 33)
    visitor.press()
    visitor.look(8)
    visitor.point("#canvas")
    visitor.drag(np.array([260.0, -40.0]))
    visitor.look(4)
    visitor.scroll("#canvas", -150)
    visitor.point("#pairs td button")  # isolates
    visitor.press()
    visitor.look(12)
    visitor.scroll("#findings", 130)
    visitor.point("#filter")
    visitor.press()
    visitor.type("edge 140-")
    visitor.look(16)


def make(page):
    """Returns the film of a page."""
    with tempfile.TemporaryDirectory() as work, Browser(work, width=_SIZE[0], height=_SIZE[1]) as browser:
        browser.open(Path(page))
        visitor = Visitor(browser, Path(work))
        visit(visitor)
    return film.Film(len(visitor.pictures), visitor.pictures.__getitem__, duration=110, pause=1500, quality=75)


def main():
    """Reads the command line, and films."""
    film.main(__doc__, make, page="Page that warp-bsc replay --report wrote.")


if __name__ == "__main__":
    main()
