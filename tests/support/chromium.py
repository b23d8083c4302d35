"""The browser of the tests that open a report, driven over its debugging pipe."""

import base64
import json
import os
import shutil
import subprocess
import time
from pathlib import Path
from typing import Any

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
"""Path of Chromium, or None."""


class Browser:
    """Headless Chromium with one page open. Messages of the page's console, and its errors, are collected.

    Attributes:
        console: The messages so far.
    """

    def __init__(self, profile, *, width=1200, height=1800, dark=False):
        """Starts it with an empty page; ``profile`` is a folder for its files."""
        to_browser, own_out = os.pipe()
        own_in, from_browser = os.pipe()
        self._out, self._in = os.fdopen(own_out, "wb", 0), os.fdopen(own_in, "rb", 0)
        command = [
            CHROMIUM, "--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--use-gl=angle",
            "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--hide-scrollbars", "--no-first-run",
            f"--user-data-dir={profile}", "--remote-debugging-pipe", "about:blank",
        ]  # fmt: skip
        # Chromium reads from descriptor 3 and writes to 4.
        script = f'exec "$@" 3<&{to_browser} 4>&{from_browser}'
        self._process = subprocess.Popen(
            ["bash", "-c", script, "chromium", *command],
            pass_fds=(to_browser, from_browser), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        os.close(to_browser)
        os.close(from_browser)
        self.console: list[str] = []
        self._number, self._waiting, self._session = 0, b"", None
        targets = self.call("Target.getTargets")["targetInfos"]
        target = next(target["targetId"] for target in targets if target["type"] == "page")
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log"):
            self.call(f"{domain}.enable")
        self.resize(width, height)
        if dark:
            features = [{"name": "prefers-color-scheme", "value": "dark"}]
            self.call("Emulation.setEmulatedMedia", features=features)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._session = None
        self.call("Browser.close")
        self._process.wait(20)
        self._out.close()
        self._in.close()

    def call(self, method: str, **parameters) -> dict:
        """Calls a method of the debugging protocol and returns its result."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        self._out.write(json.dumps(message).encode() + b"\0")
        while True:
            while b"\0" not in self._waiting:
                data = self._in.read(1 << 20)
                if not data:
                    raise RuntimeError("Chromium has ended")
                self._waiting += data
            text, _, self._waiting = self._waiting.partition(b"\0")
            answer = json.loads(text)
            if answer.get("id") == self._number:
                if "error" in answer:
                    raise RuntimeError(answer["error"]["message"])
                return answer["result"]
            self._collect(answer)

    def _collect(self, event):
        parameters = event.get("params", {})
        if event.get("method") == "Runtime.consoleAPICalled":
            self.console.append(" ".join(str(argument.get("value")) for argument in parameters["args"]))
        elif event.get("method") == "Runtime.exceptionThrown":
            details = parameters["exceptionDetails"]
            self.console.append(details.get("exception", {}).get("description") or details["text"])
        elif event.get("method") == "Log.entryAdded":
            self.console.append(parameters["entry"]["text"])

    def resize(self, width: int, height: int) -> None:
        """Sets the size of the window [pixels]; one below 800 is a phone's."""
        self.call(
            "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=width < 800
        )

    def open(self, page: Path, fragment: str = "") -> float:
        """Opens a page and waits until it is ready. Returns how long it took [s]."""
        self.call("Page.navigate", url="about:blank")  # a new fragment alone would not load the page anew
        start = time.perf_counter()
        self.call("Page.navigate", url=page.resolve().as_uri() + fragment)
        self.wait("document.body?.dataset.state === 'ready'")
        return time.perf_counter() - start

    def value(self, expression: str) -> Any:
        """Returns the value of an expression in the page; of a promise, what it becomes."""
        found = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        if "exceptionDetails" in found:
            raise RuntimeError(found["exceptionDetails"]["exception"]["description"])
        return found["result"].get("value")

    def wait(self, expression: str, seconds: float = 60.0) -> None:
        """Waits until an expression is true."""
        end = time.perf_counter() + seconds
        while not self.value(expression):
            if time.perf_counter() > end:
                raise TimeoutError(f"{expression} did not become true; console: {self.console}")
            time.sleep(0.02)

    def box(self, selector: str) -> list[float]:
        """Returns the left, top, right and bottom of an element in the window [pixels]."""
        return self.value(
            f"(({{left, top, right, bottom}}) => [left, top, right, bottom])"
            f"(document.querySelector({json.dumps(selector)}).getBoundingClientRect())"
        )

    def click(self, selector: str, number: int = 0) -> None:
        """Clicks in the middle of an element, one of those that a selector selects."""
        element = f"document.querySelectorAll({json.dumps(selector)})[{number}]"
        # It is clicked once it stays where it is for two frames, with nothing above it: what listens to scrolling has
        # done so then, and what the last click opened has its place.
        x, y = self.value(
            f"(async () => {{ {element}.scrollIntoView({{block: 'center'}});"
            "let at = [], still = 0;"
            "for (let i = 0; i < 60 && still < 2; i += 1) {"
            "  await new Promise(requestAnimationFrame);"
            f"  const element = {element}, box = element.getBoundingClientRect();"  # rows are made anew as it scrolls
            "  const now = [box.left + box.width / 2, box.top + box.height / 2];"
            "  const top = document.elementFromPoint(...now);"
            "  const isOnTop = top && (element.contains(top) || top.contains(element));"
            "  still = isOnTop && now[0] === at[0] && now[1] === at[1] ? still + 1 : 0; at = now;"
            "}"
            "return at; })()"
        )
        for kind in ("mousePressed", "mouseReleased"):
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def press(self, key: str) -> None:
        """Presses a key, such as ``"ArrowLeft"`` or ``"f"``."""
        text = {"text": key} if len(key) == 1 else {}
        codes = {"ArrowLeft": 37, "ArrowUp": 38, "ArrowRight": 39, "ArrowDown": 40, "Home": 36, "End": 35}
        self.call("Input.dispatchKeyEvent", type="keyDown", key=key, windowsVirtualKeyCode=codes.get(key, 0), **text)
        self.call("Input.dispatchKeyEvent", type="keyUp", key=key, windowsVirtualKeyCode=codes.get(key, 0))

    def type(self, text: str) -> None:
        """Types a text where the focus is."""
        self.call("Input.insertText", text=text)

    def screenshot(self, path: Path, *, whole: bool = True) -> None:
        """Saves a picture of the page, the whole of it or what is in the window."""
        picture = self.call("Page.captureScreenshot", captureBeyondViewport=whole)["data"]
        Path(path).write_bytes(base64.b64decode(picture))
