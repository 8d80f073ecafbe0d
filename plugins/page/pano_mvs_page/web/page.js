"use strict";
// The page: three ways to look (overview, floor plan, inside), walks between panoramas, measuring, links.

const WALK_MS = 1100;
const FLY_MS = 900;
const RING_PIXELS = 34; // how near a click must come
const OPEN_PANORAMAS = 4; // kept in memory
const FAR = 200; // times the radius of the scene
const reducedMotion = matchMedia("(prefers-reduced-motion: reduce)");
const narrow = matchMedia("(max-width: 520px)");

function element(id) {
  return document.getElementById(id);
}

function problem(error) {
  element("problem").textContent = `Something is missing: ${error.message}. Copy the whole folder, and load the page again.`;
  element("problem").hidden = false;
}

class Page {
  constructor(scene) {
    scene.cameras.forEach((camera) => { camera.title = camera.room ? `${camera.room} · ${camera.name}` : camera.name; });
    this.canvas = element("canvas");
    this.renderer = new THREE.WebGLRenderer({ canvas: this.canvas, antialias: false });
    this.renderer.autoClear = false;
    this.dirty = true;
    this.changed = () => { this.dirty = true; };
    this.moved = () => {
      this.pace.move();
      this.changed();
    };
    this.scene = scene;
    this.world = new THREE.Scene();
    this.cloud = new Cloud(scene, this.changed);
    this.surface = scene.mesh ? new Surface(scene.mesh, scene.sigmas, this.changed) : null;
    this.world.add(this.cloud.group);
    if (this.surface) this.world.add(this.surface.group);
    this.ruler = new Ruler(scene.unit);
    this.marks = new THREE.Scene(); // drawn over everything
    this.marks.add(this.ruler.group);
    this.panoramas = scene.cameras.map((camera, index) => new Panorama(index, camera, scene.ranges, this.changed));
    this.recent = [];
    this.here = null; // the panorama one stands in
    this.move = null; // a walk or a flight
    this.wanted = null; // the panorama that is being opened
    this.eye = new THREE.PerspectiveCamera(55, 1, 0.01, 10000);
    this.above = new THREE.OrthographicCamera(-1, 1, 1, -1, -10000, 10000);
    this.look = { yaw: 0, pitch: 0, fov: 80 };
    this.measuring = this.covered = false;
    this.pace = new Pace();
    this.resolution = PACES[0].resolution;
    this.walkView = new WalkView(this.renderer);
    this.addRings();
    this.orbit = this.controls(this.eye);
    this.glide = this.controls(this.above);
    this.glide.enableRotate = false;
    this.glide.screenSpacePanning = true;
    this.map = new PlanMap(scene.maps, this.panoramas, (panorama) => this.visit(panorama));
    this.rooms = new Rooms(this.panoramas);
    this.headset = new Headset(this);
    this.prepare();
    this.resize();
    if (!location.hash || !followLink(this, location.hash)) this.overview();
    requestAnimationFrame((now) => this.frame(now));
  }

  /** Connect the buttons with what this scene has. */
  prepare() {
    this.input = new Input(this);
    addEventListener("hashchange", () => location.hash !== this.link && followLink(this, location.hash));
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", this.changed);
    this.fillList();
    element("inside").disabled = !this.nearest();
    element("surface").hidden = !this.surface || !this.cloud.nodes.size;
    element("coverage").hidden = !this.scene.coverage;
    element("plot").hidden = !this.scene.maps.length;
    this.placeMap();
    narrow.addEventListener("change", () => this.placeMap());
    this.showSurface(Boolean(this.surface));
  }

  /** Show the map if there is room for it. */
  placeMap() {
    element("map").hidden = !this.scene.maps.length || narrow.matches;
    element("plot").setAttribute("aria-expanded", String(!element("map").hidden));
  }

  controls(camera) {
    const controls = new THREE.OrbitControls(camera, this.canvas);
    controls.addEventListener("change", this.moved);
    controls.addEventListener("end", () => this.writeLink());
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
    for (const corner of this.scene.bounds.length ? this.scene.bounds : this.scene.mesh?.bounds ?? []) box.expandByPoint(new THREE.Vector3(...corner));
    for (const panorama of this.panoramas) box.expandByPoint(panorama.center);
    return box.expandByScalar(0.01 * box.getSize(new THREE.Vector3()).length() || 1); // a single place has no size
  }

