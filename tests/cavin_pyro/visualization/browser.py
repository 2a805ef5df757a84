"""Chromium without a screen, driven by its DevTools protocol."""

from __future__ import annotations

import base64
import itertools
import json
import os
import shutil
import signal
import subprocess
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

CHROMIUM = shutil.which("chromium")
FLAGS = "--headless=new --no-sandbox --use-gl=angle --use-angle=swiftshader --enable-unsafe-swiftshader "
FLAGS += "--window-size=800,500 --remote-debugging-port=0 --remote-allow-origins=*"


class Page:
    """A page of the browser, by its websocket."""

    def __init__(self, socket: Any) -> None:
        self._socket, self._numbers = socket, itertools.count()

    def call(self, method: str, **given: Any) -> Any:
        number = next(self._numbers)
        self._socket.send(json.dumps({"id": number, "method": method, "params": given}))
        while (answer := json.loads(self._socket.recv(timeout=120))).get("id") != number:
            pass
        return answer["result"]

    def picture(self) -> bytes:
        # Without what says that there is no graphics card.
        self.call("Runtime.evaluate", expression="document.querySelector('.mantine-Notification-root')?.remove()")
        return base64.b64decode(self.call("Page.captureScreenshot")["data"])

    def drag(self, *ways: tuple[float, float]) -> None:
        """With the left button along points, in pixels; over one point, a click."""
        kinds = ["mouseMoved", "mousePressed", *["mouseMoved"] * (len(ways) - 1), "mouseReleased"]
        for kind, (x, y) in zip(kinds, [ways[0], *ways, ways[-1]], strict=True):
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=1, clickCount=1)


@contextmanager
def opened(address: str, folder: Path) -> Iterator[Page]:
    """A page at an address, with the browser's profile in a folder."""
    from websockets.sync.client import connect

    line = [str(CHROMIUM), *FLAGS.split(), f"--user-data-dir={folder}", address]
    with subprocess.Popen(line, stderr=subprocess.PIPE, text=True, start_new_session=True) as browser:
        try:
            said = next(line for line in browser.stderr if "DevTools listening on" in line)
            pages = json.load(urllib.request.urlopen(f"http://{said.split('ws://')[1].split('/')[0]}/json"))
            page = next(one for one in pages if one["type"] == "page")
            with connect(page["webSocketDebuggerUrl"], max_size=None) as socket:
                yield Page(socket)
        finally:
            os.killpg(browser.pid, signal.SIGKILL)  # with the processes that it has started
