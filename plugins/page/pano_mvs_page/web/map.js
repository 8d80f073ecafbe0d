"use strict";
// The map in the corner: the scene from above, the cameras, and where one stands and looks.

class PlanMap {
  constructor(maps, panoramas, visit) {
    this.maps = maps;
    this.panoramas = panoramas;
    this.coverage = false;
    this.shown = null;
    this.opened = new Promise((resolve) => { this.open = resolve; }); // pictures are loaded as soon as somebody opens the map
    this.figure = element("map");
    this.image = this.figure.querySelector("img");
    this.you = element("you");
    this.buttons = panoramas.map((panorama) => {
      const button = document.createElement("button");
      button.type = "button";
      button.tabIndex = -1;
      const { title, right, color, placed } = panorama.camera; // the probability that the pose is right, if it is known
      button.ariaLabel = button.title = placed ? `${title} · ${placed}` : right ? `${title} · pose right with a probability of ${right}` : title;
      button.classList.toggle("rough", Boolean(placed));
      if (color) button.style.setProperty("--judged", color);
      button.disabled = !panorama.camera.levels;
      button.addEventListener("click", () => visit(panorama));
      element("places").append(button);
      return button;
    });
    this.rooms = roomsOf(panoramas).map(({ name, center }) => {
      const tag = Object.assign(document.createElement("span"), { className: "room", textContent: name });
      element("places").append(tag);
      return { tag, center };
    });
    element("places").addEventListener("keydown", (event) => this.key(event));
    this.current(null);
  }

  /** Return the place of a point of the page on the map that is shown, as fractions of its width and height. */
  place(point) {
    const [x, z, ax, az, bx, bz] = this.shown.page_from_map; // a corner, and the sides to the right and downwards
    const dx = point.x - x, dz = point.z - z, determinant = ax * bz - az * bx;
    return [(dx * bz - dz * bx) / determinant, (dz * ax - dx * az) / determinant];
  }

  /** Show the map of a height. */
  async show(height) {
    const near = (map) => (map.heights ? Math.max(map.heights[0] - height, height - map.heights[1], 0) : 0);
    const map = [...this.maps].sort((a, b) => near(a) - near(b))[0];
    if (!map) return;
    const kind = this.coverage && map.coverage ? "coverage" : "colors";
    if (this.shown === map && this.kind === kind) return;
    [this.shown, this.kind] = [map, kind];
    element("places").style.aspectRatio = String(map.aspect);
    for (const [idx, panorama] of this.panoramas.entries()) {
      const [u, v] = this.place(panorama.center);
      Object.assign(this.buttons[idx].style, { left: `${100 * u}%`, top: `${100 * v}%` });
      this.buttons[idx].hidden = Boolean(map.heights) && (panorama.center.y < map.heights[0] || panorama.center.y > map.heights[1]);
    }
    for (const { tag, center } of this.rooms) {
      const [u, v] = this.place(center);
      Object.assign(tag.style, { left: `${100 * u}%`, top: `${100 * v}%` });
      tag.hidden = Boolean(map.heights) && (center.y < map.heights[0] || center.y > map.heights[1]);
    }
    await this.opened;
    map.pictures ??= new Map();
    if (!map.pictures.has(kind)) map.pictures.set(kind, PanoMvs.load(`map/${this.maps.indexOf(map)}/${kind}`));
    const text = await map.pictures.get(kind);
    if (this.shown === map && this.kind === kind) this.image.src = `data:image/webp;base64,${text}`;
  }

  /** Mark the panorama in which one stands; null outside. */
  current(panorama) {
    for (const [idx, button] of this.buttons.entries()) {
      button.setAttribute("aria-current", String(this.panoramas[idx] === panorama));
      button.tabIndex = idx === (panorama ? panorama.index : 0) ? 0 : -1; // one stop for the Tab key; arrows do the rest
    }
  }

  /** Mark the place and the direction of the eye. */
  look(position, yaw) {
    this.you.hidden = !this.shown || !position;
    if (this.you.hidden) return;
    const [u, v] = this.place(position);
    const [ahead, aside] = this.place({ x: position.x + Math.sin(yaw), z: position.z - Math.cos(yaw) });
    const turn = Math.atan2((ahead - u) * this.shown.aspect, -(aside - v));
    this.you.hidden = u < 0 || u > 1 || v < 0 || v > 1;
    Object.assign(this.you.style, { left: `${100 * u}%`, top: `${100 * v}%`, rotate: `${turn}rad` });
  }

  /** Move the focus to the next camera in the direction of an arrow key. */
  key(event) {
    const ways = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
    const way = ways[event.key], from = event.target.getBoundingClientRect();
    if (!way) return;
    event.preventDefault();
    event.stopPropagation();
    let best = null, bestScore = Infinity;
    for (const button of this.buttons) {
      const box = button.getBoundingClientRect(), dx = box.x - from.x, dy = box.y - from.y;
      const along = dx * way[0] + dy * way[1], aside = Math.abs(dx * way[1]) + Math.abs(dy * way[0]);
      if (button !== event.target && !button.disabled && !button.hidden && along > 0 && along + 2 * aside < bestScore) [best, bestScore] = [button, along + 2 * aside];
    }
    best?.focus();
  }
}