  enter(mode) {
    this.mode = document.body.dataset.mode = mode;
    this.orbit.enabled = mode === "overview";
    this.glide.enabled = mode === "plan";
    if (mode !== "inside") this.here = null;
    const cut = mode === "plan" ? this.cutHeight() : 1e30;
    this.cloud.material.uniforms.cut.value = cut;
    if (this.surface) this.surface.uniforms.cut.value = cut;
    this.cloud.material.uniforms.hideBacks.value = mode === "overview";
    element("place").textContent = { overview: "Overview", plan: "Floor plan" }[mode] ?? this.here.camera.title;
    for (const name of ["overview", "plan", "inside"]) element(name).setAttribute("aria-current", String(name === mode));
    for (const [index, button] of [...element("panoramas").querySelectorAll("button")].entries()) {
      button.setAttribute("aria-current", String(this.here?.index === index));
    }
    this.map.current(this.here);
    this.map.show((this.here ?? this.nearest())?.center.y ?? 0).catch(problem);
    this.placeRings();
    element("facing").textContent = "";
    this.describe();
    this.changed();
  }

  cutHeight() {
    const heights = this.panoramas.map((panorama) => panorama.center.y).sort((a, b) => a - b);
    return heights.length ? heights[heights.length >> 1] + 0.02 * this.box().getSize(new THREE.Vector3()).length() : 1e30;
  }

  overview() {
    this.move = null;
    const box = this.box();
    this.eye.fov = 55;
    this.nearFar(box.getSize(new THREE.Vector3()).length() / 2);
    this.fit(box.getCenter(new THREE.Vector3()));
    this.enter("overview");
    this.orbit.update();
    this.opening = this.eye.position.clone();
  }

  /** Place the eye above and aside of the scene, as near as all of it fits into the part of the window that is free. */
  fit(middle) {
    const { eye } = this, { top, bottom, height } = this.free();
    const backward = new THREE.Vector3(0.55, 0.75, 0.9).normalize();
    const right = new THREE.Vector3(0, 1, 0).cross(backward).normalize(), up = backward.clone().cross(right);
    const slope = Math.tan(THREE.MathUtils.degToRad(eye.fov) / 2), least = 0.01 * eye.far / FAR; // of a single place
    const corners = this.scene.outline.map((point) => new THREE.Vector3(...point));
    for (const { center } of this.panoramas) for (const side of [-least, least]) corners.push(center.clone().addScalar(side));
    // A corner at p appears within the limits if -low (away - p.backward) < p.axis - place < high (away - p.backward).
    const span = (axis, low, high) => {
      const from = Math.max(...corners.map((corner) => corner.dot(axis) + high * corner.dot(backward)));
      const to = Math.min(...corners.map((corner) => corner.dot(axis) - low * corner.dot(backward)));
      const away = (from - to) / (low + high);
      return { away, place: (at) => (from - high * at + to + low * at) / 2 };
    };
    const across = span(right, slope * eye.aspect, slope * eye.aspect);
    const upright = span(up, slope * (1 - (2 * bottom) / height), slope * (1 - (2 * top) / height));
    const away = 1.03 * (Math.max(across.away, upright.away) - middle.dot(backward)) + middle.dot(backward);
    eye.position.copy(backward).multiplyScalar(away);
    eye.position.addScaledVector(right, across.place(away)).addScaledVector(up, upright.place(away));
    this.orbit.target.copy(eye.position).addScaledVector(backward, middle.dot(backward) - away);
  }

  /** Return how many pixels the heading and the buttons take of the height of the window. */
  free() {
    const height = this.canvas.clientHeight;
    return { height, top: Math.min(height / 4, 50), bottom: Math.min(height / 4, element("tools").offsetHeight + 16) };
  }

  nearFar(radius) {
    this.eye.near = radius / 2000;
    this.eye.far = radius * FAR;
    this.eye.updateProjectionMatrix();
  }

  plan() {
    this.move = null;
    const box = this.box(), center = box.getCenter(new THREE.Vector3()), size = box.getSize(new THREE.Vector3());
    const { top, bottom, height } = this.free();
    this.halfHeight = 0.53 * Math.max((size.z * height) / (height - top - bottom), size.x / this.eye.aspect);
    center.z += (this.halfHeight * (bottom - top)) / height;
    this.above.zoom = 1;
    this.above.up.set(0, 0, -1);
    this.above.position.set(center.x, center.y + size.length(), center.z);
    this.glide.target.copy(center);
    this.resize();
    this.enter("plan");
    this.glide.update();
  }

