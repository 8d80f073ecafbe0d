"use strict";
// The page: three ways to look (overview, floor plan, inside), walks between panoramas, measuring, links.

const WALK_MS = 1100;
const FLY_MS = 900;
const RING_PIXELS = 34; // how near a click must come
const OPEN_PANORAMAS = 4; // kept in memory
const element = (id) => document.getElementById(id);
const reducedMotion = matchMedia("(prefers-reduced-motion: reduce)");

function problem(error) {
  element("problem").textContent = `Something is missing: ${error.message}. Copy the whole folder, and load the page again.`;
  element("problem").hidden = false;
}

class Page {
  constructor(scene) {
    this.canvas = element("canvas");
    this.renderer = new THREE.WebGLRenderer({ canvas: this.canvas, antialias: true });
    this.renderer.autoClear = false;
    this.changed = () => { this.dirty = true; };
    this.scene = scene;
    this.world = new THREE.Scene();
    this.cloud = new Cloud(scene, this.changed);
    this.world.add(this.cloud.group);
    this.ruler = new Ruler(scene.unit);
    this.marks = new THREE.Scene(); // drawn over everything
    this.marks.add(this.ruler.group);
    this.panoramas = scene.cameras.map((camera, index) => new Panorama(index, camera, scene.ranges, this.changed));
    this.recent = [];
    this.here = null; // the panorama one stands in
    this.move = null; // a walk or a flight
    this.eye = new THREE.PerspectiveCamera(55, 1, 0.01, 10000);
    this.above = new THREE.OrthographicCamera(-1, 1, 1, -1, -10000, 10000);
    this.look = { yaw: 0, pitch: 0, fov: 80 };
    this.measuring = false;
    this.addRings();
    this.orbit = this.controls(this.eye);
    this.glide = this.controls(this.above);
    this.glide.enableRotate = false;
    this.glide.screenSpacePanning = true;
    this.listen();
    this.resize();
    if (!this.followLink()) this.overview();
    requestAnimationFrame((now) => this.frame(now));
  }

  controls(camera) {
    const controls = new THREE.OrbitControls(camera, this.canvas);
    controls.addEventListener("change", this.changed);
    controls.enabled = false;
    controls.zoomToCursor = true;
    return controls;
  }

  addRings() {
    const drawing = document.createElement("canvas");
    drawing.width = drawing.height = 64;
    const pen = drawing.getContext("2d");
    for (const [width, style] of [[13, "#15181c"], [7, "#ffb02e"]]) {
      pen.lineWidth = width;
      pen.strokeStyle = style;
      pen.beginPath();
      pen.arc(32, 32, 23, 0, 2 * Math.PI);
      pen.stroke();
    }
    const map = new THREE.CanvasTexture(drawing);
    map.colorSpace = THREE.SRGBColorSpace;
    this.rings = this.panoramas.map((panorama) => {
      const ring = new THREE.Sprite(new THREE.SpriteMaterial({ map, depthTest: false, sizeAttenuation: false, transparent: true }));
      ring.position.copy(panorama.center);
      this.marks.add(ring);
      return ring;
    });
  }

  // --- Ways to look ---

  get camera() { return this.mode === "plan" ? this.above : this.eye; }

  box() {
    const box = new THREE.Box3();
    for (const corner of this.scene.bounds) box.expandByPoint(new THREE.Vector3(...corner));
    for (const panorama of this.panoramas) box.expandByPoint(panorama.center);
    return box;
  }

  enter(mode) {
    this.mode = mode;
    this.orbit.enabled = mode === "overview";
    this.glide.enabled = mode === "plan";
    if (mode !== "inside") this.here = null;
    this.cloud.material.uniforms.cut.value = mode === "plan" ? this.cutHeight() : 1e30;
    this.cloud.material.uniforms.hideBacks.value = mode === "overview";
    element("place").textContent = this.here ? this.here.camera.name : "";
    for (const name of ["overview", "plan", "inside"]) element(name).setAttribute("aria-current", String(name === mode));
    for (const [index, button] of [...element("panoramas").querySelectorAll("button")].entries()) {
      button.setAttribute("aria-current", String(this.here?.index === index));
    }
    this.placeRings();
    this.changed();
  }

  cutHeight() {
    const heights = this.panoramas.map((panorama) => panorama.center.y).sort((a, b) => a - b);
    return heights.length ? heights[heights.length >> 1] + 0.02 * this.box().getSize(new THREE.Vector3()).length() : 1e30;
  }

