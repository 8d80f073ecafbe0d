"use strict";
// Panoramas projected on their own range maps, so that a walk from one to the next looks like a move.

const COLUMNS = 256; // quadrilaterals of the whole sphere
const ROWS = 128;
const DOME_COLUMNS = 128; // of the sphere that is drawn from the centre
const TILES_AT_ONCE = 3;
const MAX_TILES = 24; // of one panorama in memory
const TORN_RATIO = 1.15; // a quadrilateral whose corners differ by more is torn, unless it continues a plane
const TORN = 0.25; // alpha of torn parts while walking
const DOUBTFUL = 0.5; // and of parts whose place is doubtful

// Where a quadrilateral is torn, it is drawn at the nearer and at the farther range: `split` is the range between, as
// a value of the texture of ranges, positive for the part in front of it and negative for the part behind.
const TILE_VERTEX = `
attribute vec2 whole; attribute float split;
varying vec2 place; varying vec2 inWhole; varying float limit; varying vec3 inPage;
void main() {
  place = uv; inWhole = whole; limit = split;
  vec4 at = modelMatrix * vec4(position, 1.0);
  inPage = at.xyz;
  gl_Position = projectionMatrix * viewMatrix * at;
}`;
// A part is doubtful if it has no range of its own, or if the other panorama of a walk sees through it.
const TILE_FRAGMENT = `
uniform sampler2D map, ranges, otherRanges;
uniform mat4 otherFromPage; uniform vec2 otherLogs;
uniform float alpha; uniform bool hasOther;
varying vec2 place; varying vec2 inWhole; varying float limit; varying vec3 inPage;
bool doubtful(float known) {
  if (!hasOther) return false;
  vec3 there = (otherFromPage * vec4(inPage, 1.0)).xyz;
  float range = length(there);
  vec2 seen = texture2D(otherRanges, vec2(atan(there.x, there.z) / 6.2831853 + 0.5, asin(clamp(there.y / range, -1.0, 1.0)) / 3.1415927 + 0.5)).rg;
  return known < 0.5 || (seen.g > 0.5 && (log(range) + 0.2 - otherLogs.x) / otherLogs.y < seen.r);
}
void main() {
#ifdef DOME
  gl_FragColor = vec4(texture2D(map, place).rgb, 1.0);
  return;
#endif
  vec2 range = texture2D(ranges, inWhole).rg;
  if (limit > 0.0 ? range.r > limit : limit < 0.0 && range.r <= -limit) discard;
  gl_FragColor = vec4(texture2D(map, place).rgb, alpha == 1.0 && doubtful(range.g) ? ${DOUBTFUL} : alpha);
}`;

class Panorama {
  constructor(index, camera, rangesHw, changed) {
    this.index = index;
    this.camera = camera;
    this.changed = changed;
    [this.rangeRows, this.rangeColumns] = rangesHw;
    this.ranges = null; // Float32Array, 0 where there is none
    this.torn = null; // of each quadrilateral
    this.rangeTexture = null; // logarithms of the ranges without gaps, from 0 to 1, and whether they are known
    this.logs = null; // the logarithm that 0 stands for, and how much more 1 stands for
    this.elsewhere = false; // whether it is drawn as seen from elsewhere than its centre
    this.other = { otherRanges: { value: null }, otherFromPage: { value: new THREE.Matrix4() }, otherLogs: { value: new THREE.Vector2(0, 1) }, hasOther: { value: false } };
    this.sigmaSteps = null;
    this.far = camera.ranges ? Math.sqrt(camera.ranges[0] * camera.ranges[1]) : 5;
    this.tiles = new Map();
    this.loading = 0;
    this.group = new THREE.Group();
    const [a, b, c] = camera.page_from_cam;
    this.group.matrix.set(a[0], a[1], a[2], camera.center[0], b[0], b[1], b[2], camera.center[1], c[0], c[1], c[2], camera.center[2], 0, 0, 0, 1);
    this.group.matrixAutoUpdate = false;
    this.group.updateMatrixWorld(true);
    this.camFromPage = this.group.matrix.clone().invert();
    this.center = new THREE.Vector3(...camera.center);
    this.opened = null;
  }

