"use strict";
// The surface: a mesh in pieces, with one texture or with coloured vertices; before it a coarse one, which arrives sooner.

const SURFACE_VERTEX = `
#ifdef TEXTURED
varying vec2 place;
#else
attribute vec3 color;
varying vec3 own;
#endif
attribute float views;
varying float seen; varying float height;
void main() {
  vec4 inWorld = modelMatrix * vec4(position, 1.0);
  gl_Position = projectionMatrix * viewMatrix * inWorld;
  height = inWorld.y;
  seen = views;
#ifdef TEXTURED
  place = uv;
#else
  own = color;
#endif
}`;
const SURFACE_FRAGMENT = `
#ifdef TEXTURED
uniform sampler2D map;
varying vec2 place;
#else
varying vec3 own;
#endif
uniform float cut; uniform bool coverage;
varying float seen; varying float height;
${COVERAGE_RAMP}
void main() {
  if (height > cut) discard;
#ifdef TEXTURED
  vec3 color = texture2D(map, place).rgb;
#else
  vec3 color = own;
#endif
  gl_FragColor = vec4(coverage ? coverageColor(seen, color) : color, 1.0);
}`;

const COARSE_FACES = 50_000; // about so many triangles while the view moves, if more are too slow

class Surface {
  constructor(described, sigmas, changed) {
    this.described = described;
    this.sigmas = sigmas;
    this.changed = changed;
    this.group = new THREE.Group();
    this.loading = 0;
    this.opened = this.refined = null;
    this.ready = false;
    this.uniforms = { map: { value: null }, cut: { value: 1e30 }, coverage: { value: false } };
    [this.colored, this.textured] = [{}, { TEXTURED: 1 }].map((defines) => new THREE.ShaderMaterial({
      vertexShader: SURFACE_VERTEX, fragmentShader: SURFACE_FRAGMENT, defines, uniforms: this.uniforms,
    }));
  }

  /** Load the coarse surface, if there is one, and then or as soon as `whole` is true the whole one. */
  open(whole) {
    const { coarse } = this.described;
    this.opened ??= this.load(async () => {
      if (coarse.length) this.show(await this.parts("mesh/coarse", coarse, false));
    });
    if (whole || !coarse.length) this.refined ??= this.load(() => this.opened.then(() => this.loadWhole()));
  }

  /** Do what loads, and return a promise that is kept in the end. */
  load(task) {
    this.loading++;
    return task().catch(problem).finally(() => {
      this.loading--;
      this.changed();
    });
  }

  async loadWhole() {
    const { pieces, textured } = this.described;
    const texture = textured ? PanoMvs.load("mesh/texture").then((text) => textureOf(text, "the texture")) : null;
    const parts = await this.parts("mesh", pieces, textured);
    this.uniforms.map.value = await texture;
    this.show(parts);
    this.makeCoarse();
  }

  /** Load the pieces of a surface, and return them as meshes. */
  async parts(folder, pieces, textured) {
    const parts = [];
    for (let first = 0; first < pieces.length; first += LOADS_AT_ONCE) {
      const some = pieces.slice(first, first + LOADS_AT_ONCE);
      parts.push(...await Promise.all(some.map(async (piece, idx) => this.part(piece, await PanoMvs.load(`${folder}/${first + idx}`), textured))));
    }
    return parts;
  }

  /** Show these meshes instead of earlier ones. */
  show(parts) {
    for (const { geometry } of this.group.children) geometry.dispose();
    this.group.clear();
    this.group.add(...parts);
    this.ready = true;
  }

  /** Compute coarser indices of the same vertices, one piece after the other, so that the page stays responsive. */
  async makeCoarse() {
    const faces = this.described.pieces.reduce((sum, piece) => sum + piece.faces, 0);
    if (faces < 1.5 * COARSE_FACES) return;
    for (const { geometry, userData } of this.group.children) {
      await new Promise((resolve) => setTimeout(resolve));
      const indices = geometry.index.array, places = geometry.attributes.position.array;
      userData.whole = geometry.index;
      userData.coarse = new THREE.BufferAttribute(coarser(indices, places, Math.sqrt(faces / COARSE_FACES)), 1);
    }
  }

  /** Draw the coarser surface, or all of it. */
  detail(coarse) {
    for (const { geometry, userData } of this.group.children) {
      if (userData.coarse) geometry.setIndex(coarse ? userData.coarse : userData.whole);
    }
  }