  /** Go back by one step: close the help or the list, end measuring, leave a panorama. */
  back() {
    if (!element("help").hidden) this.toggle("keys", "help");
    else if (!element("panoramas").hidden) this.toggle("list", "panoramas");
    else if (this.measuring) this.measure(false);
    else if (this.mode !== "overview") this.overview();
    this.writeLink();
    return true;
  }

  /** Stand in a panorama: walk there from another one, fly there from outside. */
  async stepInside(panorama, at_once = false) {
    this.wanted = panorama;
    try {
      await panorama.open();
    } catch (error) {
      return problem(error);
    }
    if (this.wanted !== panorama) return; // somebody chose another one meanwhile
    this.wanted = null;
    this.keep(panorama);
    const from = this.mode === "inside" && this.here !== panorama ? this.here : null;
    const start = this.camera === this.eye ? this.eye.position.clone() : panorama.center.clone();
    const outside = this.mode !== "inside";
    if (outside && this.camera === this.eye) {
      const ahead = this.eye.getWorldDirection(new THREE.Vector3());
      this.look = { yaw: Math.atan2(ahead.x, -ahead.z), pitch: Math.asin(THREE.MathUtils.clamp(ahead.y, -1, 1)), fov: 80 };
    }
    const flight = this.mode === "overview";
    const jump = at_once || reducedMotion.matches || (!from && !flight);
    this.move = jump ? null : { from, to: panorama, start, began: performance.now(), length: from ? WALK_MS : FLY_MS, pitch: this.look.pitch, flight };
    this.here = panorama;
    if (flight && !jump) this.orbit.enabled = false;
    else this.enter("inside");
    if (jump && outside) this.look.pitch = THREE.MathUtils.clamp(this.look.pitch, -0.3, 0.3);
    this.writeLink();
  }

  /** Step inside a panorama that was chosen from the list or the map; the keys then act on the view. */
  visit(panorama) {
    if (this.move) return;
    this.canvas.focus({ preventScroll: true });
    this.stepInside(panorama);
  }