  /** Return a promise that is kept when the panorama can be seen. */
  open() {
    this.opened ??= Promise.all([this.loadRanges(), this.camera.levels ? PanoMvs.load(`panorama/${this.index}/0-0-0`) : null])
      .then(([, text]) => (text ? this.addTile(0, 0, 0, text) : null))
      .catch((error) => {
        this.opened = null; // so that it can be tried again
        throw error;
      });
    return this.opened;
  }

  async loadRanges() {
    if (this.camera.ranges) {
      const sigmas = this.camera.sigmas ? PanoMvs.load(`panorama/${this.index}/sigmas`) : null;
      const steps = new Uint16Array(bytesOf(await PanoMvs.load(`panorama/${this.index}/ranges`)).buffer);
      const [low, high] = this.camera.ranges;
      const factor = Math.log(high / low) / 65534;
      this.ranges = Float32Array.from(steps, (step) => (step ? low * Math.exp((step - 1) * factor) : 0));
      if (sigmas) this.sigmaSteps = bytesOf(await sigmas);
    }
    this.makeGrid();
  }

  /** Return the ray of a place of the panorama in its camera's frame; u and v are fractions of width and height. */
  static ray(u, v) {
    const azimuth = 2 * Math.PI * (u - 0.5), elevation = Math.PI * (0.5 - v);
    return new THREE.Vector3(Math.cos(elevation) * Math.sin(azimuth), -Math.sin(elevation), Math.cos(elevation) * Math.cos(azimuth));
  }

  /** Return the place in the panorama of a direction in the page's frame. */
  place(direction) {
    const ray = direction.clone().transformDirection(this.camFromPage);
    return [Math.atan2(ray.x, ray.z) / (2 * Math.PI) + 0.5, 0.5 - Math.atan2(-ray.y, Math.hypot(ray.x, ray.z)) / Math.PI];
  }

  /** Return the index of the pixel of the range map at a place. */
  pixel(u, v) {
    const x = ((Math.floor(u * this.rangeColumns) % this.rangeColumns) + this.rangeColumns) % this.rangeColumns;
    const y = Math.min(this.rangeRows - 1, Math.max(0, Math.floor(v * this.rangeRows)));
    return y * this.rangeColumns + x;
  }

  /** Return the range of the pixel at a place; 0 if it has none. */
  range(u, v) { return this.ranges ? this.ranges[this.pixel(u, v)] : 0; }

  /** Return the range between the centres of four pixels if they lie on one surface, else that of the pixel. */
  smoothRange(u, v) {
    const x = u * this.rangeColumns - 0.5, y = v * this.rangeRows - 0.5;
    const fx = x - Math.floor(x), fy = y - Math.floor(y);
    const at = (dx, dy) => this.range((Math.floor(x) + dx + 0.5) / this.rangeColumns, (Math.floor(y) + dy + 0.5) / this.rangeRows);
    const four = [at(0, 0), at(1, 0), at(0, 1), at(1, 1)];
    const nearest = Math.min(...four);
    if (nearest <= 0 || Math.max(...four) > 1.08 * nearest) return this.range(u, v);
    // Along a plane the inverse of the range is what is linear.
    return 1 / ((1 - fy) * ((1 - fx) / four[0] + fx / four[1]) + fy * ((1 - fx) / four[2] + fx / four[3]));
  }

