"use strict";
// Data arrive as scripts that call `PanoMvs.receive`: a page from a disk may load scripts, but read no other files.
const PanoMvs = {
  values: new Map(),
  waiting: new Map(), // the key of each piece of data that is on its way, to its promise and what keeps that
  loaded: [], // the keys of all pieces of data, in the order in which the page asked for them

  receive(key, value) {
    const waiting = this.waiting.get(key);
    if (waiting) waiting.resolve(value);
    else this.values.set(key, value);
  },

  /** Return a promise of a piece of data; the page does not keep it. */
  load(key) {
    this.loaded.push(key);
    if (this.values.has(key)) return Promise.resolve(this.values.get(key)); // part of a single file
    if (!this.waiting.has(key)) this.waiting.set(key, this.ask(key));
    return this.waiting.get(key).promise;
  },

  /** Load the script of a piece of data; return a promise of the piece, and the function that keeps it. */
  ask(key) {
    const asked = {};
    asked.promise = new Promise((resolve, reject) => {
      const script = document.createElement("script");
      const ended = (then) => (value) => {
        if (this.waiting.get(key) === asked) this.waiting.delete(key); // not if it was asked for again
        script.remove();
        then(value);
      };
      asked.resolve = ended(resolve);
      script.onerror = ended(() => reject(new Error(`data/${key}.js is missing`)));
      script.onload = ended(() => reject(new Error(`data/${key}.js is damaged`))); // without effect if data arrived
      script.src = `data/${key}.js`;
      document.head.append(script);
    });
    return asked;
  },
};

/** Return the bytes of a base64 text. */
function bytesOf(text) {
  const binary = atob(text);
  const bytes = new Uint8Array(binary.length);
  for (let i = 0; i < binary.length; i++) bytes[i] = binary.charCodeAt(i);
  return bytes;
}

/** Return a promise of an image from the base64 text of a file, "jpeg" or "png". */
function imageOf(text, kind, what) {
  return new Promise((resolve, reject) => {
    const image = new Image();
    image.onload = () => resolve(image);
    image.onerror = () => reject(new Error(`${what} is damaged`));
    image.src = `data:image/${kind};base64,${text}`;
  });
}

/** Return a promise of a texture from the base64 text of a JPEG file; shaders read the values of the file as they are. */
async function textureOf(text, what) {
  const texture = new THREE.Texture(await imageOf(text, "jpeg", what));
  texture.colorSpace = THREE.NoColorSpace;
  texture.minFilter = THREE.LinearMipmapLinearFilter;
  texture.needsUpdate = true;
  return texture;
}

/** Return the value of a step of `log_steps`; 0 for step 0. */
function valueOfStep(step, [low, high], steps) {
  return step ? low * Math.exp(((step - 1) * Math.log(high / low)) / (steps - 1)) : 0;
}
