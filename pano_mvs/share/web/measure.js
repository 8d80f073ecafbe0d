"use strict";
// Distances between two points that somebody clicks.

class Ruler {
  constructor(unit) {
    this.unit = unit;
    this.points = [];
    this.group = new THREE.Group();
    this.label = document.createElement("div");
    this.label.hidden = true;
    document.getElementById("labels").append(this.label);
  }

  add(point) {
    if (this.points.length === 2) this.clear();
    this.points.push(point);
    const dot = new THREE.Sprite(new THREE.SpriteMaterial({ color: 0xffb02e, depthTest: false, sizeAttenuation: false }));
    dot.scale.setScalar(0.014);
    dot.position.copy(point);
    this.group.add(dot);
    if (this.points.length < 2) return say("Click the second point.");
    const geometry = new THREE.BufferGeometry().setFromPoints(this.points);
    this.group.add(new THREE.Line(geometry, new THREE.LineBasicMaterial({ color: 0xffb02e, depthTest: false })));
    const [a, b] = this.points;
    const text = `${this.text(a.distanceTo(b))}`;
    this.label.textContent = text;
    say(`Distance ${text}: ${this.text(Math.hypot(a.x - b.x, a.z - b.z))} horizontally, ${this.text(Math.abs(a.y - b.y))} vertically`);
  }

  text(length) {
    const digits = length >= 100 ? 0 : length >= 10 ? 1 : length >= 1 ? 2 : 3;
    return `${length.toFixed(digits)} ${this.unit}`;
  }

  clear() {
    for (const part of this.group.children) {
      part.geometry?.dispose();
      part.material.dispose();
    }
    this.group.clear();
    this.points = [];
    this.label.hidden = true;
    say("");
  }

  place(camera, width, height) {
    this.label.hidden = this.points.length < 2;
    if (this.label.hidden) return;
    const middle = this.points[0].clone().add(this.points[1]).multiplyScalar(0.5).project(camera);
    this.label.hidden = middle.z > 1;
    const box = this.label.getBoundingClientRect();
    this.label.style.transform = `translate(${((middle.x + 1) / 2) * width - box.width / 2}px, ${((1 - middle.y) / 2) * height - box.height - 8}px)`;
  }
}

function say(text) {
  document.getElementById("measured").textContent = text;
}