  /** Compute the ranges of the corners of the quadrilaterals, fill their gaps, and find the torn ones. */
  makeGrid() {
    const { rangeRows: height, rangeColumns: width } = this;
    const inverse = new Float32Array(width * height);
    if (this.ranges) for (let i = 0; i < inverse.length; i++) inverse[i] = this.ranges[i] > 0 ? 1 / this.ranges[i] : 0;
    const filled = filledGaps(inverse, width, height, 1 / this.far);
    const [low, high] = this.camera.ranges ?? [this.far / 2, this.far * 2];
    this.step = (range) => THREE.MathUtils.clamp(Math.log(range / low) / Math.log(high / low), 0, 1);
    this.logs = new THREE.Vector2(Math.log(low), Math.log(high / low));
    this.makeRangeTexture(filled);
    const at = (x, y) => filled[Math.min(height - 1, Math.max(0, Math.round((y * height) / ROWS))) * width + (Math.round((x * width) / COLUMNS) + width) % width];
    this.cornerRange = (x, y) => 1 / at(x, y);
    // Whether two neighbours, of which the next ones on either side are given, lie on two surfaces.
    const jumps = (before, a, b, after) => {
      if (Math.max(a, b) < TORN_RATIO * Math.min(a, b)) return false;
      return Math.min(Math.abs(b - 2 * a + before), Math.abs(a - 2 * b + after)) > 0.3 * Math.abs(b - a);
    };
    this.torn = new Uint8Array(COLUMNS * ROWS);
    for (let y = 0; y < ROWS; y++) {
      for (let x = 0; x < COLUMNS; x++) {
        const rows = jumps(at(x - 1, y), at(x, y), at(x + 1, y), at(x + 2, y)) || jumps(at(x - 1, y + 1), at(x, y + 1), at(x + 1, y + 1), at(x + 2, y + 1));
        const columns = jumps(at(x, y - 1), at(x, y), at(x, y + 1), at(x, y + 2)) || jumps(at(x + 1, y - 1), at(x + 1, y), at(x + 1, y + 1), at(x + 1, y + 2));
        this.torn[y * COLUMNS + x] = rows || columns ? 1 : 0;
      }
    }
  }

  makeRangeTexture(inverse) {
    const values = new Uint8Array(2 * inverse.length);
    for (let i = 0; i < inverse.length; i++) {
      values[2 * i] = Math.round(255 * this.step(1 / inverse[i]));
      values[2 * i + 1] = this.ranges?.[i] > 0 ? 255 : 0;
    }
    this.rangeTexture = new THREE.DataTexture(values, this.rangeColumns, this.rangeRows, THREE.RGFormat, THREE.UnsignedByteType);
    Object.assign(this.rangeTexture, { minFilter: THREE.LinearFilter, magFilter: THREE.LinearFilter, wrapS: THREE.RepeatWrapping, needsUpdate: true });
  }

  async addTile(level, column, row, text) {
    const texture = await textureOf(text, "a tile of a panorama");
    if (!this.torn) return texture.dispose(); // closed meanwhile
    const columns = 1 << level, rows = Math.max(1, columns >> 1);
    const { whole, sheets } = this.tornGeometry(column * (COLUMNS / columns), row * (ROWS / rows), COLUMNS / columns, ROWS / rows);
    const part = (geometry, order, alpha, depthWrite) => {
      const material = new THREE.ShaderMaterial({
        defines: order === 200 ? { DOME: 1 } : {},
        vertexShader: TILE_VERTEX, fragmentShader: TILE_FRAGMENT, depthWrite,
        side: alpha.value === TORN ? THREE.DoubleSide : THREE.FrontSide, // surfaces are seen from the side of the centre alone
        uniforms: { map: { value: texture }, ranges: { value: this.rangeTexture }, alpha, ...this.other },
      });
      const mesh = new THREE.Mesh(geometry, material);
      mesh.renderOrder = order + level;
      return mesh;
    };
    const tile = new THREE.Group();
    // The sheets between two surfaces come first and hide nothing.
    tile.add(part(sheets, 0, { value: TORN }, false), part(whole, 100, { value: 1 }, true));
    tile.add(part(this.domeGeometry(column / columns, row / rows, columns, rows), 200, { value: 1 }, false));
    this.showDome(tile);
    tile.userData = { level, texture };
    this.group.add(tile);
    tile.updateMatrixWorld(true);
    this.tiles.set(`${level}-${column}-${row}`, tile);
    this.changed();
  }