  /** Step inside the panorama that comes so many places later in the list. */
  visitNext(places) {
    const usable = this.panoramas.filter((panorama) => panorama.camera.levels > 0);
    const now = usable.indexOf(this.here ?? (places > 0 ? usable.at(-1) : usable[0]));
    if (usable.length) this.visit(usable[(now + places + usable.length) % usable.length]);
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
      const leads = this.here.camera.leadsTo; // in a tour, whose links lead through walls; without ranges, they alone count
      const rough = leads && (!this.here.camera.ranges || (panorama.camera.placed && !seen));
      if (leads?.includes(index) || rough) { ring.visible = panorama.camera.levels > 0 && leads.includes(index); continue; }
      ring.visible = panorama !== this.here && panorama.camera.levels > 0 && (!seen || seen.point.distanceTo(this.here.center) > 0.85 * there.length());
    }
  }

  /** Return the panorama that lies best ahead of a camera; null if none does. */
  ahead(camera = this.eye) {
    const forward = camera.getWorldDirection(new THREE.Vector3()), eye = camera.getWorldPosition(new THREE.Vector3());
    let best = null, bestScore = 0;
    for (const [index, panorama] of this.panoramas.entries()) {
      if (!this.rings[index].visible || panorama === this.here) continue;
      const there = panorama.center.clone().sub(eye);
      const score = Math.max(0, there.clone().normalize().dot(forward) - 0.5) / Math.sqrt(there.length() + 1e-9);
      if (score > bestScore) [best, bestScore] = [panorama, score];
    }
    return best;
  }

  nearest() {
    const { target } = this.mode === "plan" ? this.glide : this.orbit;
    const usable = this.panoramas.filter((panorama) => panorama.camera.levels > 0);
    return usable.sort((a, b) => a.center.distanceTo(target) - b.center.distanceTo(target))[0];
  }

  turn(yaw, pitch) {
    this.look.yaw += yaw;
    this.look.pitch = THREE.MathUtils.clamp(this.look.pitch + pitch, -1.55, 1.55);
    this.moved();
  }

  zoom(factor) {
    this.look.fov = THREE.MathUtils.clamp(this.look.fov * factor, 15, 110);
    this.moved();
  }

  // --- Tools ---

  raycaster(x, y) {
    const caster = new THREE.Raycaster();
    const place = new THREE.Vector2((x / this.canvas.clientWidth) * 2 - 1, 1 - (y / this.canvas.clientHeight) * 2);
    this.camera.updateMatrixWorld();
    caster.setFromCamera(place, this.camera);
    return caster;
  }

  /** Return the point of the scene below a pixel of the window, with its uncertainty; null if there is none. */
  pick(x, y) {
    const caster = this.raycaster(x, y);
    if (this.mode === "inside") return this.here.pick(caster.ray.direction);
    return this.surfaceShown ? this.surface.pick(caster) : this.cloud.pick(caster, this.camera, this.canvas.clientHeight);
  }

  click(x, y) {
    this.canvas.focus({ preventScroll: true });
    if (this.move) return;
    if (this.measuring) return this.mark(x, y);
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

  /** Mark the point of the scene below a pixel of the window. */
  mark(x, y) {
    const picked = this.pick(x, y);
    if (picked) this.ruler.add(picked, this.here);
    else say("Nothing was measured there. Choose a surface.");
    this.writeLink();
    this.changed();
  }

  measure(on) {
    this.measuring = on;
    element("measure").setAttribute("aria-pressed", String(on));
    this.ruler.clear();
    if (on) say("Click two points, or aim with the arrow keys and press Enter.");
    this.showAim();
    this.changed();
  }

  /** Say whether keys or pointers are used: with keys, a cross hair shows what Enter marks, and a larger ring where it leads. */
  useKeys(on) {
    if (this.keys === on) return;
    this.keys = on;
    this.showAim();
    this.changed();
  }

  showAim() { element("aim").hidden = !(this.keys && this.measuring); }

  /** Tell a screen reader, once the view stands still, what lies in the middle of the window. */
  describe() {
    clearTimeout(this.describing);
    this.describing = setTimeout(() => {
      if (this.mode !== "inside" || !this.here || this.move) return;
      const parts = [`Facing ${Math.round((THREE.MathUtils.radToDeg(this.look.yaw) % 360 + 360) % 360) % 360}°`];
      const ahead = this.ahead(), seen = this.here.pick(this.eye.getWorldDirection(new THREE.Vector3()));
      if (seen) parts.push(`surface at ${lengthText(seen.point.distanceTo(this.here.center), this.scene.unit)}`);
      parts.push(ahead ? `Enter walks to ${ahead.camera.title}, ${lengthText(ahead.center.distanceTo(this.here.center), this.scene.unit)} away` : "no panorama ahead");
      element("facing").textContent = parts.join(", ");
    }, 400);
  }

  coverage(on) {
    if (on === this.covered) return;
    this.covered = this.map.coverage = on;
    this.cloud.material.uniforms.coverage.value = on;
    if (this.surface) this.surface.uniforms.coverage.value = on;
    element("coverage").setAttribute("aria-pressed", String(on));
    if (on && this.mode === "inside") this.overview();
    else if (this.mode) this.enter(this.mode);
    say(on ? "Red: confirmed by one panorama, yellow: by three or four, green: by six and more." : "");
    this.changed();
  }

  /** Show the surface, or else the points. */
  showSurface(on) {
    this.surfaceShown = on && Boolean(this.surface);
    if (this.surface) this.surface.group.visible = this.surfaceShown;
    this.cloud.group.visible = !this.surfaceShown;
    element("surface").textContent = this.surfaceShown ? "Show points" : "Show surface";
    this.changed();
  }

  /** Show or hide a panel. The focus goes into an opened list, and back to its button when it was in a closed panel. */
  toggle(button, panel) {
    const shown = element(panel), hidden = !shown.hidden;
    if (hidden && shown.contains(document.activeElement)) element(button).focus();
    shown.hidden = hidden;
    element(button).setAttribute("aria-expanded", String(!hidden));
    if (!hidden) (shown.querySelector("[aria-current=true]") ?? shown.querySelector("li button:enabled"))?.focus();
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
      button.textContent = panorama.camera.title;
      button.disabled = !panorama.camera.levels;
      button.addEventListener("click", () => this.visit(panorama));
      row.append(button);
      element("panoramas").querySelector("ol").append(row);
    }
  }

  writeLink() {
    if (this.mode === undefined || (this.mode === "inside" && !this.here)) return;
    this.link = linkOf(this);
    if (location.protocol !== "about:") history.replaceState(null, "", this.link); // in a notebook it has no address
  }

  // --- Drawing ---

  /** Fit the scene into a window of another shape, unless somebody has moved it. */
  reframe() {
    this.resize();
    if (this.mode === "overview" && !this.move && this.opening?.equals(this.eye.position)) this.overview();
  }

  resize() {
    if (this.renderer.xr.isPresenting) return; // the headset has its own size
    const { clientWidth: width, clientHeight: height } = this.canvas;
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2) * this.resolution);
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
    if (this.headset.session) return; // it draws itself
    if (this.move) this.moved();
    const pace = this.pace.moving(now) ? this.pace.frame(now) : this.cloud.loading ? PACES[3] : this.pace.frame(now);
    if (pace.resolution !== this.resolution || (pace === PACES[0] && this.coarse)) {
      this.coarse = false;
      if (pace.resolution !== this.resolution) {
        this.resolution = pace.resolution;
        this.resize();
      }
      this.changed();
    }
    if (!this.dirty || (this.mode === "inside" && !this.here)) return; // or a link leads to a panorama on its way
    this.dirty = false;
    this.coarse = pace !== PACES[0];
    const t = this.move ? Math.min(1, Math.max(0, (now - this.move.began) / this.move.length)) : 1;
    const smooth = t * t * (3 - 2 * t);
    if (this.move || (this.mode === "inside" && this.here)) this.lookFrom(smooth);
    this.draw(smooth, pace);
    if (!this.firstPicture && this.hasPicture) this.loadRest(now);
    if (this.settled) this.firstComplete ??= performance.now(); // for measurements
    if (this.move && t >= 1) {
      this.move = null;
      if (this.mode !== "inside") this.enter("inside");
      this.placeRings();
      this.describe();
      this.writeLink();
      this.changed();
    }
  }

  /** Whether everything that the view needs was loaded and drawn. */
  get settled() {
    return !this.dirty && !this.move && !this.wanted && !this.coarse && !this.loading && !this.here?.loading;
  }

  /** Whether there is something to see of all that the view shows, however coarse. */
  get hasPicture() {
    if (this.mode === "inside") return Boolean(this.here?.group.children.length) && !this.move;
    return this.surfaceShown ? this.surface.ready : this.cloud.begun;
  }

  /** Load what can wait until after the first picture. */
  loadRest(now) {
    this.firstPicture = now;
    this.map.open();
    if (this.surfaceShown) this.surface.open(false);
    this.changed();
  }

  /** Whether parts of the scene are on their way. */
  get loading() { return this.cloud.loading + (this.surface?.loading ?? 0) > 0; }

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

  draw(t, pace) {
    const { renderer, camera } = this;
    const height = this.canvas.clientHeight * renderer.getPixelRatio();
    renderer.setClearColor(getComputedStyle(document.documentElement).getPropertyValue("--ground").trim());
    renderer.clear();
    camera.updateMatrixWorld();
    if (this.mode === "inside" || this.move) this.drawPanoramas(t, height, pace);
    else this.drawWorld(height, pace);
    renderer.clearDepth();
    const ahead = this.keys && this.mode === "inside" ? this.ahead() : null;
    for (const [index, ring] of this.rings.entries()) ring.scale.setScalar((this.panoramas[index] === ahead ? 1.6 : 1) * (camera === this.above ? (0.05 * this.halfHeight) / this.above.zoom : 0.04 * Math.tan(THREE.MathUtils.degToRad(this.eye.fov) / 2)));
    renderer.render(this.marks, camera);
    this.ruler.place(camera, this.canvas.clientWidth, this.canvas.clientHeight);
    this.rooms.place(this.mode === "inside" || this.move ? null : camera, this.canvas.clientWidth, this.canvas.clientHeight);
    const forward = this.eye.getWorldDirection(new THREE.Vector3());
    this.map.look(this.mode === "plan" ? null : this.eye.position, Math.atan2(forward.x, -forward.z));
  }

  drawWorld(height, pace, camera = this.camera) {
    if (this.surfaceShown) {
      this.surface.open(Boolean(this.firstPicture));
      this.surface.detail(pace.coarse);
    } else this.cloud.update(camera, height, pace.points);
    this.renderer.render(this.world, camera);
  }

  drawPanoramas(t, height, pace) {
    const { move, here, renderer, eye } = this;
    here.update(eye, (height / this.resolution));
    here.fromElsewhere(Boolean(move), move?.from);
    move?.from?.fromElsewhere(true, here);
    if (!move) return renderer.render(here.group, eye);
    if (move.flight) this.drawWorld(height, pace);
    const opacity = move.flight ? THREE.MathUtils.smoothstep(t, 0.55, 1) : 1;
    const scene = !move.flight && this.surfaceShown && this.surface.ready ? this.world : null;
    if (scene) this.surface.detail(true);
    this.walkView.draw(move.from, move.to, scene, eye, { t, opacity });
  }
}

PanoMvs.load("scene").then((scene) => {
  PanoMvs.page = new Page(scene);
}).catch(problem);
