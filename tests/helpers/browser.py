"""Headless Chromium for the tests of pages, by Debian's packages chromium and chromium-driver."""

from __future__ import annotations

import io
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

SIZE = (720, 440)
TRIES, PAUSE = 6, 0.4  # [s]
BROWSER, DRIVER = shutil.which("chromium"), shutil.which("chromedriver")
needs_browser = pytest.mark.skipif(
    BROWSER is None or DRIVER is None, reason="no browser: apt-get install chromium chromium-driver"
)
FLAGS = (
    "--headless=new", "--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--hide-scrollbars", "--enable-unsafe-swiftshader",
    "--use-angle=swiftshader", "--disable-dev-shm-usage", f"--window-size={SIZE[0]},{SIZE[1]}",
    "--disable-features=BackForwardCache",  # a page that was left would stay connected
)  # fmt: skip
UNHURRIED = """
(function () {
  const contexts = [], getContext = HTMLCanvasElement.prototype.getContext;
  HTMLCanvasElement.prototype.getContext = function (kind, attributes) {
    if (!kind.startsWith("webgl")) return getContext.call(this, kind, attributes);
    const context = getContext.call(this, kind, Object.assign({}, attributes, {antialias: false}));
    if (context && !contexts.includes(context)) contexts.push(context);
    return context;
  };
  const request = window.requestAnimationFrame.bind(window), pixel = new Uint8Array(4);
  window.requestAnimationFrame = (callback) => setTimeout(() => request((time) => {
    callback(time);
    for (const one of contexts) one.readPixels(0, 0, 1, 1, one.RGBA, one.UNSIGNED_BYTE, pixel);
  }), 200);
})();
"""
"""Each frame waits until the one before is drawn: without a graphics card, a page on a busy machine would ask for
frames faster than they can be drawn, and a picture of it would wait behind all of them."""
BUTTON = "//button[.//*[text()='{0}'] or text()='{0}']"
HARMLESS = ("GPU stall due to ReadPixels", "favicon")


@contextmanager
def browser() -> Iterator[Any]:
    """A browser without a window."""
    from selenium import webdriver

    options = webdriver.ChromeOptions()
    options.binary_location = str(BROWSER)
    for flag in FLAGS:
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(options, webdriver.ChromeService(str(DRIVER)))
    try:
        driver.set_window_size(*SIZE)
        driver.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": UNHURRIED})
        yield driver
    finally:
        driver.quit()


def until(condition: Callable[[], Any], what: str, seconds: float = 240.0) -> Any:
    """Wait until a condition holds, and return what it gave; a browser that is busy is asked again."""
    from selenium.common.exceptions import TimeoutException

    end = time.monotonic() + seconds
    while time.monotonic() < end:
        try:
            found = condition()
        except TimeoutException:
            found = None
        if found is not None and found is not False and np.size(found):
            return found
        time.sleep(PAUSE)
    raise AssertionError(f"not within {seconds:g} s: {what}")


def press(driver: Any, label: str) -> None:
    """Press a button; while the page moves, another element may lie over it, or it may be made anew."""
    from selenium.common.exceptions import ElementClickInterceptedException, StaleElementReferenceException

    def is_pressed() -> bool:
        for button in driver.find_elements("xpath", BUTTON.format(label)):
            driver.execute_script("arguments[0].scrollIntoView({block: 'center'})", button)
            try:
                button.click()
            except (ElementClickInterceptedException, StaleElementReferenceException):
                return False
            return True
        return False

    until(is_pressed, f"a button {label!r} to press")


def picture(driver: Any) -> NDArray[np.int64]:
    """What the browser shows, shape (height, width, 3); on a busy machine it may need several tries."""
    from selenium.common.exceptions import TimeoutException

    for k in range(TRIES):
        try:
            content = driver.get_screenshot_as_png()
            break
        except TimeoutException:
            if k == TRIES - 1:
                raise
    image = Image.open(io.BytesIO(content)).convert("RGB")
    return np.asarray(image, int)


def errors(driver: Any) -> list[str]:
    """What the browser's console says of errors since it was last asked."""
    log = driver.get_log("browser")
    return [
        row["message"] for row in log if row["level"] == "SEVERE" and not any(h in row["message"] for h in HARMLESS)
    ]


def address(page: Path) -> str:
    """The address of a file."""
    return page.resolve().as_uri()
