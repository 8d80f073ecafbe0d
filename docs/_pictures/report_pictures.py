"""Pictures of a report for the documentation, taken with Chromium.

Run `pano-mvs run quickstart`, then `python -m docs._pictures.report_pictures out/quickstart/report.html`.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from tests.browsers.chromium import Chromium, chromium

IMAGES = Path(__file__).parents[1] / "images"


def shot(browser: Chromium, address: str, section: str, *, width: int, height: int) -> NDArray[np.uint8]:
    """Return a window that shows a section of the page, (H, W, 3) BGR."""
    browser.resize(width, height)
    browser.open(address)
    browser.evaluate(f"document.querySelector('{section}').scrollIntoView({{behavior: 'instant'}}), 0")
    time.sleep(0.5)
    return np.asarray(browser.screenshot()[..., ::-1], np.uint8)


if __name__ == "__main__":
    address = Path(sys.argv[1]).resolve().as_uri()
    with chromium() as browser:
        head = shot(browser, address, "header", width=1200, height=1000)
        browser.command("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": "dark"}])
        cloud = shot(browser, address, "#cloud", width=1000, height=1060)
        browser.command("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": "light"}])
        phones = [shot(browser, address, name, width=400, height=1060) for name in ("#next-time", "#views")]
    gap = np.full((1060, 12, 3), 255, np.uint8)
    sections = np.hstack([cloud, gap, phones[0], gap, phones[1]])
    cv2.imwrite(str(IMAGES / "quickstart_report.jpg"), head, [cv2.IMWRITE_JPEG_QUALITY, 80])
    cv2.imwrite(str(IMAGES / "report_sections.jpg"), sections, [cv2.IMWRITE_JPEG_QUALITY, 78])
