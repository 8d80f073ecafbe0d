"use strict";
// How much to draw: everything at rest; while the view moves, as much as the browser draws 30 times a second.

// Of the points a part is drawn, of the surface a coarser one, of the pixels fewer. At rest there are more pixels than
// the screen has, because the page smooths no edges otherwise.
const PACES = [
  { resolution: devicePixelRatio < 1.5 ? 1.5 : 1, points: 1, coarse: false },
  { resolution: 1, points: 0.5, coarse: false },
  { resolution: 0.75, points: 0.3, coarse: true },
  { resolution: 0.6, points: 0.2, coarse: true },
  { resolution: 0.5, points: 0.14, coarse: true },
  { resolution: 0.4, points: 0.09, coarse: true },
];
const SLOW_MS = 31; // a frame that takes longer counts as slow
const FAST_MS = 19;
const REST_MS = 220; // the view is at rest if nothing moved for so long

class Pace {
  constructor() {
    this.step = 2; // for motion; corrected from the first frames on
    this.moved = -Infinity;
    this.drawn = 0; // when the latest frame began
    this.last = 0;
    this.slow = this.fast = 0;
    this.floor = 0; // the step below which this motion was too slow
  }

  /** The view moves. */
  move(now = performance.now()) {
    if (!this.moving(now)) {
      this.last = 0;
      this.floor = Math.max(0, this.floor - 1);
    }
    this.moved = now;
  }

  /** Return whether the view moves. What moved during a frame counts, however long the frame took. */
  moving(now = performance.now()) { return now - this.moved < REST_MS || this.moved > this.drawn; }

  /** Return what to draw in a frame that is about to be drawn. */
  frame(now) {
    const moving = this.moving(now);
    this.drawn = performance.now();
    if (!moving) {
      this.last = 0;
      return PACES[0];
    }
    const took = this.last ? now - this.last : 0;
    this.last = now;
    if (took > SLOW_MS && took < 1000) {
      this.fast = 0;
      this.slow += took > 2 * SLOW_MS ? 2 : 1;
    } else if (took && took < FAST_MS) {
      this.slow = 0;
      this.fast++;
    } else {
      this.slow = Math.max(0, this.slow - 0.25);
    }
    if (this.slow >= 2 && this.step < PACES.length - 1) {
      this.floor = ++this.step;
      this.slow = 0;
    } else if (this.fast >= 20 && this.step > this.floor) {
      this.step--;
      this.fast = 0;
    }
    return PACES[this.step];
  }
}
