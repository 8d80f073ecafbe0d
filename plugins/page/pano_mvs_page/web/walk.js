"use strict";
// The picture during a walk: two panoramas, each projected on its own ranges, joined by what each one sees.

const JOIN_VERTEX = `
varying vec2 place;
void main() {
  place = uv;
  gl_Position = vec4(position.xy, 0.0, 1.0);
}`;
// A panorama counts for more the nearer the eye is to it, for little where its surface is torn or doubtful, and for less where the
// other one sees something in front. The surface of the scene shows where both are torn.
const JOIN_FRAGMENT = `
uniform sampler2D fromColor, toColor, sceneColor, fromDepth, toDepth;
uniform float t, opacity, near, far;
uniform bool hasFrom, hasScene;
varying vec2 place;
float along(float depth) { return near * far / (far - depth * (far - near)); }
float weight(vec4 color) { return color.a > 0.9 ? 1.0 : color.a > 0.4 ? 0.12 : color.a > 0.1 ? 0.02 : 0.0; }
void main() {
  vec4 b = texture2D(toColor, place), a = hasFrom ? texture2D(fromColor, place) : vec4(0.0);
  vec4 c = hasScene ? texture2D(sceneColor, place) : vec4(0.0);
  float weightA = hasFrom ? (1.0 - t) * weight(a) : 0.0, weightB = hasFrom ? t * weight(b) : step(0.9, b.a);
  float weightC = 0.3 * t * (1.0 - t) * step(0.9, c.a); // at most 0.075
  if (min(a.a, b.a) > 0.9) {
    float za = along(texture2D(fromDepth, place).r), zb = along(texture2D(toDepth, place).r);
    weightA *= mix(1.0, 0.06, smoothstep(1.04, 1.2, za / zb));
    weightB *= mix(1.0, 0.06, smoothstep(1.04, 1.2, zb / za));
  }
  float sum = weightA + weightB + weightC;
  if (sum <= 0.0) discard;
  gl_FragColor = vec4((a.rgb * weightA + b.rgb * weightB + c.rgb * weightC) / sum, opacity);
}`;

class WalkView {
  constructor(renderer) {
    this.renderer = renderer;
    this.targets = [0, 1, 2].map(() => {
      const target = new THREE.WebGLRenderTarget(4, 4, { minFilter: THREE.NearestFilter, magFilter: THREE.NearestFilter });
      target.texture.colorSpace = THREE.NoColorSpace;
      target.depthTexture = new THREE.DepthTexture(4, 4, THREE.UnsignedIntType);
      return target;
    });
    const [from, to, scene] = this.targets;
    this.material = new THREE.ShaderMaterial({
      vertexShader: JOIN_VERTEX, fragmentShader: JOIN_FRAGMENT, transparent: true, depthTest: false, depthWrite: false,
      uniforms: {
        fromColor: { value: from.texture }, toColor: { value: to.texture }, sceneColor: { value: scene.texture }, fromDepth: { value: from.depthTexture }, toDepth: { value: to.depthTexture },
        t: { value: 0 }, opacity: { value: 1 }, near: { value: 1 }, far: { value: 2 }, hasFrom: { value: false }, hasScene: { value: false },
      },
    });
    this.scene = new THREE.Scene();
    const quad = new THREE.Mesh(new THREE.PlaneGeometry(2, 2), this.material);
    quad.frustumCulled = false;
    this.scene.add(quad);
  }

  /** Draw over what is there.
   *
   * `from` may be null, and `scene` too, which shows where neither panorama saw anything; `t` is the part of the way.
   */
  draw(from, to, scene, camera, { t, opacity }) {
    const { renderer, material: { uniforms } } = this;
    const { width, height } = renderer.domElement;
    for (const [idx, shown] of [from?.group, to.group, scene].entries()) {
      if (!shown) continue;
      this.targets[idx].setSize(width, height);
      renderer.setRenderTarget(this.targets[idx]);
      renderer.setClearColor(0x000000, 0);
      renderer.clear();
      renderer.render(shown, camera);
    }
    renderer.setRenderTarget(null);
    const values = { t, opacity, near: camera.near, far: camera.far, hasFrom: Boolean(from), hasScene: Boolean(scene) };
    for (const [name, value] of Object.entries(values)) uniforms[name].value = value;
    renderer.render(this.scene, camera);
  }
}
