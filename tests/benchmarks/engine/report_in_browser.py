"""Try a report in a real browser: `python -m tests.benchmarks.engine.report_in_browser OUT/report.html FOLDER`.

Needs Chromium or Chrome. Moves a slider, changes what it shows, turns the pages of the table and searches in it, by the
events that a finger, a mouse or a key cause, at the width of a desk and of a phone; checks that the policy of the page
lets its own script run and that nothing is written to the console; and writes pictures of the page into FOLDER: at the
desk, on the phone, in the dark, and printed (a PDF).
"""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

_BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
_QUIET = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--hide-scrollbars",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)
_PROBE = """<script>
window.addEventListener("load", function () {
  const found = {errors: window.errors, wide: document.documentElement.scrollWidth - window.innerWidth};
  const slider = document.querySelector(".slider");
  if (slider) {
    const stack = slider.parentElement, shown = stack.querySelector(".pane.range");
    const clips = [20, 80].map(function (at) {
      slider.value = String(at);
      slider.dispatchEvent(new Event("input"));
      return getComputedStyle(shown).clipPath;
    });
    const tabs = stack.nextElementSibling;
    tabs.lastElementChild.click();
    found.slider = {tabs: tabs.children.length, clips: clips, label: slider.getAttribute("aria-label"),
      text: slider.getAttribute("aria-valuetext"),
      hidden: getComputedStyle(shown).display, focusable: slider.tabIndex,
      covers: slider.getBoundingClientRect().width - stack.getBoundingClientRect().width};
  }
  const next = document.getElementById("next"), find = document.getElementById("find");
  if (next) {
    const page = function () { return document.getElementById("page").textContent; };
    const pages = [page()];
    next.click();
    pages.push(page());
    find.value = "no such name";
    find.dispatchEvent(new Event("input"));
    pages.push(page());
    found.table = {pages: pages, rows: document.querySelectorAll("#rows tr").length};
  }
  document.title = "PROBE" + JSON.stringify(found);
});
</script>"""


def browse(*options: str) -> subprocess.CompletedProcess[str]:
    """Run a browser without a window and with a profile of its own."""
    browser = next((path for name in _BROWSERS if (path := shutil.which(name))), None)
    if browser is None:
        raise SystemExit(f"none of {', '.join(_BROWSERS)} is installed")
    with TemporaryDirectory() as profile:
        return subprocess.run(
            [browser, *_QUIET, f"--user-data-dir={profile}", *options],
            capture_output=True,
            text=True,
            timeout=120,
            check=False,
        )


def probed(page: Path, folder: Path, *, width: int) -> dict[str, Any]:
    """Return what the page did when it was touched; in a copy, whose policy lets the probe run too."""
    watch = "<script>window.errors = []; window.onerror = function (text) { window.errors.push(text); };</script>"
    text = re.sub(r"<meta http-equiv=[^>]*>", watch, page.read_text(encoding="utf-8"), count=1)
    copy = folder / "probed.html"
    copy.write_text(text.replace("</body>", f"{_PROBE}</body>"), encoding="utf-8")
    frame = folder / "frame.html"  # a browser's window is no narrower than 500 pixels, a frame is
    frame.write_text(
        f"<iframe src='{copy.resolve().as_uri()}' style='width:{width}px;height:900px'></iframe>"
        "<script>setInterval(function () { try { document.title = frames[0].document.title; } "
        "catch (e) {} }, 50);</script>",
        encoding="utf-8",
    )
    dumped = browse("--allow-file-access-from-files", "--virtual-time-budget=8000", "--dump-dom", frame.as_uri())
    found = re.search(r"<title>PROBE(.*?)</title>", dumped.stdout, re.DOTALL)
    for path in (copy, frame):
        path.unlink()
    assert found, "the page did not answer"
    answer: dict[str, Any] = json.loads(found[1].replace("&amp;", "&"))
    return answer


def check(answer: dict[str, Any]) -> None:
    """Raise AssertionError unless the page did what it should."""
    assert answer["errors"] == [], answer["errors"]
    assert answer["wide"] <= 0, f"the page is {answer['wide']} px wider than the window"
    if "slider" in answer:
        slider = answer["slider"]
        assert [clip.split()[-1].rstrip(")") for clip in slider["clips"]] == ["20%", "80%"], slider
        assert slider["tabs"] == 1 or slider["label"].endswith("confidence right of it"), slider
        assert slider["text"] == "80 % panorama"
        assert slider["tabs"] == 1 or slider["hidden"] == "none", slider
        assert (slider["focusable"], slider["covers"]) == (0, 0), slider
    if "table" in answer:
        assert answer["table"]["pages"][2] == "none found"
        assert answer["table"]["rows"] == 0


def pictures(page: Path, folder: Path) -> None:
    """Write pictures of the page at the desk, on the phone, in the dark, and printed."""
    frame = folder / "frame.html"
    frame.write_text(
        f"<body style='margin:0;background:#888'><iframe src='{page.as_uri()}' "
        "style='width:360px;height:8000px;border:0'></iframe></body>",
        encoding="utf-8",
    )
    for name, where, options in (
        ("desk", page, ("--window-size=1200,6000",)),
        ("dark", page, ("--window-size=1200,6000", "--blink-settings=preferredColorScheme=0")),
        ("phone", frame, ("--window-size=500,8000",)),
    ):
        browse(*options, "--virtual-time-budget=4000", f"--screenshot={folder / f'{name}.png'}", where.as_uri())
    browse("--no-pdf-header-footer", f"--print-to-pdf={folder / 'print.pdf'}", page.as_uri())
    frame.unlink()


def main(page: Path, folder: Path) -> None:
    """Check, and write pictures."""
    folder.mkdir(parents=True, exist_ok=True)
    for width in (1200, 360):
        answer = probed(page, folder, width=width)
        print(f"{width} px wide:", json.dumps(answer))
        check(answer)
    dumped = browse("--enable-logging=stderr", "--virtual-time-budget=4000", "--dump-dom", page.as_uri())
    console = [line for line in dumped.stderr.splitlines() if ":CONSOLE" in line]
    assert not console, console
    assert 'class="scripted"' in dumped.stdout, "the page's policy keeps its own script from running"
    pictures(page, folder)
    print(f"pictures are in {folder}: {', '.join(sorted(path.name for path in folder.iterdir()))}")


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve(), Path(sys.argv[2]).resolve())
