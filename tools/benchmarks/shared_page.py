"""How soon a shared page shows its first picture, and how often it draws while it is turned.

PAGE is a folder that `pano-mvs share` wrote. In Chromium the first picture of the whole scene is also timed over a line
of 10 Mbit/s with a latency of 40 ms, for the start of the page and for a link into a panorama. The browsers draw in
software. Beside the frames per second stands the
processor time of the browser per frame, which depends less on what else the machine does: with two free cores, 60 ms
allow 30 frames per second.
"""

from __future__ import annotations

import os
import statistics
from pathlib import Path
from typing import Literal

from tests.browsers.browser import Browser, open_browser
from tests.browsers.chromium import Chromium
from tests.browsers.server import served
from tools.benchmarks.table import print_table

_READY = "typeof PanoMvs === 'object' && PanoMvs.page && PanoMvs.page.settled"
_ASKED_FOR = """[...performance.getEntriesByType("navigation"), ...performance.getEntriesByType("resource")]
  .filter(({ startTime }) => startTime < PanoMvs.page.firstPicture)
  .reduce((sum, { encodedBodySize }) => sum + encodedBodySize, 0)"""
# The page adapts within the first second; it is not counted.
_TURN = """new Promise((resolve) => {
  const page = PanoMvs.page, vertical = new THREE.Vector3(0, 1, 0), times = [], end = performance.now() + %d;
  const step = (now) => {
    times.push(now);
    if (page.mode === "inside") page.turn(0.01, 0);
    else {
      page.eye.position.sub(page.orbit.target).applyAxisAngle(vertical, 0.01).add(page.orbit.target);
      page.orbit.update();
    }
    if (now < end) requestAnimationFrame(step);
    else resolve([times.length - 1, times.at(-1) - times[0], page.pace.step]);
  };
  requestAnimationFrame(step);
})"""
_SURFACE = "(PanoMvs.page.showSurface(true), PanoMvs.page.overview(), PanoMvs.page.surfaceShown)"
_POINTS = "(PanoMvs.page.showSurface(false), PanoMvs.page.overview(), PanoMvs.page.cloud.total > 0)"
_INSIDE = "PanoMvs.page.nearest() ? PanoMvs.page.stepInside(PanoMvs.page.nearest(), true).then(() => true) : false"
_VIEWS = {"surface": _SURFACE, "points": _POINTS, "inside": _INSIDE}


def main(
    page: Path, browser: Literal["chromium", "firefox"] = "chromium", seconds: float = 5.0, openings: int = 5
) -> None:
    """Measure a page and print the figures; `seconds` are those of turning per view."""
    with open_browser(browser, width=1280, height=720) as window:
        opened = [_opening_ms(window, page / "index.html") for _ in range(openings)]
        middle, worst = statistics.median(opened), max(opened)
        print(f"first complete picture: median {middle:.0f} ms of {len(opened)}, worst {worst:.0f} ms\n")
        if isinstance(window, Chromium):
            rows = (_slow_line(window, page, link, openings) for link in ("", "#i=0,0,0,80"))
            print_table(["10 Mbit/s, 40 ms", "first picture, s: median", "worst", "MB"], rows)
        shown = (name for name, script in _VIEWS.items() if window.evaluate(f"(async () => {script})()"))
        print_table(
            ["view", "frames/s", "CPU ms/frame", "pace"], ([name, *_turning(window, seconds)] for name in shown)
        )
        print(f"\nload of the machine: {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")


def _opening_ms(browser: Browser, page: Path) -> float:
    browser.open("about:blank")
    browser.open(page.resolve().as_uri())
    browser.wait(_READY)
    return float(browser.evaluate("PanoMvs.page.firstComplete"))


def _slow_line(browser: Chromium, page: Path, link: str, openings: int) -> list[str]:
    """Return what the address ends with, seconds until the first picture, and what was asked for until then in MB."""
    times_ms, sizes = [], []
    with served(page) as server:
        for _ in range(openings):
            browser.open("about:blank")
            browser.throttle(bits_per_s=10e6, latency_ms=40)
            browser.open(server.address + link)
            browser.wait("typeof PanoMvs === 'object' && PanoMvs.page?.firstPicture")
            times_ms.append(browser.evaluate("PanoMvs.page.firstPicture"))
            sizes.append(browser.evaluate(_ASKED_FOR))
        browser.throttle(bits_per_s=1e12, latency_ms=0)
    middle, worst = statistics.median(times_ms) / 1000, max(times_ms) / 1000
    return [link or "start", f"{middle:.1f}", f"{worst:.1f}", f"{max(sizes) / 1e6:.1f}"]


def _turning(browser: Browser, seconds: float) -> list[str]:
    """Return frames per second, processor time per frame, and the step of the page's pace, after it has adapted."""
    browser.wait(_READY)
    browser.evaluate(_TURN % 1500)
    before = _cpu_s(os.getpid())
    frames, took_ms, pace = browser.evaluate(_TURN % (1000 * seconds))
    spent = _cpu_s(os.getpid()) - before
    return [f"{1000 * frames / took_ms:.1f}", f"{1000 * spent / frames:.0f}", f"{pace:.0f}"]


def _cpu_s(process: int) -> float:
    """Return the processor time of all descendants of a process that are alive (Linux)."""
    children: dict[int, list[int]] = {}
    ticks: dict[int, int] = {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            fields = (folder / "stat").read_text().rpartition(")")[2].split()
        except OSError:
            continue  # it has ended
        number = int(folder.name)
        children.setdefault(int(fields[1]), []).append(number)
        ticks[number] = int(fields[11]) + int(fields[12])
    pending, total = list(children.get(process, [])), 0
    while pending:
        number = pending.pop()
        total += ticks[number]
        pending += children.get(number, [])
    return total / os.sysconf("SC_CLK_TCK")
