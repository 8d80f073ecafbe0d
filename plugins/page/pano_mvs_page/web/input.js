"use strict";
// Mouse, touch, keys and buttons.

const STILL_PIXELS = 6;

class Input {
  constructor(page) {
    this.page = page;
    this.canvas = page.canvas;
    this.pointers = new Map();
    this.pressed = null; // where the only pointer went down
    this.actions = {
      overview: () => page.overview(),
      plan: () => page.plan(),
      inside: () => page.mode !== "inside" && page.nearest() && page.stepInside(page.nearest()),
      surface: () => page.showSurface(!page.surfaceShown),
      measure: () => page.measure(!page.measuring),
      coverage: () => page.coverage(!page.covered),
      list: () => page.toggle("list", "panoramas"),
      plot: () => page.toggle("plot", "map"),
      theme: () => page.theme(),
      keys: () => page.toggle("keys", "help"),
    };
    for (const [id, action] of Object.entries(this.actions)) element(id).addEventListener("click", () => { action(); page.writeLink(); });
    addEventListener("resize", () => page.reframe());
    addEventListener("keydown", (event) => this.keydown(event));
    addEventListener("pointerdown", () => page.useKeys(false));
    this.canvas.addEventListener("pointerdown", (event) => this.down(event));
    this.canvas.addEventListener("pointermove", (event) => this.moved(event));
    for (const kind of ["pointerup", "pointercancel"]) this.canvas.addEventListener(kind, (event) => this.up(event));
    this.canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      if (page.mode === "inside") page.zoom(Math.exp(event.deltaY * 0.001));
    }, { passive: false });
  }

  down(event) {
    this.pointers.set(event.pointerId, event);
    this.pressed = this.pointers.size === 1 ? { x: event.clientX, y: event.clientY } : null;
    if (this.page.mode === "inside") this.canvas.setPointerCapture(event.pointerId);
  }

  moved(event) {
    const { page, pointers } = this;
    const before = pointers.get(event.pointerId);
    if (!before) return;
    const spread = this.spread();
    pointers.set(event.pointerId, event);
    if (page.mode !== "inside" || page.move || pointers.size > 2) return;
    if (pointers.size === 2 && this.spread() > 0) page.zoom(spread / this.spread());
    const perPixel = THREE.MathUtils.degToRad(page.look.fov) / this.canvas.clientHeight / pointers.size;
    page.turn(-(event.clientX - before.clientX) * perPixel, (event.clientY - before.clientY) * perPixel);
  }

  /** Return how far apart two fingers are; 0 with fewer. */
  spread() {
    const [a, b] = this.pointers.values();
    return b ? Math.hypot(a.clientX - b.clientX, a.clientY - b.clientY) : 0;
  }

  up(event) {
    const { page, pressed } = this;
    this.pointers.delete(event.pointerId);
    if (page.mode === "inside") page.writeLink();
    if (!pressed || event.type !== "pointerup") return;
    const still = Math.hypot(event.clientX - pressed.x, event.clientY - pressed.y) < STILL_PIXELS;
    this.pressed = null;
    if (still && event.button === 0) page.click(event.clientX, event.clientY);
  }

  keydown(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const shortcuts = { o: "overview", p: "plan", i: "inside", s: "surface", m: "measure", c: "coverage", l: "list", n: "plot", t: "theme", "?": "keys" };
    const id = shortcuts[event.key.toLowerCase()];
    if (id && !element(id).hidden) element(id).click();
    else if (event.target.closest?.("button") && event.key !== "Escape" || !this.key(event.key, event.shiftKey)) return;
    this.page.useKeys(true);
    event.preventDefault();
  }

  /** Do what a key stands for; return whether it stands for something. */
  key(name, shifted) {
    const { page } = this;
    if (name === "Escape") return page.back();
    if (name === "Enter") return this.enter();
    if (name === "PageDown" || name === "PageUp") {
      page.visitNext(name === "PageDown" ? 1 : -1);
      return true;
    }
    const zooms = { "+": 1 / 1.15, "=": 1 / 1.15, "-": 1.15 };
    const steps = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
    if (!zooms[name] && !steps[name]) return false;
    if (page.mode === "inside") zooms[name] ? page.zoom(zooms[name]) : page.turn(steps[name][0] * 0.12, steps[name][1] * 0.12);
    else if (page.mode === "plan") this.glide(zooms[name], steps[name]);
    else if (shifted && steps[name]) this.pan(steps[name]);
    else this.orbit(zooms[name], steps[name]);
    page.changed();
    page.describe();
    page.writeLink();
    return true;
  }

  /** Mark the point in the middle of the window, walk to the panorama ahead, or step inside the nearest one. */
  enter() {
    const { page, canvas } = this;
    if (page.move) return true;
    if (page.measuring) page.mark(canvas.clientWidth / 2, canvas.clientHeight / 2);
    else {
      const panorama = page.mode === "inside" ? page.ahead() : page.nearest();
      if (panorama) page.stepInside(panorama);
      else say("No panorama lies ahead. Turn, or press Page Down for the next one.");
    }
    return true;
  }

  pan([right, up]) {
    const { eye, orbit } = this.page;
    const way = eye.position.distanceTo(orbit.target) * 0.06;
    const move = new THREE.Vector3(right * way, up * way, 0).applyQuaternion(eye.quaternion);
    for (const moved of [eye.position, orbit.target]) moved.add(move);
    orbit.update();
  }

  glide(zoom, step) {
    const { above, halfHeight, glide } = this.page;
    if (zoom) above.zoom /= zoom;
    above.updateProjectionMatrix();
    const way = (halfHeight / above.zoom) * 0.1;
    if (step) for (const moved of [above.position, glide.target]) moved.add(new THREE.Vector3(step[0] * way, 0, -step[1] * way));
    glide.update();
  }

  orbit(zoom, step) {
    const { eye, orbit } = this.page;
    const arm = eye.position.clone().sub(orbit.target), vertical = new THREE.Vector3(0, 1, 0);
    if (zoom) arm.multiplyScalar(zoom);
    else {
      arm.applyAxisAngle(vertical, -step[0] * 0.12);
      const polar = arm.angleTo(vertical) - step[1] * 0.12;
      if (polar > 0.05 && polar < 3.09) arm.applyAxisAngle(new THREE.Vector3().crossVectors(arm, vertical).normalize(), step[1] * 0.12);
    }
    eye.position.copy(arm).add(orbit.target);
    orbit.update();
  }
}
