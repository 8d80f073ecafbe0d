"use strict";
// Points that somebody marks, the distance between two of them, and its uncertainty.

class Ruler {
  constructor(unit) {
    this.unit = unit;
    this.picks = [];
    this.group = new THREE.Group();
    this.label = document.createElement("div");
    this.label.hidden = true;
    document.getElementById("labels").append(this.label);
  }

  /** Add a point: `{ point, sigma, ray }`, where `sigma` is 0 if unknown, and `ray` null if the error has no direction.
   *
   * `here` is the panorama from which it was marked, or null.
   */
  add(pick, here) {
    if (this.picks.length === 2) this.clear();
    this.picks.push(pick);
    const dot = new THREE.Sprite(new THREE.SpriteMaterial({ color: 0xffb02e, depthTest: false, sizeAttenuation: false }));
    dot.scale.setScalar(0.018);
    dot.position.copy(pick.point);
    this.group.add(dot);
    if (this.picks.length < 2) {
      const away = here ? `, ${withUncertainty(pick.point.distanceTo(here.center), this.unit, pick.sigma)} from this panorama` : "";
      this.label.textContent = "Marked point";
      return say(`One point is marked${away}. The address of this page leads to it. Mark another one for the distance.`);
    }
    const [a, b] = this.picks.map((each) => each.point);
    this.group.add(new THREE.Line(new THREE.BufferGeometry().setFromPoints([a, b]), new THREE.LineBasicMaterial({ color: 0xffb02e, depthTest: false })));
    const text = withUncertainty(a.distanceTo(b), this.unit, this.sigma());
    this.label.textContent = text;
    say(`Distance ${text}: ${lengthText(Math.hypot(a.x - b.x, a.z - b.z), this.unit)} horizontally, ${lengthText(Math.abs(a.y - b.y), this.unit)} vertically`);
  }

  /** Return the standard deviation of the distance; 0 if it is unknown. */
  sigma() {
    if (!this.picks.every((pick) => pick.sigma > 0)) return 0;
    const along = this.picks[1].point.clone().sub(this.picks[0].point).normalize();
    // The error of a range lies along its ray; that of a point of the cloud is taken as that large in all directions.
    return Math.hypot(...this.picks.map((pick) => pick.sigma * (pick.ray ? Math.max(0.1, Math.abs(pick.ray.dot(along))) : 1)));
  }

  clear() {
    for (const part of this.group.children) {
      part.geometry?.dispose();
      part.material.dispose();
    }
    this.group.clear();
    this.picks = [];
    this.label.hidden = true;
    say("");
  }

  place(camera, width, height) {
    this.label.hidden = !this.picks.length;
    if (this.label.hidden) return;
    const middle = this.picks[0].point.clone().lerp(this.picks.at(-1).point, 0.5).project(camera);
    this.label.hidden = middle.z > 1;
    const box = this.label.getBoundingClientRect();
    const x = THREE.MathUtils.clamp(((middle.x + 1) / 2) * width - box.width / 2, 4, width - box.width - 4);
    this.label.style.transform = `translate(${x}px, ${Math.max(4, ((1 - middle.y) / 2) * height - box.height - 8)}px)`;
  }
}

function lengthText(length, unit) {
  const digits = length >= 100 ? 0 : length >= 10 ? 1 : length >= 1 ? 2 : 3;
  return `${length.toFixed(digits)} ${unit}`;
}

/** Return a length with its standard deviation, rounded up to one digit: "3.42 m ± 0.02". */
function withUncertainty(length, unit, sigma) {
  if (!(sigma > 0)) return lengthText(length, unit);
  const digits = THREE.MathUtils.clamp(-Math.floor(Math.log10(sigma)), 0, 3);
  const rounded = Math.ceil(sigma * 10 ** digits - 1e-9) / 10 ** digits;
  return `${length.toFixed(digits)} ${unit} ± ${rounded.toFixed(digits)}`;
}

function say(text) {
  document.getElementById("measured").textContent = text;
}
