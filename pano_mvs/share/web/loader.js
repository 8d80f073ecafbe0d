"use strict";
// Data arrive as scripts that call `PanoMvs.receive`: a page from a disk may load scripts, but read no other files.
const PanoMvs = {
  values: new Map(),
  waiting: new Map(),
  loaded: [], // the keys of all pieces of data, in the order in which the page asked for them

  receive(key, value) {
    const waiting = this.waiting.get(key);
    if (waiting) {
      this.waiting.delete(key);
      waiting(value);
    } else {
      this.values.set(key, value);
    }
  },

  /** Return a promise of a piece of data; the page does not keep it. */
  load(key) {
    this.loaded.push(key);
    if (this.values.has(key)) return Promise.resolve(this.values.get(key)); // part of a single file
    return new Promise((resolve, reject) => {
      const script = document.createElement("script");
      this.waiting.set(key, (value) => {
        script.remove();
        resolve(value);
      });
      script.onerror = () => {
        this.waiting.delete(key);
        script.remove();
        reject(new Error(`data/${key}.js is missing`));
      };
      script.src = `data/${key}.js`;
      document.head.append(script);
    });
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
