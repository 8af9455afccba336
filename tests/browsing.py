"""A headless browser for tests of pages; skipped with a reason where there is none."""

import contextlib
import io
import os
import shutil

import numpy as np
import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
# No sandbox: tests may run as root. The rest keeps it from looking for the network, and makes it
# draw WebGL without a graphics card.
FLAGS = (
    "--no-sandbox",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
)


def program():
    """Path of the browser; `CHROMIUM` in the environment names another one."""
    given = os.environ.get("CHROMIUM")
    return given or next((p for p in map(shutil.which, NAMES) if p), None)


@contextlib.contextmanager
def browser():
    """A browser; every request that leaves this machine fails the test."""
    path = program()
    if path is None:
        pytest.skip(f"no browser: none of {', '.join(NAMES)} is installed, CHROMIUM is not set")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver:
        found = driver.chromium.launch(executable_path=path, args=list(FLAGS))
        try:
            yield found
        finally:
            found.close()


def opened(found, url, size=(1280, 720)):
    """A page, and a list of addresses elsewhere that it asked for."""
    page = found.new_page(viewport={"width": size[0], "height": size[1]})
    outside = []

    def seen(request):
        if not request.url.startswith((url, "data:", "blob:", "file:")):
            outside.append(request.url)

    page.on("request", seen)
    page.goto(url)
    return page, outside


def pixels(page, clip=None):
    """The picture of a page, [h, w, 3]."""
    import PIL.Image

    area = None if clip is None else dict(zip(("x", "y", "width", "height"), clip, strict=True))
    data = page.screenshot(clip=area) if area else page.screenshot()
    return np.asarray(PIL.Image.open(io.BytesIO(data)).convert("RGB")).astype(int)


def wait_for(page, condition, seconds=60.0, what="the condition"):
    """Let the page go on until something holds."""
    import time

    end = time.perf_counter() + seconds
    while time.perf_counter() < end:
        found = condition()
        if found:
            return found
        page.wait_for_timeout(50)
    pytest.fail(f"{what} did not come within {seconds:g} s")
