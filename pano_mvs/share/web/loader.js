"use strict";
// Data arrive as scripts that call `PanoMvs.receive`: a page from a disk may load scripts, but read no other files.
const PanoMvs = {
  values: new Map(),
  waiting: new Map(),

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

/** Return a promise of a texture from the base64 text of a JPEG file. */
function textureOf(text) {
  return new Promise((resolve, reject) => {
    const image = new Image();
    image.onload = () => {
      const texture = new THREE.Texture(image);
      texture.colorSpace = THREE.SRGBColorSpace;
      texture.minFilter = THREE.LinearMipmapLinearFilter;
      texture.anisotropy = 4;
      texture.needsUpdate = true;
      resolve(texture);
    };
    image.onerror = () => reject(new Error("a tile of a panorama is damaged"));
    image.src = `data:image/jpeg;base64,${text}`;
  });
}
