"use strict";
// Panoramas projected on their own range maps, so that a walk from one to the next looks like a move.

const COLUMNS = 256; // quadrilaterals of the whole sphere
const ROWS = 128;
const TILES_AT_ONCE = 3;

class Panorama {
  constructor(index, camera, rangesHw, changed) {
    this.index = index;
    this.camera = camera;
    this.changed = changed;
    [this.rangeRows, this.rangeColumns] = rangesHw;
    this.ranges = null; // Float32Array, 0 where there is none
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
      .then(([, text]) => (text ? this.addTile(0, 0, 0, text) : null));
    return this.opened;
  }

  async loadRanges() {
    if (!this.camera.ranges) return;
    const steps = new Uint16Array(bytesOf(await PanoMvs.load(`panorama/${this.index}/ranges`)).buffer);
    const [low, high] = this.camera.ranges;
    const factor = Math.log(high / low) / 65534;
    this.ranges = Float32Array.from(steps, (step) => (step ? low * Math.exp((step - 1) * factor) : 0));
    const valid = this.ranges.filter((range) => range > 0).sort();
    if (valid.length) this.far = valid[valid.length >> 1] * 2;
  }

  /** Return the ray of a place of the panorama in its camera's frame; u and v are fractions of width and height. */
  static ray(u, v) {
    const azimuth = 2 * Math.PI * (u - 0.5), elevation = Math.PI * (0.5 - v);
    return new THREE.Vector3(Math.cos(elevation) * Math.sin(azimuth), -Math.sin(elevation), Math.cos(elevation) * Math.cos(azimuth));
  }

  /** Return the range of the pixel at a place; 0 if it has none. */
  range(u, v) {
    if (!this.ranges) return 0;
    const x = ((Math.floor(u * this.rangeColumns) % this.rangeColumns) + this.rangeColumns) % this.rangeColumns;
    const y = Math.min(this.rangeRows - 1, Math.max(0, Math.floor(v * this.rangeRows)));
    return this.ranges[y * this.rangeColumns + x];
  }

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

  addTile(level, column, row, text) {
    return textureOf(text).then((texture) => {
      const columns = 1 << level, rows = Math.max(1, columns >> 1);
      const across = COLUMNS / columns, down = ROWS / rows;
      const vertices = [], uv = [], corners = [];
      for (let y = 0; y <= down; y++) {
        for (let x = 0; x <= across; x++) {
          const u = (column * across + x) / COLUMNS, v = (row * down + y) / ROWS;
          const ray = Panorama.ray(u, v).multiplyScalar(this.range(u, Math.min(v, 1 - 1e-6)) || this.far);
          vertices.push(ray.x, ray.y, ray.z);
          uv.push(x / across, 1 - y / down);
          if (x < across && y < down) {
            const first = y * (across + 1) + x, below = first + across + 1;
            corners.push(first, first + 1, below + 1, first, below + 1, below);
          }
        }
      }
      const geometry = new THREE.BufferGeometry();
      geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(vertices), 3));
      geometry.setAttribute("uv", new THREE.BufferAttribute(new Float32Array(uv), 2));
      geometry.setIndex(corners);
      const mesh = new THREE.Mesh(geometry, new THREE.MeshBasicMaterial({ map: texture, side: THREE.DoubleSide }));
      mesh.renderOrder = level;
      mesh.userData = { level, column, row };
      this.group.add(mesh);
      this.tiles.set(`${level}-${column}-${row}`, mesh);
      this.changed();
    });
  }

  /** Load the tiles that a view from the centre needs, and draw those of the level that fits. */
  update(camera, height) {
    const pixelsPerTurn = (height / camera.fov) * 360;
    const wanted = Math.min(this.camera.levels - 1, Math.max(0, Math.ceil(Math.log2(pixelsPerTurn / 1024) - 0.4)));
    const forward = camera.getWorldDirection(new THREE.Vector3()).transformDirection(this.camFromPage);
    const halfView = (camera.fov / 2) * Math.max(1, camera.aspect) * 1.15;
    for (const mesh of this.tiles.values()) mesh.visible = mesh.userData.level === 0 || mesh.userData.level === wanted;
    if (wanted < 1) return;
    const columns = 1 << wanted, rows = columns >> 1;
    for (let row = 0; row < rows; row++) {
      for (let column = 0; column < columns; column++) {
        const key = `${wanted}-${column}-${row}`;
        const ray = Panorama.ray((column + 0.5) / columns, (row + 0.5) / rows);
        const angle = THREE.MathUtils.radToDeg(ray.angleTo(forward));
        if (this.tiles.has(key) || this.loading >= TILES_AT_ONCE || angle > halfView + 190 / columns) continue;
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
  }

  /** Set how opaque the panorama is drawn. */
  fade(opacity) {
    for (const mesh of this.group.children) {
      mesh.material.transparent = opacity < 1;
      mesh.material.opacity = opacity;
    }
  }

  /** Return the point of the scene along a ray of the page's frame from the centre; null if there is no range. */
  pick(direction) {
    const ray = direction.clone().transformDirection(this.camFromPage);
    const u = Math.atan2(ray.x, ray.z) / (2 * Math.PI) + 0.5, v = 0.5 - Math.atan2(-ray.y, Math.hypot(ray.x, ray.z)) / Math.PI;
    const range = this.smoothRange(u, v);
    return range > 0 ? direction.clone().normalize().multiplyScalar(range).add(this.center) : null;
  }

  close() {
    for (const mesh of this.group.children) {
      mesh.geometry.dispose();
      mesh.material.map.dispose();
      mesh.material.dispose();
    }
    this.group.clear();
    this.tiles.clear();
    this.ranges = null;
    this.opened = null;
  }
}
