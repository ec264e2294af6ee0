"""A headless Chromium on two pipes: enough of its DevTools protocol to open a page, ask it and take pictures."""

from __future__ import annotations

import base64
import html
import json
import os
import re
import shutil
import subprocess
import tempfile
import time
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
LIMIT = 30.0  # [s] for one answer
PHONE, DESK = 390, 1280  # [px]
LEAST = 300  # [px] of a figure
NARROW = """[...document.querySelectorAll('body *')].filter(e => !e.closest('.wide')
  && e.getBoundingClientRect().right > document.documentElement.clientWidth + 1).map(e => e.tagName + e.textContent)"""
FIGURES = "[...document.images].map(i => [i.naturalWidth, i.getBoundingClientRect().width])"
ONE_PROCESS = ("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--no-first-run")


def find_chromium() -> str | None:
    """Path of the first browser that can be driven, if there is one."""
    return next((path for name in NAMES if (path := shutil.which(name))), None)


def words_of(page: Path) -> str:
    """A page with its words as they were written: spaces for no-break ones, marks about names in the type of code."""
    return html.unescape(re.sub("</?code>", "`", page.read_text())).replace("\u00a0", " ")


class Browser:
    """One Chromium with one page. Messages are JSON ended by a zero byte, to its descriptor 3 and from its 4."""

    def __init__(self, program: str, *options: str) -> None:
        self.home = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        to_read, self.to = os.pipe()
        self.back, from_write = os.pipe()
        # sh moves the pipes to the descriptors that Chromium expects, from any number that they have here
        script = f'exec "$@" 3<&{to_read} 4>&{from_write}'
        own = (f"--user-data-dir={self.home.name}", "--remote-debugging-pipe", "about:blank")
        command = [program, *ONE_PROCESS, *options, *own]
        self.process = subprocess.Popen(
            ["bash", "-c", script, "bash", *command],
            pass_fds=(to_read, from_write),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(to_read)
        os.close(from_write)
        os.set_blocking(self.back, False)
        self.rest, self.count, self.session = b"", 0, ""
        self.events: list[dict[str, Any]] = []
        target = self.send("Target.createTarget", url="about:blank")["targetId"]
        self.session = self.send("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.send(f"{domain}.enable")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        with suppress(OSError, TimeoutError, KeyError):
            self.session = ""
            self.send("Browser.close")
        with suppress(subprocess.TimeoutExpired):
            self.process.wait(5)
        self.process.kill()
        os.close(self.to)
        os.close(self.back)
        self.home.cleanup()

    def send(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Ask, and wait for the answer."""
        self.count += 1
        message = {"id": self.count, "method": method, "params": parameters}
        if self.session:
            message["sessionId"] = self.session
        os.write(self.to, json.dumps(message).encode() + b"\0")
        end = time.monotonic() + LIMIT
        while True:
            answer = self.read(end)
            if answer.get("id") == self.count:
                if "error" in answer:
                    raise KeyError(f"{method}: {answer['error']['message']}")
                return dict(answer["result"])
            self.events.append(answer)

    def read(self, end: float) -> dict[str, Any]:
        """The next message."""
        while b"\0" not in self.rest:
            if time.monotonic() > end:
                raise TimeoutError("the browser does not answer")
            with suppress(BlockingIOError):
                self.rest += os.read(self.back, 1 << 20)
                continue
            time.sleep(0.002)
        first, self.rest = self.rest.split(b"\0", 1)
        return dict(json.loads(first))

    def open(self, page: Path, width: int, height: int = 844, *, mobile: bool = False) -> None:
        """Show a file in a window of this width [px] and wait until everything is loaded."""
        self.send(
            "Emulation.setDeviceMetricsOverride",
            width=width, height=height, deviceScaleFactor=2 if mobile else 1, mobile=mobile,
        )  # fmt: skip
        self.events.clear()
        self.send("Page.navigate", url=page.resolve().as_uri())
        end = time.monotonic() + LIMIT
        while not any(e.get("method") == "Page.loadEventFired" for e in self.events):
            self.events.append(self.read(end))
        self.ask("Promise.all([...document.images].map(i => i.decode().catch(() => 0))).then(() => 1)")

    def ask(self, script: str) -> Any:
        """Value of a JavaScript expression, awaited."""
        found = self.send("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)
        return found["result"].get("value")

    def complaints(self) -> list[str]:
        """Errors and warnings of the console, exceptions, and requests to anything but the file and its data."""
        found = []
        for event in self.events:
            method, data = event.get("method"), event.get("params", {})
            if method == "Runtime.consoleAPICalled" and data["type"] in ("error", "warning", "assert"):
                found.append(f"console: {data['args']}")
            elif method == "Runtime.exceptionThrown":
                found.append(f"exception: {data['exceptionDetails']['text']}")
            elif method == "Log.entryAdded" and data["entry"]["level"] in ("error", "warning"):
                found.append(f"log: {data['entry']['text']}")
            elif method == "Network.requestWillBeSent" and not data["request"]["url"].startswith(("file:", "data:")):
                found.append(f"request: {data['request']['url']}")
            elif method == "Network.loadingFailed":
                found.append(f"failed: {data['errorText']}")
        return found

    def screenshot(self, path: Path, width: int, *, mobile: bool = False) -> None:
        """The whole page as PNG, in a window as high as the page: what lies far below a lower one is not drawn."""
        height = min(16_000, int(self.ask("document.documentElement.scrollHeight")))
        self.send(
            "Emulation.setDeviceMetricsOverride",
            width=width, height=height, deviceScaleFactor=1, mobile=mobile,
        )  # fmt: skip
        shot = self.send("Page.captureScreenshot", format="png", captureBeyondViewport=True)
        path.write_bytes(base64.b64decode(shot["data"]))

    def pdf(self, path: Path) -> None:
        """The page as it is printed on A4."""
        sheet = self.send("Page.printToPDF", paperWidth=8.27, paperHeight=11.69, preferCSSPageSize=True)
        path.write_bytes(base64.b64decode(sheet["data"]))


def faults(browser: Browser, page: Path, width: int, figures: int) -> list[str]:
    """What is wrong with a page in a window of this width [px], that of a telephone or of a desk."""
    browser.open(page, width, mobile=width == PHONE)
    found = browser.complaints()
    if browser.ask("document.documentElement.scrollWidth") > width:
        found.append("wider than the window")
    found += [f"cut off: {text[:60]}" for text in browser.ask(NARROW)]  # figures and tables may scroll
    shown = browser.ask(FIGURES)
    if len(shown) != figures:
        found.append(f"{len(shown)} figures instead of {figures}")
    return found + [f"a figure {wide} px wide of {own}" for own, wide in shown if not (own > 0 and wide > LEAST)]


def look(page: Path, figures: int) -> list[str]:
    """Faults of a page on a telephone and on a desk; skips the test where no browser is."""
    program = find_chromium()
    if program is None:
        pytest.skip("no Chromium here")
    with Browser(program) as browser:
        return [*faults(browser, page, PHONE, figures), *faults(browser, page, DESK, figures)]