  overview() {
    this.move = null;
    const box = this.box(), center = box.getCenter(new THREE.Vector3());
    const radius = Math.max(box.getSize(new THREE.Vector3()).length() / 2, 1e-3);
    const distance = radius / Math.sin(THREE.MathUtils.degToRad(this.fitted(55)) / 2) * 0.9;
    this.eye.fov = 55;
    this.eye.position.copy(center).add(new THREE.Vector3(0.55, 0.75, 0.9).normalize().multiplyScalar(distance));
    this.orbit.target.copy(center);
    this.nearFar(radius);
    this.enter("overview");
    this.orbit.update();
  }

  /** Return the smaller of a camera's two fields of view. */
  fitted(fov) {
    const aspect = this.canvas.clientWidth / this.canvas.clientHeight;
    return aspect >= 1 ? fov : THREE.MathUtils.radToDeg(2 * Math.atan(Math.tan(THREE.MathUtils.degToRad(fov) / 2) * aspect));
  }

  nearFar(radius) {
    this.eye.near = radius / 2000;
    this.eye.far = radius * 200;
    this.eye.updateProjectionMatrix();
  }

  plan() {
    this.move = null;
    const box = this.box(), center = box.getCenter(new THREE.Vector3()), size = box.getSize(new THREE.Vector3());
    const aspect = this.canvas.clientWidth / this.canvas.clientHeight;
    this.halfHeight = 0.58 * Math.max(size.z, size.x / aspect, 1e-3);
    this.above.zoom = 1;
    this.above.up.set(0, 0, -1);
    this.above.position.set(center.x, center.y + size.length(), center.z);
    this.glide.target.copy(center);
    this.resize();
    this.enter("plan");
    this.glide.update();
  }

  /** Stand in a panorama: walk there from another one, fly there from outside. */
  stepInside(panorama, at_once = false) {
    const from = this.mode === "inside" && this.here !== panorama ? this.here : null;
    panorama.open().then(() => {
      this.keep(panorama);
      const start = this.camera === this.eye ? this.eye.position.clone() : panorama.center.clone();
      if (this.mode !== "inside" && this.mode !== undefined && this.camera === this.eye) {
        const ahead = this.eye.getWorldDirection(new THREE.Vector3());
        this.look = { yaw: Math.atan2(ahead.x, -ahead.z), pitch: Math.asin(THREE.MathUtils.clamp(ahead.y, -1, 1)), fov: 80 };
      }
      const flight = this.mode === "overview";
      const jump = at_once || reducedMotion.matches || (!from && !flight);
      const pitch = flight ? this.look.pitch : null;
      this.move = jump ? null : { from, to: panorama, start, began: performance.now(), length: from ? WALK_MS : FLY_MS, pitch, flight };
      this.here = panorama;
      if (flight && !jump) this.orbit.enabled = false;
      else this.enter("inside");
      if (jump) this.look.pitch = THREE.MathUtils.clamp(this.look.pitch, -0.3, 0.3);
      this.writeLink();
    }).catch(problem);
  }

  keep(panorama) {
    this.recent = [panorama, ...this.recent.filter((other) => other !== panorama)];
    for (const old of this.recent.splice(OPEN_PANORAMAS)) old.close();
  }

  /** Show the rings of the cameras: from inside, of those that nothing hides. */
  placeRings() {
    for (const [index, ring] of this.rings.entries()) {
      const panorama = this.panoramas[index];
      ring.visible = true;
      if (this.mode !== "inside" || !this.here) continue;
      const there = panorama.center.clone().sub(this.here.center);
      const seen = this.here.pick(there);
      ring.visible = panorama !== this.here && panorama.camera.levels > 0 && (!seen || seen.distanceTo(this.here.center) > 0.85 * there.length());
    }
  }

  /** Return the panorama that lies best ahead; null if none does. */
  ahead() {
    const forward = this.eye.getWorldDirection(new THREE.Vector3());
    let best = null, bestScore = 0;
    for (const [index, panorama] of this.panoramas.entries()) {
      if (!this.rings[index].visible || panorama === this.here) continue;
      const there = panorama.center.clone().sub(this.eye.position);
      const score = Math.max(0, there.clone().normalize().dot(forward) - 0.5) / Math.sqrt(there.length() + 1e-9);
      if (score > bestScore) [best, bestScore] = [panorama, score];
    }
    return best;
  }

