"use strict";
// The names of rooms, where their panoramas stand.

/** Return the rooms of panoramas: their names, and the mean of their panoramas' centres. */
function roomsOf(panoramas) {
  const rooms = new Map();
  for (const { camera, center } of panoramas) if (camera.room) rooms.set(camera.room, [...(rooms.get(camera.room) ?? []), center]);
  return [...rooms].map(([name, centers]) => ({
    name, center: centers.reduce((sum, center) => sum.add(center), new THREE.Vector3()).divideScalar(centers.length),
  }));
}

class Rooms {
  constructor(panoramas) {
    this.tags = roomsOf(panoramas).map(({ name, center }) => {
      const tag = Object.assign(document.createElement("div"), { className: "room", textContent: name, hidden: true });
      document.getElementById("labels").append(tag);
      return { tag, center };
    });
  }

  /** Put the names where a camera shows the rooms; hide them without a camera. */
  place(camera, width, height) {
    for (const { tag, center } of this.tags) {
      const at = camera && center.clone().project(camera);
      tag.hidden = !at || Math.abs(at.x) > 1 || Math.abs(at.y) > 1 || at.z > 1;
      if (!tag.hidden) tag.style.transform = `translate(${((at.x + 1) / 2) * width}px, ${((1 - at.y) / 2) * height}px) translate(-50%, -170%)`;
    }
  }
}
