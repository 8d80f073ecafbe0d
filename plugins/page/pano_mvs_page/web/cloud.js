"use strict";
// The cloud: an octree of which as much is loaded and drawn as the picture needs.

const POINT_BUDGET = 1_500_000;
const LOADS_AT_ONCE = 4;
const MIN_NODE_PIXELS = 110; // a node smaller than this on the screen is left to its parent

const COVERAGE_RAMP = `
vec3 coverageColor(float views, vec3 color) {
  float t = clamp((views * 255.0 - 1.0) / 5.0, 0.0, 1.0);
  vec3 ramp = mix(vec3(0.78, 0.15, 0.29), mix(vec3(0.98, 0.80, 0.30), vec3(0.10, 0.60, 0.45), clamp(t * 2.0 - 1.0, 0.0, 1.0)), clamp(t * 2.0, 0.0, 1.0));
  return ramp * (0.45 + 0.55 * dot(color, vec3(0.3, 0.6, 0.1)));
}`;
const POINT_VERTEX = `
attribute vec3 color;
attribute float views;
uniform float pointSize; uniform float pixelsPerUnit; uniform float cut; uniform bool coverage; uniform bool hideBacks;
varying vec3 shown;
${COVERAGE_RAMP}
void main() {
  vec4 inWorld = modelMatrix * vec4(position, 1.0);
  vec4 inView = viewMatrix * inWorld;
  gl_Position = projectionMatrix * inView;
  bool turnedAway = hideBacks && dot(normal, inWorld.xyz - cameraPosition) > 0.0;
  if (inWorld.y > cut || turnedAway) gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
  bool perspective = projectionMatrix[2][3] != 0.0;
  gl_PointSize = clamp(pointSize * pixelsPerUnit / (perspective ? -inView.z : 1.0), 1.5, 24.0);
  shown = coverage ? coverageColor(views, color) : color;
}`;
const POINT_FRAGMENT = `
varying vec3 shown;
void main() {
  vec2 fromCenter = gl_PointCoord - 0.5;
  if (dot(fromCenter, fromCenter) > 0.25) discard;
  gl_FragColor = vec4(shown, 1.0);
}`;

class Cloud {
  constructor(scene, changed) {
    this.group = new THREE.Group();
    this.changed = changed;
    this.loading = 0;
    this.sigmas = scene.sigmas;
    this.bounds = scene.bounds;
    this.nodes = new Map();
    for (const node of scene.nodes) {
      const box = new THREE.Box3(new THREE.Vector3(...node.lower), new THREE.Vector3(...node.lower).addScalar(node.size));
      this.nodes.set(node.name, { ...node, box, sphere: box.getBoundingSphere(new THREE.Sphere()), points: null, asked: false });
    }
    this.total = scene.nodes.reduce((sum, node) => sum + node.count, 0);
    this.material = new THREE.ShaderMaterial({
      vertexShader: POINT_VERTEX,
      fragmentShader: POINT_FRAGMENT,
      uniforms: {
        pointSize: { value: 0.01 }, pixelsPerUnit: { value: 1 }, cut: { value: 1e30 }, coverage: { value: false }, hideBacks: { value: true },
      },
    });
  }

  /** Return twice a typical distance between loaded points, as if they lay on the sides of the box that holds most of them. */
  spacing() {
    const loaded = [...this.nodes.values()].reduce((sum, node) => sum + (node.points ? node.count : 0), 0);
    if (!loaded) return 0.01;
    const [a, b, c] = [0, 1, 2].map((axis) => this.bounds[1][axis] - this.bounds[0][axis]);
    return 2 * Math.sqrt((2 * (a * b + b * c + c * a)) / Math.min(loaded, POINT_BUDGET)) || 0.01;
  }

  /** Choose the nodes for a camera: nearest and largest first, until the budget is spent; load what is missing.
   *
   * `share` is the part of the points that is drawn. The points of a node are in random order, so their first ones are
   * a sample of it; they are drawn a little larger.
   */
  update(camera, height, share) {
    const perspective = camera.isPerspectiveCamera;
    const focal = perspective ? height / 2 / Math.tan(THREE.MathUtils.degToRad(camera.fov) / 2) : height * camera.zoom / (camera.top - camera.bottom);
    this.material.uniforms.pixelsPerUnit.value = focal;
    const frustum = new THREE.Frustum().setFromProjectionMatrix(
      new THREE.Matrix4().multiplyMatrices(camera.projectionMatrix, camera.matrixWorldInverse));
    const pixels = (node) => {
      const distance = Math.max(camera.position.distanceTo(node.sphere.center) - node.sphere.radius, node.size * 0.1);
      return (node.size * focal) / (perspective ? distance : 1);
    };
    for (const node of this.nodes.values()) if (node.points) node.points.visible = false;
    const candidates = this.nodes.has("r") ? [this.nodes.get("r")] : [];
    const drawn = [];
    let left = POINT_BUDGET;
    while (candidates.length && left > 0) {
      candidates.sort((a, b) => pixels(a) - pixels(b));
      const node = candidates.pop();
      if (node.name !== "r" && (pixels(node) < MIN_NODE_PIXELS || !frustum.intersectsBox(node.box))) continue;
      left -= node.count;
      if (node.points) drawn.push(node);
      else this.load(node);
      for (let octant = 0; octant < 8; octant++) {
        const child = this.nodes.get(node.name + octant);
        if (child) candidates.push(child);
      }
    }
    for (const node of drawn) {
      node.points.visible = true;
      node.points.geometry.setDrawRange(0, Math.ceil(node.count * share));
    }
    this.material.uniforms.pointSize.value = this.spacing() * share ** -0.35;
  }