  /** Return the surfaces of a tile, and the sheets that join them where they are torn.
   *
   * The tile begins at a corner of the quadrilaterals, and is so many of them wide and high.
   */
  tornGeometry(left, top, across, down) {
    const positions = [], places = [], wholes = [], splits = [], whole = [], sheets = [];
    const add = (x, y, range, split) => {
      const ray = Panorama.ray((left + x) / COLUMNS, (top + y) / ROWS);
      positions.push(ray.x * range, ray.y * range, ray.z * range);
      places.push(x / across, 1 - y / down);
      wholes.push((left + x) / COLUMNS, (top + y) / ROWS);
      splits.push(split);
      return splits.length - 1;
    };
    for (let y = 0; y <= down; y++) for (let x = 0; x <= across; x++) add(x, y, this.cornerRange(left + x, top + y), 0);
    for (let y = 0; y < down; y++) {
      for (let x = 0; x < across; x++) {
        const first = y * (across + 1) + x, below = first + across + 1;
        const torn = this.torn[(top + y) * COLUMNS + left + x];
        (torn ? sheets : whole).push(first, below + 1, first + 1, first, below, below + 1);
        if (!torn) continue;
        const corners = [[x, y], [x + 1, y], [x + 1, y + 1], [x, y + 1]];
        const ranges = corners.map(([cx, cy]) => this.cornerRange(left + cx, top + cy));
        const middle = Math.sqrt(Math.min(...ranges) * Math.max(...ranges));
        for (const near of [true, false]) {
          const own = ranges.filter((range) => range < middle === near);
          const mean = own.reduce((sum, range) => sum + range, 0) / own.length;
          const [a, b, c, d] = corners.map(([cx, cy], i) => add(cx, cy, ranges[i] < middle === near ? ranges[i] : mean, (near ? 1 : -1) * Math.max(0.002, this.step(middle))));
          whole.push(a, c, b, a, d, c);
        }
      }
    }
    const attributes = { position: [positions, 3], uv: [places, 2], whole: [wholes, 2], split: [splits, 1] };
    const shared = Object.entries(attributes).map(([name, [values, size]]) => [name, new THREE.BufferAttribute(new Float32Array(values), size)]);
    const [surfaces, joining] = [whole, sheets].map((corners) => {
      const geometry = new THREE.BufferGeometry();
      for (const [name, attribute] of shared) geometry.setAttribute(name, attribute);
      geometry.setIndex(corners);
      return geometry;
    });
    return { whole: surfaces, sheets: joining };
  }

