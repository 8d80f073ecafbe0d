"""Configurations of virtual tours for Pannellum, Marzipano and krpano, with links in the true directions.

All show equirectangular pictures whose middle has yaw 0; yaw grows to the right. Pannellum has degrees and pitch up
(its documentation of the JSON configuration, `hotSpots`); Marzipano has radians and pitch DOWN
(`views/Rectilinear.js`, `coordinatesToScreen`); krpano has degrees and `atv` DOWN (its XML reference, `hotspot`).
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from urllib.parse import quote

PANNELLUM, MARZIPANO = "2.5.7", "0.10.2"
_HEAD = (
    '<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>Tour</title>\n'
    '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
    "<style>html,body,#pano{{width:100%;height:100%;margin:0}}a{{color:#fff;text-shadow:0 0 4px #000}}</style>\n{links}"
    '</head><body><div id="pano"></div>\n{script}\n</body></html>\n'
)
_MARZIPANO_SCRIPT = """<script>
const viewer = new Marzipano.Viewer(document.getElementById("pano"));
const scenes = new Map(APP_DATA.scenes.map((data) => [data.id, {data, scene: viewer.createScene({
  source: Marzipano.ImageUrlSource.fromString(data.panorama),
  geometry: new Marzipano.EquirectGeometry([{width: data.width}]),
  view: new Marzipano.RectilinearView(data.initialViewParameters,
    Marzipano.RectilinearView.limit.traditional(data.width / 4, 2)),
})}]));
for (const {data, scene} of scenes.values())
  for (const link of data.linkHotspots) {
    const button = document.createElement("button");
    button.textContent = scenes.get(link.target).data.name;
    button.onclick = () => {
      const next = scenes.get(link.target).scene;
      next.view().setParameters({yaw: link.targetYaw, pitch: 0});
      next.switchTo();
    };
    button.style.cssText = "position: absolute; transform: translate(-50%, -50%); white-space: nowrap";
    const place = document.createElement("div"); // Marzipano puts its upper left corner at the direction
    place.append(button);
    scene.hotspotContainer().createHotspot(place, {yaw: link.yaw, pitch: link.pitch});
  }
scenes.get(APP_DATA.scenes[0].id).scene.switchTo();
</script>"""


@dataclass(frozen=True)
class Link:
    """A way from one scene to another."""

    target: int  # position of the other scene in the list
    yaw_deg: float  # its direction, to the right of the middle of the picture
    pitch_deg: float  # its direction above the horizon
    target_yaw_deg: float  # the same horizontal direction in the other scene, in which one arrives looking


@dataclass(frozen=True)
class Scene:
    """A panorama of a tour."""

    title: str  # shown to people
    picture: str  # path of the picture relative to the configuration, with forward slashes
    width: int  # of the picture in pixels
    heading_deg: float | None  # compass heading of its middle, or None
    links: tuple[Link, ...]  # to other scenes


def pannellum_tour(scenes: Sequence[Scene]) -> dict[str, object]:
    """Return the JSON configuration of a tour for Pannellum."""
    made = {
        f"scene_{number}": {
            "type": "equirectangular",
            "title": scene.title,
            "panorama": quote(scene.picture),
            **({} if scene.heading_deg is None else {"northOffset": scene.heading_deg, "compass": True}),
            "hotSpots": [
                {
                    "type": "scene",
                    "text": scenes[link.target].title,
                    "sceneId": f"scene_{link.target}",
                    "yaw": round(link.yaw_deg, 4),
                    "pitch": round(link.pitch_deg, 4),
                    "targetYaw": round(link.target_yaw_deg, 4),
                    "targetPitch": 0,
                }
                for link in scene.links
            ],
        }
        for number, scene in enumerate(scenes)
    }
    default = {"firstScene": "scene_0", "autoLoad": True, "sceneFadeDuration": 500}
    # Without escapeHTML, which Pannellum reads outside of "default", titles are HTML, and run what a file name says.
    return {"escapeHTML": True, "default": default, "scenes": made}


def pannellum_page(configuration: str) -> str:
    """Return a page that shows the tour of a JSON file beside it."""
    library = f"https://cdn.jsdelivr.net/npm/pannellum@{PANNELLUM}/build/pannellum"
    links = f'<link rel="stylesheet" href="{library}.css"><script src="{library}.js"></script>\n'
    script = (
        f'<script>fetch("{configuration}").then((answer) => answer.json())'
        '.then((tour) => pannellum.viewer("pano", tour));</script>'
    )
    return _HEAD.format(links=links, script=script)


def marzipano_data(scenes: Sequence[Scene]) -> str:
    """Return the script `APP_DATA = …` of a tour, in the form of the Marzipano Tool, but with whole panoramas."""
    made = [
        {
            "id": f"scene_{number}",
            "name": scene.title,
            "panorama": quote(scene.picture),
            "width": scene.width,
            "initialViewParameters": {"yaw": 0, "pitch": 0, "fov": round(math.pi / 2, 6)},
            "linkHotspots": [
                {
                    "target": f"scene_{link.target}",
                    "yaw": round(math.radians(link.yaw_deg), 6),
                    "pitch": round(-math.radians(link.pitch_deg), 6),
                    "rotation": 0,
                    "targetYaw": round(math.radians(link.target_yaw_deg), 6),
                }
                for link in scene.links
            ],
            "infoHotspots": [],
        }
        for number, scene in enumerate(scenes)
    ]
    data = json.dumps({"name": "Tour", "scenes": made}, indent=1, ensure_ascii=False)
    return f"var APP_DATA = {data};\n"


def marzipano_page(data: str) -> str:
    """Return a page that shows the tour of a script beside it."""
    library = f"https://cdn.jsdelivr.net/npm/marzipano@{MARZIPANO}/dist/marzipano.js"
    links = f'<script src="{library}"></script><script src="{data}"></script>\n'
    return _HEAD.format(links=links, script=_MARZIPANO_SCRIPT)


def krpano_tour(scenes: Sequence[Scene]) -> str:
    """Return the XML of a tour for krpano."""
    from xml.sax.saxutils import quoteattr  # which loads ssl, 40 ms

    lines = ['<?xml version="1.0" encoding="UTF-8"?>', '<krpano onstart="loadscene(scene_0, null, MERGE);">']
    for number, scene in enumerate(scenes):
        heading = "" if scene.heading_deg is None else f' heading="{scene.heading_deg:.4f}"'
        lines += [
            f'  <scene name="scene_{number}" title={quoteattr(scene.title)}{heading}>',
            '    <view hlookat="0" vlookat="0" fov="90"/>',
            f"    <image><sphere url={quoteattr(quote(scene.picture))}/></image>",
        ]
        for idx, link in enumerate(scene.links):
            arrive = f"loadscene(scene_{link.target}, view.hlookat={link.target_yaw_deg:.4f}, MERGE, BLEND(0.5));"
            text = quoteattr(escape(scenes[link.target].title, quote=False))  # krpano takes it for HTML
            lines.append(
                f'    <hotspot name="link_{idx}" type="text" text={text} '
                f'ath="{link.yaw_deg:.4f}" atv="{-link.pitch_deg:.4f}" linkedscene="scene_{link.target}" '
                f"onclick={quoteattr(arrive)}/>"
            )
        lines.append("  </scene>")
    return "\n".join([*lines, "</krpano>", ""])