  /** Whether the root, a sample of all points, can be seen, or there is none. */
  get begun() { return Boolean(!this.nodes.size || this.nodes.get("r").points); }

  load(node) {
    if (node.asked || this.loading >= LOADS_AT_ONCE || (node.name !== "r" && !this.begun)) return;
    node.asked = true;
    this.loading++;
    PanoMvs.load(`cloud/${node.name}`).then((text) => {
      const bytes = bytesOf(text).buffer, count = node.count;
      const geometry = new THREE.BufferGeometry();
      geometry.setAttribute("position", new THREE.BufferAttribute(new Uint16Array(bytes, 0, 3 * count), 3, true));
      geometry.setAttribute("color", new THREE.BufferAttribute(new Uint8Array(bytes, 6 * count, 3 * count), 3, true));
      geometry.setAttribute("views", new THREE.BufferAttribute(new Uint8Array(bytes, 9 * count, count), 1, true));
      geometry.setAttribute("normal", new THREE.BufferAttribute(new Int8Array(bytes, 10 * count, 3 * count), 3, true));
      node.sigmaSteps = new Uint8Array(bytes, 13 * count, count);
      node.points = new THREE.Points(geometry, this.material);
      node.points.position.set(...node.lower);
      node.points.scale.setScalar(node.size);
      node.points.frustumCulled = false; // `update` does that
      node.points.updateMatrixWorld(true);
      this.group.add(node.points);
    }).catch(problem).finally(() => {
      this.loading--;
      this.changed();
    });
  }

  /** Return the place where a ray meets the surface around its nearest point, with its uncertainty; or null.
   *
   * The points considered are those within `slack` pixels of the ray. Of those in front, the one nearest to the ray
   * and its normal give the surface.
   */
  pick(raycaster, camera, height, slack = 7) {
    const { origin, direction } = raycaster.ray;
    const perspective = camera.isPerspectiveCamera;
    const pixel = perspective ? (2 * Math.tan(THREE.MathUtils.degToRad(camera.fov) / 2)) / height : (camera.top - camera.bottom) / camera.zoom / height;
    const cut = this.material.uniforms.cut.value, hideBacks = this.material.uniforms.hideBacks.value;
    const found = [];
    let front = Infinity;
    for (const node of this.nodes.values()) {
      if (!node.points || !node.points.visible || raycaster.ray.distanceToPoint(node.sphere.center) > node.sphere.radius * 1.5 + 1e-6 + (perspective ? 0.05 * origin.distanceTo(node.sphere.center) : 0)) continue;
      const places = node.points.geometry.attributes.position.array, normals = node.points.geometry.attributes.normal.array;
      const scale = node.size / 65535;
      const [lx, ly, lz] = node.lower;
      for (let i = 0; i < places.length; i += 3) {
        const y = ly + places[i + 1] * scale;
        if (y > cut) continue;
        const dx = lx + places[i] * scale - origin.x, dy = y - origin.y, dz = lz + places[i + 2] * scale - origin.z;
        const along = dx * direction.x + dy * direction.y + dz * direction.z;
        const reach = slack * pixel * (perspective ? along : 1);
        if (along <= 0 || along - 4 * reach >= front) continue;
        if (hideBacks && dx * normals[i] + dy * normals[i + 1] + dz * normals[i + 2] > 0) continue;
        const off = dx * dx + dy * dy + dz * dz - along * along;
        if (off >= reach * reach) continue;
        front = Math.min(front, along);
        found.push({ along, off, reach, node, i });
      }
    }
    const best = found.filter(({ along, reach }) => along - 4 * reach < front).sort((a, b) => a.off - b.off)[0];
    if (!best) return null;
    const { position, normal } = best.node.points.geometry.attributes;
    const point = new THREE.Vector3().fromBufferAttribute(position, best.i / 3).applyMatrix4(best.node.points.matrixWorld);
    const facing = new THREE.Vector3().fromBufferAttribute(normal, best.i / 3), slope = facing.dot(direction);
    const along = Math.abs(slope) > 0.2 ? facing.dot(point.sub(origin)) / slope : best.along;
    const sigma = valueOfStep(best.node.sigmaSteps[best.i / 3], this.sigmas, 255);
    return { point: origin.clone().addScaledVector(direction, along), sigma, ray: null };
  }
}