  nearest() {
    const target = this.orbit.target;
    const usable = this.panoramas.filter((panorama) => panorama.camera.levels > 0);
    return usable.sort((a, b) => a.center.distanceTo(target) - b.center.distanceTo(target))[0];
  }

  // --- Input ---

  listen() {
    addEventListener("resize", () => this.resize());
    addEventListener("hashchange", () => this.followLink());
    this.orbit.addEventListener("end", () => this.writeLink());
    this.glide.addEventListener("end", () => this.writeLink());
    const pointers = new Map();
    let pressed = null, pinch = 0;
    this.canvas.addEventListener("pointerdown", (event) => {
      pointers.set(event.pointerId, event);
      pressed = pointers.size === 1 ? { x: event.clientX, y: event.clientY, time: event.timeStamp } : null;
      if (this.mode === "inside") this.canvas.setPointerCapture(event.pointerId);
    });
    this.canvas.addEventListener("pointermove", (event) => {
      const before = pointers.get(event.pointerId);
      if (!before) return;
      pointers.set(event.pointerId, event);
      if (this.mode !== "inside" || this.move) return;
      if (pointers.size === 2) {
        const [a, b] = [...pointers.values()];
        const apart = Math.hypot(a.clientX - b.clientX, a.clientY - b.clientY);
        if (pinch) this.zoom(pinch / apart);
        pinch = apart;
        return;
      }
      const perPixel = THREE.MathUtils.degToRad(this.look.fov) / this.canvas.clientHeight;
      this.turn(-(event.clientX - before.clientX) * perPixel, (event.clientY - before.clientY) * perPixel);
    });
    const release = (event) => {
      pointers.delete(event.pointerId);
      pinch = 0;
      if (this.mode === "inside") this.writeLink();
      if (!pressed || event.type !== "pointerup") return;
      const still = Math.hypot(event.clientX - pressed.x, event.clientY - pressed.y) < 6 && event.timeStamp - pressed.time < 600;
      pressed = null;
      if (still && event.button === 0) this.click(event.clientX, event.clientY);
    };
    this.canvas.addEventListener("pointerup", release);
    this.canvas.addEventListener("pointercancel", release);
    this.canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      if (this.mode === "inside") this.zoom(Math.exp(event.deltaY * 0.001));
    }, { passive: false });
    const press = {
      overview: () => { this.overview(); this.writeLink(); },
      plan: () => { this.plan(); this.writeLink(); },
      inside: () => this.mode !== "inside" && this.nearest() && this.stepInside(this.nearest()),
      measure: () => this.measure(!this.measuring),
      coverage: () => this.coverage(),
      list: () => this.toggle("list", "panoramas"),
      theme: () => this.theme(),
      keys: () => this.toggle("keys", "help"),
    };
    for (const [id, action] of Object.entries(press)) element(id).addEventListener("click", action);
    const shortcuts = { o: "overview", p: "plan", i: "inside", m: "measure", c: "coverage", l: "list", t: "theme", "?": "keys" };
    addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey) return;
      const id = shortcuts[event.key.toLowerCase()];
      if (id) press[id]();
      else if (event.target.closest?.("button") || !this.key(event.key)) return;
      event.preventDefault();
    });
    this.fillList();
    element("inside").disabled = !this.nearest();
  }

  key(name) {
    if (name === "Escape") {
      if (!element("help").hidden) this.toggle("keys", "help");
      else if (this.measuring) this.measure(false);
      else if (this.mode !== "overview") this.overview();
      return true;
    }
    if (name === "Enter" && this.mode === "inside") {
      const panorama = this.ahead();
      if (panorama && !this.move) this.stepInside(panorama);
      return true;
    }
    const steps = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1], "+": "in", "=": "in", "-": "out" };
    const step = steps[name];
    if (!step) return false;
    const factor = step === "in" ? 1 / 1.15 : 1.15;
    if (this.mode === "inside") {
      if (typeof step === "string") this.zoom(factor);
      else this.turn(step[0] * 0.12, step[1] * 0.12);
    } else if (typeof step === "string") {
      if (this.mode === "plan") this.above.zoom /= factor;
      else this.eye.position.sub(this.orbit.target).multiplyScalar(factor).add(this.orbit.target);
      this.above.updateProjectionMatrix();
    } else if (this.mode === "overview") {
      const arm = this.eye.position.clone().sub(this.orbit.target);
      arm.applyAxisAngle(new THREE.Vector3(0, 1, 0), -step[0] * 0.12);
      const side = new THREE.Vector3().crossVectors(arm, new THREE.Vector3(0, 1, 0)).normalize();
      const polar = arm.angleTo(new THREE.Vector3(0, 1, 0));
      if (polar - step[1] * 0.12 > 0.05 && polar - step[1] * 0.12 < 3.09) arm.applyAxisAngle(side, step[1] * 0.12);
      this.eye.position.copy(arm).add(this.orbit.target);
    } else {
      const way = (this.halfHeight / this.above.zoom) * 0.1;
      for (const moved of [this.above.position, this.glide.target]) moved.add(new THREE.Vector3(step[0] * way, 0, -step[1] * way));
    }
    if (this.mode !== "inside") (this.mode === "plan" ? this.glide : this.orbit).update();
    this.changed();
    this.writeLink();
    return true;
  }

  turn(yaw, pitch) {
    this.look.yaw += yaw;
    this.look.pitch = THREE.MathUtils.clamp(this.look.pitch + pitch, -1.55, 1.55);
    this.changed();
  }

  zoom(factor) {
    this.look.fov = THREE.MathUtils.clamp(this.look.fov * factor, 15, 110);
    this.changed();
  }

  raycaster(x, y) {
    const caster = new THREE.Raycaster();
    const place = new THREE.Vector2((x / this.canvas.clientWidth) * 2 - 1, 1 - (y / this.canvas.clientHeight) * 2);
    caster.setFromCamera(place, this.camera);
    return caster;
  }

  /** Return the point of the scene below a pixel of the window; null if there is none. */
  pick(x, y) {
    const caster = this.raycaster(x, y);
    return this.mode === "inside" ? this.here.pick(caster.ray.direction) : this.cloud.pick(caster, this.camera, this.canvas.clientHeight);
  }

  click(x, y) {
    this.canvas.focus({ preventScroll: true });
    if (this.move) return;
    if (this.measuring) {
      const point = this.pick(x, y);
      if (point) this.ruler.add(point);
      else say("Nothing was measured there. Click a surface.");
      return this.changed();
    }
    let best = null, bestApart = RING_PIXELS;
    for (const [index, ring] of this.rings.entries()) {
      if (!ring.visible || !this.panoramas[index].camera.levels) continue;
      const place = ring.position.clone().project(this.camera);
      if (Math.abs(place.z) > 1) continue;
      const apart = Math.hypot(((place.x + 1) / 2) * this.canvas.clientWidth - x, ((1 - place.y) / 2) * this.canvas.clientHeight - y);
      if (apart < bestApart) [best, bestApart] = [this.panoramas[index], apart];
    }
    if (best) this.stepInside(best);
  }

  measure(on) {
    this.measuring = on;
    element("measure").setAttribute("aria-pressed", String(on));
    this.ruler.clear();
    if (on) say("Click two points.");
    this.changed();
  }

  coverage() {
    const uniform = this.cloud.material.uniforms.coverage;
    uniform.value = !uniform.value;
    element("coverage").setAttribute("aria-pressed", String(uniform.value));
    if (uniform.value && this.mode === "inside") this.overview();
    say(uniform.value ? "Red: confirmed by one panorama, yellow: by three or four, green: by six and more." : "");
    this.changed();
  }

  toggle(button, panel) {
    const hidden = !element(panel).hidden;
    element(panel).hidden = hidden;
    element(button).setAttribute("aria-expanded", String(!hidden));
  }

  theme() {
    const dark = getComputedStyle(document.documentElement).getPropertyValue("--ground").trim() === "#15181c";
    document.documentElement.dataset.theme = dark ? "light" : "dark";
    this.changed();
  }

  fillList() {
    for (const panorama of this.panoramas) {
      const row = document.createElement("li"), button = document.createElement("button");
      button.type = "button";
      button.textContent = panorama.camera.name;
      button.disabled = !panorama.camera.levels;
      button.addEventListener("click", () => !this.move && this.stepInside(panorama));
      row.append(button);
      element("panoramas").querySelector("ol").append(row);
    }
  }

  // --- Links ---

  writeLink() {
    const short = (numbers) => numbers.map((number) => Number(number.toPrecision(6))).join(",");
    let link = "";
    if (this.mode === "inside") link = `i=${this.here.index},${short([this.look.yaw, this.look.pitch, this.look.fov])}`;
    else if (this.mode === "plan") link = `p=${short([this.above.position.x, this.above.position.z, this.above.zoom])}`;
    else link = `o=${short([...this.eye.position.toArray(), ...this.orbit.target.toArray()])}`;
    this.link = `#${link}`;
    history.replaceState(null, "", this.link);
  }

  followLink() {
    if (!location.hash || location.hash === this.link) return Boolean(location.hash);
    const [kind, text] = location.hash.slice(1).split("=");
    const numbers = (text ?? "").split(",").map(Number);
    if (!numbers.every(Number.isFinite)) return false;
    if (kind === "i" && numbers.length === 4 && this.panoramas[numbers[0]]?.camera.levels) {
      if (this.mode === undefined) this.overview();
      this.look = { yaw: numbers[1], pitch: THREE.MathUtils.clamp(numbers[2], -1.55, 1.55), fov: THREE.MathUtils.clamp(numbers[3], 15, 110) };
      this.mode = "inside"; // keeps this direction
      this.stepInside(this.panoramas[numbers[0]], true);
      return true;
    }
    if (kind === "p" && numbers.length === 3) {
      this.plan();
      [this.above.position.x, this.above.position.z, this.above.zoom] = numbers;
      [this.glide.target.x, this.glide.target.z] = numbers;
      this.resize();
      return true;
    }
    if (kind === "o" && numbers.length === 6) {
      this.overview();
      this.eye.position.fromArray(numbers);
      this.orbit.target.fromArray(numbers, 3);
      this.orbit.update();
      return true;
    }
    return false;
  }

  // --- Drawing ---

  resize() {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    this.renderer.setSize(width, height, false);
    this.eye.aspect = width / height;
    this.eye.updateProjectionMatrix();
    const half = this.halfHeight ?? 1;
    Object.assign(this.above, { top: half, bottom: -half, left: -half * this.eye.aspect, right: half * this.eye.aspect });
    this.above.updateProjectionMatrix();
    this.changed();
  }

  frame(now) {
    requestAnimationFrame((next) => this.frame(next));
    if (this.move) this.changed();
    if (!this.dirty) return;
    this.dirty = false;
    const t = this.move ? Math.min(1, (now - this.move.began) / this.move.length) : 1;
    const smooth = t * t * (3 - 2 * t);
    if (this.mode === "inside" || this.move) this.lookFrom(smooth);
    this.draw(smooth);
    if (this.move && t >= 1) {
      this.move = null;
      if (this.mode !== "inside") this.enter("inside");
      this.placeRings();
      this.writeLink();
      this.changed();
    }
  }

  /** Place the eye: within a panorama, or on the way to one. */
  lookFrom(t) {
    const { move, look } = this;
    this.eye.position.copy(move ? move.start.clone().lerp(move.to.center, t) : this.here.center);
    if (move?.flight) look.pitch = THREE.MathUtils.lerp(move.pitch, 0, t);
    this.eye.fov = move?.flight ? THREE.MathUtils.lerp(55, look.fov, t) : look.fov;
    const direction = new THREE.Vector3(Math.sin(look.yaw) * Math.cos(look.pitch), Math.sin(look.pitch), -Math.cos(look.yaw) * Math.cos(look.pitch));
    this.eye.up.set(0, 1, 0);
    this.eye.lookAt(this.eye.position.clone().add(direction));
    this.eye.updateProjectionMatrix();
    this.eye.updateMatrixWorld();
  }

  draw(t) {
    const { renderer, camera } = this;
    const height = this.canvas.clientHeight;
    renderer.setClearColor(getComputedStyle(document.documentElement).getPropertyValue("--ground").trim());
    renderer.clear();
    camera.updateMatrixWorld();
    if (this.mode === "inside") this.drawPanoramas(t, height);
    else {
      this.cloud.update(camera, height * renderer.getPixelRatio());
      renderer.render(this.world, camera);
    }
    renderer.clearDepth();
    for (const ring of this.rings) ring.scale.setScalar(camera === this.above ? (0.05 * this.halfHeight) / this.above.zoom : 0.04 * Math.tan(THREE.MathUtils.degToRad(this.eye.fov) / 2));
    renderer.render(this.marks, camera);
    this.ruler.place(camera, this.canvas.clientWidth, height);
  }

  drawPanoramas(t, height) {
    const { move, here, renderer, eye } = this;
    if (!move) here.update(eye, height * renderer.getPixelRatio());
    here.fade(1);
    renderer.render(here.group, eye);
    if (!move?.from) return;
    renderer.clearDepth();
    move.from.fade(1 - t);
    renderer.render(move.from.group, eye);
  }
}

PanoMvs.load("scene").then((scene) => {
  PanoMvs.page = new Page(scene);
}).catch(problem);
