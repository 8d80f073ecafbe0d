"use strict";
// The address keeps the view and the marked points: "#i=3,yaw,pitch,fov&m=x,y,z,sigma,ray,ray,ray&s=0&c=1".

/** Return the part of the address that leads back to what the page shows. */
function linkOf(page) {
  const short = (numbers) => numbers.map((number) => Number(number.toPrecision(6))).join(",");
  const { look, above, eye, orbit } = page;
  const parts = [];
  if (page.mode === "inside") parts.push(`i=${page.here.index},${short([look.yaw, look.pitch, look.fov])}`);
  else if (page.mode === "plan") parts.push(`p=${short([above.position.x, above.position.z, above.zoom])}`);
  else parts.push(`o=${short([...eye.position.toArray(), ...orbit.target.toArray()])}`);
  if (page.ruler.picks.length) {
    const numbers = page.ruler.picks.flatMap(({ point, sigma, ray }) => [...point.toArray(), sigma, ...(ray ?? new THREE.Vector3()).toArray()]);
    parts.push(`m=${short(numbers)}`);
  }
  if (page.surface && !page.surfaceShown) parts.push("s=0");
  if (page.covered) parts.push("c=1");
  return `#${parts.join("&")}`;
}

/** Show what an address leads to; return whether it leads anywhere. */
function followLink(page, link) {
  const parts = new Map(link.slice(1).split("&").map((part) => {
    const [kind, text] = part.split("=");
    return [kind, (text ?? "").split(",").map(Number)];
  }));
  if (![...parts.values()].every((numbers) => numbers.every(Number.isFinite))) return false;
  if (page.surface) page.showSurface(parts.get("s")?.[0] !== 0);
  page.coverage(parts.get("c")?.[0] === 1);
  const found = followView(page, parts), inside = parts.has("i") ? page.panoramas[parts.get("i")[0]] : null;
  const measured = parts.get("m");
  if (found && (measured?.length === 7 || measured?.length === 14)) {
    page.measure(true);
    for (let first = 0; first < measured.length; first += 7) {
      const [x, y, z, sigma, ...ray] = measured.slice(first, first + 7);
      const pick = { point: new THREE.Vector3(x, y, z), sigma, ray: ray.some(Boolean) ? new THREE.Vector3(...ray) : null };
      page.ruler.add(pick, inside);
    }
  }
  return found;
}

function followView(page, parts) {
  const inside = parts.get("i"), plan = parts.get("p"), outside = parts.get("o");
  if (inside?.length === 4 && page.panoramas[inside[0]]?.camera.levels) {
    if (page.mode === undefined) page.overview();
    page.look = { yaw: inside[1], pitch: THREE.MathUtils.clamp(inside[2], -1.55, 1.55), fov: THREE.MathUtils.clamp(inside[3], 15, 110) };
    page.mode = "inside"; // keeps this direction
    page.stepInside(page.panoramas[inside[0]], true);
    return true;
  }
  if (plan?.length === 3) {
    page.plan();
    [page.above.position.x, page.above.position.z, page.above.zoom] = plan;
    [page.glide.target.x, page.glide.target.z] = plan;
    page.resize();
    return true;
  }
  if (outside?.length === 6) {
    page.overview();
    page.eye.position.fromArray(outside);
    page.orbit.target.fromArray(outside, 3);
    page.orbit.update();
    return true;
  }
  return false;
}