  part(piece, text, textured) {
    const bytes = bytesOf(text).buffer, count = piece.vertices;
    const geometry = new THREE.BufferGeometry();
    let offset = 0;
    const next = (kind, length) => {
      const values = new kind(bytes, offset, length);
      offset += values.byteLength;
      return values;
    };
    geometry.setAttribute("position", new THREE.BufferAttribute(next(Uint16Array, 3 * count), 3, true));
    if (textured) geometry.setAttribute("uv", new THREE.BufferAttribute(next(Uint16Array, 2 * count), 2, true));
    geometry.setIndex(new THREE.BufferAttribute(next(Uint16Array, 3 * piece.faces), 1));
    if (!textured) geometry.setAttribute("color", new THREE.BufferAttribute(next(Uint8Array, 3 * count), 3, true));
    const sigmaSteps = next(Uint8Array, count);
    geometry.setAttribute("views", new THREE.BufferAttribute(next(Uint8Array, count), 1, true));
    const mesh = new THREE.Mesh(geometry, textured ? this.textured : this.colored);
    mesh.position.set(...piece.lower);
    mesh.scale.setScalar(piece.size);
    mesh.updateMatrixWorld(true);
    mesh.userData.sigmaSteps = sigmaSteps;
    return mesh;
  }

  /** Return the first point of the surface along a ray, and its uncertainty; null if there is none. */
  pick(raycaster) {
    this.detail(false);
    const hit = raycaster.intersectObjects(this.group.children, false).find((found) => found.point.y <= this.uniforms.cut.value);
    if (!hit) return null;
    return { point: hit.point, sigma: valueOfStep(hit.object.userData.sigmaSteps[hit.face.a], this.sigmas, 255), ray: null };
  }
}

/** Return triangles with the vertices of one cell of a grid joined into one of them; those that collapse are left out.
 *
 * A cell is `factor` mean edges wide. Vertices at open edges stay, where other pieces or other parts of the texture
 * continue the surface.
 */
function coarser(indices, places, factor) {
  const open = new Set();
  let sum = 0;
  for (let i = 0; i < indices.length; i++) {
    const a = indices[i], b = indices[i % 3 === 2 ? i - 2 : i + 1], edge = Math.min(a, b) * 65536 + Math.max(a, b);
    if (!open.delete(edge)) open.add(edge);
    sum += Math.hypot(places[3 * a] - places[3 * b], places[3 * a + 1] - places[3 * b + 1], places[3 * a + 2] - places[3 * b + 2]);
  }
  const stays = new Uint8Array(places.length / 3);
  for (const edge of open) stays[Math.floor(edge / 65536)] = stays[edge % 65536] = 1;
  const cell = Math.max(1, (1.2 * factor * sum) / indices.length);
  const cells = Math.ceil(65536 / cell) + 1, chosen = new Map(), joined = new Uint16Array(stays.length);
  for (let i = 0; i < joined.length; i++) {
    const key = (Math.floor(places[3 * i] / cell) * cells + Math.floor(places[3 * i + 1] / cell)) * cells + Math.floor(places[3 * i + 2] / cell);
    if (!stays[i] && !chosen.has(key)) chosen.set(key, i);
    joined[i] = stays[i] ? i : chosen.get(key);
  }
  const kept = [];
  for (let i = 0; i < indices.length; i += 3) {
    const a = joined[indices[i]], b = joined[indices[i + 1]], c = joined[indices[i + 2]];
    if (a === b || b === c || c === a) continue;
    const before = normalOf(places, indices[i], indices[i + 1], indices[i + 2]), after = normalOf(places, a, b, c);
    if (before[0] * after[0] + before[1] * after[1] + before[2] * after[2] > 0) kept.push(a, b, c); // not turned over
  }
  return new Uint16Array(kept);
}

/** Return the normal of a triangle, as long as twice its area. */
function normalOf(places, a, b, c) {
  const ux = places[3 * b] - places[3 * a], uy = places[3 * b + 1] - places[3 * a + 1], uz = places[3 * b + 2] - places[3 * a + 2];
  const vx = places[3 * c] - places[3 * a], vy = places[3 * c + 1] - places[3 * a + 1], vz = places[3 * c + 2] - places[3 * a + 2];
  return [uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx];
}
