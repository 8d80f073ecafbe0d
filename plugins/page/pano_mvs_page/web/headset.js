"use strict";
// The scene in a headset (WebXR): one stands in a panorama or in the model, at their true size.

const EYE_HEIGHT_M = 1.6; // of a camera above the floor, if the scene has no metres
const SNAP_TURN = Math.PI / 6;
const PUSHED = 0.7; // how far a thumb stick must go

class Headset {
  constructor(page) {
    this.page = page;
    this.session = null;
    this.inModel = this.pushed = false;
    this.rig = new THREE.Group(); // the frame of the headset, in metres, within the scene
    this.camera = new THREE.PerspectiveCamera(80, 1.3, 0.05, 1000); // three.js makes those of the two eyes from it
    this.rig.add(this.camera);
    this.both = new THREE.PerspectiveCamera(120, 1.3, 0.05, 1000); // sees what either eye may see
    this.button = element("headset");
    this.button.addEventListener("click", () => this.enter());
    page.renderer.xr.setReferenceSpaceType("local"); // it begins where the head is
    page.renderer.xr.addEventListener("sessionend", () => this.leave());
    navigator.xr?.isSessionSupported("immersive-vr").then((supported) => { this.button.hidden = !supported; }, () => {});
  }

  async enter() {
    const { page, page: { renderer } } = this;
    try {
      this.session = await navigator.xr.requestSession("immersive-vr");
      this.session.addEventListener("select", () => this.walk(page.ahead(this.camera)));
      this.session.addEventListener("squeeze", () => { this.inModel = !this.inModel; });
      renderer.xr.enabled = true;
      renderer.setAnimationLoop(() => renderer.xr.isPresenting && this.frame());
      await renderer.xr.setSession(this.session);
    } catch (error) {
      await this.session?.end().catch(() => {});
      this.leave();
      return say(`The headset did not start: ${error.message}.`);
    }
    const start = page.here ?? page.nearest();
    this.inModel = !start;
    await this.walk(start);
    this.rig.rotation.y = -page.look.yaw;
    this.rig.scale.setScalar(this.unitsPerMetre());
    this.placed = false;
  }

  leave() {
    this.session = null;
    this.page.renderer.setAnimationLoop(null);
    this.page.renderer.xr.enabled = false;
    this.page.resize();
  }

  unitsPerMetre() {
    const { here, scene } = this.page;
    const floor = scene.unit === "m" ? null : here?.pick(new THREE.Vector3(0, -1, 0));
    return floor ? floor.point.distanceTo(here.center) / EYE_HEIGHT_M : 1;
  }

  async walk(panorama) {
    if (panorama) await this.page.stepInside(panorama, true);
    this.placed = false;
  }

  /** Move the rig so that the head is at the centre of the panorama, or in the middle of the model. */
  stand() {
    const { page: { here, orbit, renderer: { xr } }, rig } = this;
    const pose = xr.getFrame().getViewerPose(xr.getReferenceSpace());
    if (!pose) return; // the headset does not know yet where it is
    const { x, y, z } = pose.transform.position;
    rig.updateMatrixWorld(true);
    rig.position.sub(new THREE.Vector3(x, y, z).applyMatrix4(rig.matrixWorld)).add(here?.center ?? orbit.target);
    rig.updateMatrixWorld(true);
    this.placed = true;
  }

  /** Walk or turn when a thumb stick is pushed, once for each push. */
  steer() {
    const sticks = [...this.session.inputSources].map(({ gamepad }) => gamepad?.axes.slice(-2) ?? []);
    const [aside, ahead] = sticks.find((axes) => Math.hypot(...axes) > PUSHED) ?? [0, 0];
    const pushed = Boolean(aside || ahead), began = pushed && !this.pushed;
    this.pushed = pushed;
    if (!began) return;
    if (-ahead > Math.abs(aside)) this.walk(this.page.ahead(this.camera));
    else if (Math.abs(aside) > ahead) {
      this.rig.rotation.y -= Math.sign(aside) * SNAP_TURN;
      this.placed = false;
    }
  }

  frame() {
    const { page: { renderer, here, rings, marks }, camera } = this, { height } = renderer.domElement;
    this.steer();
    if (!this.placed) this.stand();
    renderer.xr.updateCamera(camera);
    renderer.clear();
    if (this.inModel || !here) this.drawModel(height);
    else {
      here.update(camera, height);
      here.fromElsewhere(Boolean(here.camera.ranges), null); // each eye sees the surfaces at their ranges
      renderer.render(here.group, camera);
    }
    renderer.clearDepth();
    for (const ring of rings) ring.scale.setScalar(0.04);
    renderer.render(marks, camera);
  }

  drawModel(height) {
    const { page: { renderer, world, cloud, surface, surfaceShown }, camera, both } = this;
    if (surfaceShown) {
      surface.open(true);
      surface.detail(true);
    } else {
      camera.matrixWorld.decompose(both.position, both.quaternion, both.scale);
      both.updateMatrixWorld();
      const focal = (height / 2) * camera.projectionMatrix.elements[5];
      cloud.update(both, 2 * focal * Math.tan(THREE.MathUtils.degToRad(both.fov) / 2), PACES[1].points);
      cloud.material.uniforms.pixelsPerUnit.value = focal / this.rig.scale.x; // the eyes see metres
    }
    renderer.render(world, camera);
  }
}
