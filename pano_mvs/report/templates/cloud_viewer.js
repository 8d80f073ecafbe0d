"use strict";
// The cloud, drawn with WebGL and turned by dragging, keys and buttons. Without WebGL, the images below remain.
(function () {
  const box = document.getElementById("viewer");
  if (!box) return;
  const canvas = box.querySelector("canvas"), caption = document.getElementById("viewer-place");
  const gl = canvas.getContext("webgl", {antialias: true, alpha: false});
  const stored = JSON.parse(document.getElementById("facts").textContent)[box.dataset.key];
  if (!gl || !stored) return;
  const cameras = JSON.parse(box.dataset.cameras);

  // Shaders: points as squares as large as their distance from each other, cameras as discs.
  const POINT = "attribute vec3 place, normal, color; uniform mat4 clipFromLevel; uniform vec3 lower, eye; uniform float size, pixels;" +
    "varying vec3 shown; void main() { vec3 at = lower + size * place, towards = eye - at; gl_Position = clipFromLevel * vec4(at, 1.0);" +
    "gl_PointSize = clamp(pixels / gl_Position.w, 1.5, 48.0); shown = color;" +
    "if (dot(towards, normal) < -0.05 * length(towards)) gl_Position = vec4(2.0, 2.0, 2.0, 1.0); }";
  const CAMERA = "attribute vec3 place, color; uniform mat4 clipFromLevel; uniform float pixels; varying vec3 shown;" +
    "void main() { gl_Position = clipFromLevel * vec4(place, 1.0); gl_PointSize = pixels; shown = color; }";
  const SQUARE = "precision mediump float; varying vec3 shown; void main() { gl_FragColor = vec4(shown, 1.0); }";
  const DISC = "precision mediump float; varying vec3 shown; void main() { float r = 2.0 * length(gl_PointCoord - 0.5);" +
    "if (r > 1.0) discard; gl_FragColor = vec4(r > 0.74 ? vec3(1.0) : shown, 1.0); }";
  const program = function (vertex, fragment) {
    const made = gl.createProgram();
    for (const part of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(part[0]);
      gl.shaderSource(shader, part[1]);
      gl.compileShader(shader);
      gl.attachShader(made, shader);
    }
    gl.linkProgram(made);
    return gl.getProgramParameter(made, gl.LINK_STATUS) ? made : null;
  };
  const pointProgram = program(POINT, SQUARE), cameraProgram = program(CAMERA, DISC);
  if (!pointProgram || !cameraProgram) return;
  const buffer = function (data) {
    const made = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, made);
    gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
    return made;
  };
  const binary = atob(stored.data), bytes = new Uint8Array(binary.length);
  for (let i = 0; i < binary.length; i++) bytes[i] = binary.charCodeAt(i);
  const points = buffer(bytes);
  const cameraData = new Float32Array(6 * cameras.length);
  cameras.forEach(function (camera, i) { cameraData.set([camera[0], camera[1], camera[2]].concat(camera[3] ? [0.84, 0.15, 0.12] : [0.10, 0.38, 0.82]), 6 * i); });
  const cameraPoints = buffer(cameraData);

  // The view: from `distance` behind a target, which is 0 inside a camera.
  const OUTSIDE_FOV = 0.7, INSIDE_FOV = 1.4, STEP = 0.12;
  const view = {target: stored.middle, yaw: 0, pitch: 0, distance: 1, fov: OUTSIDE_FOV};
  let shownCameras = true, inside = -1, asked = false;
  const named = cameras.map(function (camera, i) { return i; }).filter(function (i) { return cameras[i][4]; });
  const fitted = function () { return 0.95 * stored.radius / Math.sin(OUTSIDE_FOV / 2) / Math.min(1, canvas.clientWidth / Math.max(1, canvas.clientHeight)); };
  const look = function (yaw, pitch, text) {
    Object.assign(view, {target: stored.middle.slice(), yaw: yaw, pitch: pitch, distance: fitted(), fov: OUTSIDE_FOV});
    inside = -1;
    tell(text);
  };
  const tell = function (text) {
    caption.textContent = text;
    changed();
  };
  const stepInside = function () {
    inside = named[(named.indexOf(inside) + 1) % named.length];
    const camera = cameras[inside], center = stored.middle;
    const yaw = Math.atan2(center[0] - camera[0], camera[2] - center[2]);
    Object.assign(view, {target: camera.slice(0, 3), yaw: yaw, pitch: 0, distance: 0, fov: INSIDE_FOV});
    tell("Where " + camera[4] + " was taken");
  };
  const limited = function () {
    view.pitch = Math.min(1.57, Math.max(-1.57, view.pitch));
    view.fov = Math.min(2, Math.max(0.2, view.fov));
    if (view.distance) view.distance = Math.min(8 * stored.radius, Math.max(0.02 * stored.radius, view.distance));
    changed();
  };
  const turn = function (across, down) { // in radians, as a hand would turn the model, or the head inside
    const sign = view.distance ? 1 : -1;
    view.yaw += sign * across;
    view.pitch -= sign * down;
    limited();
  };
  const zoom = function (factor) {
    if (view.distance) view.distance /= factor;
    else view.fov /= factor;
    limited();
  };
  const axes = function () {
    const cy = Math.cos(view.yaw), sy = Math.sin(view.yaw), cp = Math.cos(view.pitch), sp = Math.sin(view.pitch);
    return {right: [cy, 0, sy], up: [-sp * sy, cp, sp * cy], ahead: [cp * sy, sp, -cp * cy]};
  };
  const move = function (across, down) { // in pixels
    const to = axes(), scale = 2 * view.distance * Math.tan(view.fov / 2) / canvas.clientHeight;
    view.target = view.target.map(function (value, i) { return value + scale * (down * to.up[i] - across * to.right[i]); });
    changed();
  };

  const changed = function () {
    if (asked) return;
    asked = true;
    requestAnimationFrame(draw);
  };
  const draw = function () {
    asked = false;
    const dense = Math.min(2, window.devicePixelRatio || 1);
    const width = Math.round(canvas.clientWidth * dense), height = Math.round(canvas.clientHeight * dense);
    if (!width || !height || gl.isContextLost()) return;
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, {width: width, height: height});
    gl.viewport(0, 0, width, height);
    const ground = getComputedStyle(canvas).backgroundColor.match(/[\d.]+/g).map(Number);
    gl.clearColor(ground[0] / 255, ground[1] / 255, ground[2] / 255, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const to = axes(), eye = view.target.map(function (value, i) { return value - view.distance * to.ahead[i]; });
    const near = Math.max(view.distance - 3 * stored.radius, 0.002 * stored.radius), far = view.distance + 6 * stored.radius;
    const f = 1 / Math.tan(view.fov / 2), a = f * height / width;
    const dot = function (axis) { return axis[0] * eye[0] + axis[1] * eye[1] + axis[2] * eye[2]; };
    const zScale = (far + near) / (far - near), zShift = -2 * far * near / (far - near), r = to.right, u = to.up, d = to.ahead;
    const matrix = [a * r[0], f * u[0], zScale * d[0], d[0], a * r[1], f * u[1], zScale * d[1], d[1], a * r[2], f * u[2], zScale * d[2], d[2],
      -a * dot(r), -f * dot(u), -zScale * dot(d) + zShift, -dot(d)];
    const use = function (made, data, stride, parts) {
      gl.useProgram(made);
      gl.bindBuffer(gl.ARRAY_BUFFER, data);
      for (let i = 0; i < 3; i++) gl.disableVertexAttribArray(i);
      for (const part of parts) {
        const at = gl.getAttribLocation(made, part[0]);
        gl.enableVertexAttribArray(at);
        gl.vertexAttribPointer(at, 3, part[1], true, stride, part[2]);
      }
      gl.uniformMatrix4fv(gl.getUniformLocation(made, "clipFromLevel"), false, matrix);
    };
    gl.enable(gl.DEPTH_TEST);
    use(pointProgram, points, 12, [["place", gl.UNSIGNED_SHORT, 0], ["normal", gl.BYTE, 6], ["color", gl.UNSIGNED_BYTE, 9]]);
    gl.uniform3fv(gl.getUniformLocation(pointProgram, "lower"), stored.lower);
    gl.uniform3fv(gl.getUniformLocation(pointProgram, "eye"), eye);
    gl.uniform1f(gl.getUniformLocation(pointProgram, "size"), stored.size);
    gl.uniform1f(gl.getUniformLocation(pointProgram, "pixels"), 1.5 * stored.spacing * f * height / 2);
    gl.drawArrays(gl.POINTS, 0, stored.count);
    if (shownCameras && cameras.length) {
      gl.disable(gl.DEPTH_TEST);
      use(cameraProgram, cameraPoints, 24, [["place", gl.FLOAT, 0], ["color", gl.FLOAT, 12]]);
      gl.uniform1f(gl.getUniformLocation(cameraProgram, "pixels"), (cameras.length > 60 ? 7 : 12) * dense);
      gl.drawArrays(gl.POINTS, 0, cameras.length);
    }
  };

  // Pointers: one turns, two zoom and move, as does the right button; the wheel zooms after a click.
  const held = new Map();
  const spread = function () {
    const both = Array.from(held.values());
    return Math.hypot(both[0].x - both[1].x, both[0].y - both[1].y);
  };
  canvas.addEventListener("pointerdown", function (event) {
    canvas.focus({preventScroll: true});
    canvas.setPointerCapture(event.pointerId);
    held.set(event.pointerId, {x: event.clientX, y: event.clientY});
  });
  canvas.addEventListener("pointermove", function (event) {
    const last = held.get(event.pointerId);
    if (!last) return;
    const across = event.clientX - last.x, down = event.clientY - last.y, before = held.size === 2 ? spread() : 0;
    Object.assign(last, {x: event.clientX, y: event.clientY});
    if (held.size === 2) {
      if (before) zoom(spread() / before);
      move(across / 2, down / 2);
    } else if (event.buttons === 2 || event.shiftKey) {
      move(across, down);
    } else {
      const perPixel = view.distance ? 3 / canvas.clientHeight : view.fov / canvas.clientHeight;
      turn(across * perPixel, down * perPixel);
    }
  });
  const release = function (event) { held.delete(event.pointerId); };
  canvas.addEventListener("pointerup", release);
  canvas.addEventListener("pointercancel", release);
  canvas.addEventListener("contextmenu", function (event) { event.preventDefault(); });
  canvas.addEventListener("wheel", function (event) {
    if (document.activeElement !== canvas) return;
    event.preventDefault();
    zoom(Math.exp(-0.0015 * event.deltaY));
  }, {passive: false});
  const KEYS = {ArrowLeft: [-STEP, 0], ArrowRight: [STEP, 0], ArrowUp: [0, -STEP], ArrowDown: [0, STEP]};
  canvas.addEventListener("keydown", function (event) {
    if (event.ctrlKey || event.altKey || event.metaKey) return;
    if (KEYS[event.key]) {
      const sign = view.distance ? 1 : -1;
      turn(sign * KEYS[event.key][0], -KEYS[event.key][1]);
    } else if (event.key === "+" || event.key === "=") zoom(1.2);
    else if (event.key === "-") zoom(1 / 1.2);
    else return;
    event.preventDefault();
  });
  canvas.addEventListener("webglcontextlost", function () {
    box.hidden = true;
    box.parentElement.classList.remove("turnable");
  });

  const press = function (id, action) { document.getElementById(id).addEventListener("click", action); };
  press("viewer-outside", function () { look(-0.61, -0.73, "From outside"); });
  press("viewer-above", function () { look(0, -1.57, "From above"); });
  press("viewer-inside", stepInside);
  press("viewer-closer", function () { zoom(1.25); });
  press("viewer-farther", function () { zoom(0.8); });
  press("viewer-cameras", function (event) {
    shownCameras = !shownCameras;
    event.currentTarget.setAttribute("aria-pressed", String(shownCameras));
    changed();
  });
  document.getElementById("viewer-inside").hidden = !named.length;
  box.hidden = false;
  box.parentElement.classList.add("turnable");
  look(-0.61, -0.73, "From outside");
  new ResizeObserver(changed).observe(canvas);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", changed);
})();