  /** Return a part of a sphere around the centre, from which nothing but the directions matters.
   *
   * It begins at a place of the panorama; so many make up its width and its height.
   */
  domeGeometry(left, top, columns, rows) {
    const across = Math.max(8, DOME_COLUMNS / columns), down = Math.max(8, DOME_COLUMNS / 2 / rows);
    const positions = [], places = [], corners = [];
    for (let y = 0; y <= down; y++) {
      for (let x = 0; x <= across; x++) {
        const ray = Panorama.ray(left + x / across / columns, top + y / down / rows);
        positions.push(ray.x * this.far, ray.y * this.far, ray.z * this.far);
        places.push(x / across, 1 - y / down);
        const first = y * (across + 1) + x, below = first + across + 1;
        if (x < across && y < down) corners.push(first, below + 1, first + 1, first, below, below + 1);
      }
    }
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(positions), 3));
    geometry.setAttribute("uv", new THREE.BufferAttribute(new Float32Array(places), 2));
    geometry.setIndex(corners);
    return geometry;
  }

  showDome({ children: [sheets, whole, dome] }) {
    sheets.visible = whole.visible = this.elsewhere;
    dome.visible = !this.elsewhere;
  }

  /** Prepare for a picture from the centre, or from elsewhere on the way to or from `other`, which may be null. */
  fromElsewhere(elsewhere, other) {
    if (elsewhere !== this.elsewhere) {
      this.elsewhere = elsewhere;
      for (const tile of this.group.children) this.showDome(tile);
    }
    const { otherRanges, otherFromPage, otherLogs, hasOther } = this.other;
    hasOther.value = Boolean(elsewhere && other?.rangeTexture);
    otherRanges.value = hasOther.value ? other.rangeTexture : this.rangeTexture;
    if (!hasOther.value) return;
    otherFromPage.value = other.camFromPage;
    otherLogs.value = other.logs;
  }

  /** Load the tiles that a view needs, and draw those up to the level that fits. */
  update(camera, height) {
    const pixelsPerTurn = (height / camera.fov) * 360;
    const coarsest = this.camera.width / 2 ** (this.camera.levels - 1); // the width of level 0
    const wanted = Math.min(this.camera.levels - 1, Math.max(0, Math.ceil(Math.log2(pixelsPerTurn / coarsest) - 0.4)));
    const forward = camera.getWorldDirection(new THREE.Vector3()).transformDirection(this.camFromPage);
    const diagonal = THREE.MathUtils.radToDeg(Math.atan(Math.tan(THREE.MathUtils.degToRad(camera.fov) / 2) * Math.hypot(1, camera.aspect)));
    for (const tile of this.tiles.values()) tile.visible = tile.userData.level <= wanted;
    if (wanted < 1) return;
    const columns = 1 << wanted, rows = columns >> 1, needed = new Set();
    const missing = [];
    for (let row = 0; row < rows; row++) {
      for (let column = 0; column < columns; column++) {
        const key = `${wanted}-${column}-${row}`;
        const ray = Panorama.ray((column + 0.5) / columns, (row + 0.5) / rows);
        const angle = THREE.MathUtils.radToDeg(ray.angleTo(forward));
        if (angle > diagonal + 255 / columns) continue; // half the diagonal of a tile
        needed.add(key);
        if (!this.tiles.has(key)) missing.push({ key, column, row, angle });
      }
    }
    this.evict(needed);
    missing.sort((a, b) => a.angle - b.angle); // the middle of the picture first
    for (const { key, column, row } of missing) {
      if (this.loading >= TILES_AT_ONCE) break;
      this.tiles.set(key, { visible: false, userData: { level: wanted } }); // asked for
      this.loading++;
      PanoMvs.load(`panorama/${this.index}/${key}`)
        .then((text) => this.addTile(wanted, column, row, text))
        .catch(problem)
        .finally(() => {
          this.loading--;
          this.changed();
        });
    }
  }

  /** Forget the oldest tiles that no view needs now. */
  evict(needed) {
    for (const [key, tile] of this.tiles) {
      if (this.tiles.size <= MAX_TILES) return;
      if (needed.has(key) || tile.userData.level === 0 || !tile.userData.texture) continue;
      this.discard(tile);
      this.tiles.delete(key);
    }
  }

  discard(tile) {
    for (const mesh of tile.children) {
      mesh.geometry.dispose();
      mesh.material.dispose();
    }
    tile.userData.texture.dispose();
    this.group.remove(tile);
  }

  /** Return the point of the scene along a ray of the page's frame from the centre, with its uncertainty; or null. */
  pick(direction) {
    const [u, v] = this.place(direction);
    const range = this.smoothRange(u, v);
    if (!(range > 0)) return null;
    const ray = direction.clone().normalize();
    const sigma = this.sigmaSteps ? range * valueOfStep(this.sigmaSteps[this.pixel(u, v)], this.camera.sigmas, 255) : 0;
    return { point: ray.clone().multiplyScalar(range).add(this.center), sigma, ray };
  }

  close() {
    for (const tile of [...this.group.children]) this.discard(tile);
    this.tiles.clear();
    this.rangeTexture?.dispose();
    this.ranges = this.torn = this.rangeTexture = this.sigmaSteps = this.opened = null;
  }
}

/** Return values whose gaps (0) have the mean of what surrounds them, from coarser and coarser grids. */
function filledGaps(values, width, height, otherwise) {
  if (width <= 1 && height <= 1) return values.map((value) => value || otherwise);
  const w = (width + 1) >> 1, h = (height + 1) >> 1;
  const sums = new Float32Array(w * h), counts = new Uint8Array(w * h);
  let gaps = false;
  for (let y = 0; y < height; y++) {
    for (let x = 0; x < width; x++) {
      const value = values[y * width + x], coarse = (y >> 1) * w + (x >> 1);
      if (value) {
        sums[coarse] += value;
        counts[coarse]++;
      } else gaps = true;
    }
  }
  if (!gaps) return values;
  const coarser = filledGaps(sums.map((sum, i) => (counts[i] ? sum / counts[i] : 0)), w, h, otherwise);
  return values.map((value, i) => value || coarser[((Math.floor(i / width)) >> 1) * w + ((i % width) >> 1)]);
}
