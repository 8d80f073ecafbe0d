"""Tours in Pannellum and Marzipano themselves: a link leads to the mark that was painted in its true direction.

`npm install pannellum marzipano`, then `python -m tests.oracles.tour_players node_modules`, which needs Chromium and
chromedriver.
"""

from __future__ import annotations

import functools
import json
import re
import sys
import tempfile
import threading
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import cv2
import numpy as np

from pano_mvs.geometry import pixel_from_ray
from pano_mvs.io.tour_players import (
    Link,
    Scene,
    marzipano_data,
    marzipano_page,
    pannellum_page,
    pannellum_tour,
)
from tests.share.chromium import chromium

SIZE_HW = (1024, 2048)
YAW_DEG, PITCH_DEG = 75.0, 20.0
LOOKS = {
    "pannellum": "window.viewer.getScene() && window.viewer.lookAt({pitch}, {yaw}, 40, false) && 1",
    "marzipano": "scenes.get('scene_0').scene.view().setParameters({{yaw: {yaw}, pitch: {pitch}, fov: 0.7}}) || 1",
}


def marked_panorama() -> np.ndarray:
    """Return a grey panorama with a red mark in the true direction."""
    yaw, pitch = np.deg2rad([YAW_DEG, PITCH_DEG])
    ray = [np.cos(pitch) * np.sin(yaw), -np.sin(pitch), np.cos(pitch) * np.cos(yaw)]
    x, y = pixel_from_ray(ray, SIZE_HW)
    picture = np.full((*SIZE_HW, 3), 128, np.uint8)
    cv2.circle(picture, (int(x), int(y)), 12, (0, 0, 255), -1)
    return picture


def write_tour(folder: Path, modules: Path) -> dict[str, tuple[float, float]]:
    """Write a tour with the libraries beside it, and return yaw and pitch of the link as each player states them."""
    cv2.imwrite(str(folder / "a.png"), marked_panorama())
    scenes = [Scene("a", "a.png", SIZE_HW[1], None, (Link(0, YAW_DEG, PITCH_DEG, 0.0),))]
    tour = pannellum_tour(scenes)
    (folder / "tour.json").write_text(json.dumps(tour))
    page = pannellum_page("tour.json").replace('pannellum.viewer("', 'window.viewer = pannellum.viewer("')
    pages = {"pannellum": page, "marzipano": marzipano_page("marzipano.js")}
    (folder / "marzipano.js").write_text(marzipano_data(scenes))
    (folder / "modules").symlink_to(modules.resolve())
    for name, text in pages.items():
        local = re.sub(r"https://cdn\.jsdelivr\.net/npm/(\w+)@[\d.]+/", r"modules/\1/", text)
        (folder / f"{name}.html").write_text(local)
    spot = tour["scenes"]["scene_0"]["hotSpots"][0]  # type: ignore[index]
    link = json.loads(marzipano_data(scenes).removeprefix("var APP_DATA = ").strip().removesuffix(";"))
    link = link["scenes"][0]["linkHotspots"][0]
    return {"pannellum": (spot["yaw"], spot["pitch"]), "marzipano": (link["yaw"], link["pitch"])}


def main() -> None:
    """Look along the link in both players, and measure how far from the middle of the window the mark is."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        links = write_tour(folder, Path(sys.argv[1]))
        server = ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(SimpleHTTPRequestHandler, directory=name))
        threading.Thread(target=server.serve_forever, daemon=True).start()
        with chromium(width=800, height=600) as browser:
            for player, (yaw, pitch) in links.items():
                browser.open(f"http://127.0.0.1:{server.server_port}/{player}.html")
                browser.wait("document.querySelector('canvas') && document.readyState == 'complete'")
                look = LOOKS[player].format(yaw=yaw, pitch=pitch)
                browser.wait(f"(() => {{ try {{ return {look}; }} catch {{ return 0; }} }})()")
                browser.evaluate("new Promise((done) => setTimeout(done, 3000))")
                shown = browser.screenshot().astype(int)
                red = np.argwhere((shown[..., 0] > 180) & (shown[..., 1] < 80))
                middle = np.array(shown.shape[:2]) / 2
                print(f"{player}: {len(red)} red pixels, {red.mean(axis=0) - middle} px from the middle (down, right)")
        server.shutdown()


if __name__ == "__main__":
    main()
