// What all viewers of viewers.ts share: the lens of a camera, and the pixels of a canvas.

import type { Camera } from "../src/scene/scene";

export type Options = { renderer?: object; scene?: object };

/** Images of a file from some cameras of one size, on a black background: RGBA in bytes, the lowest row first. */
export type Show = (file: string, cameras: Camera[], options: Options) => Promise<string[]>;

export const NEAR = 0.01;
export const FAR = 1000;
/** From glTF, where +y points up, to the model, where +z does; row by row. */
export const FROM_GLTF = [-1, 0, 0, 0, 0, 0, 1, 0, 0, 1, 0, 0, 0, 0, 0, 1] as const;
/** Frames before an image is taken: workers sort between them. */
const FRAMES = 12;
const PAUSE = 50;

/** The projection of a camera's lens in OpenGL, row by row. */
export function projectionOf({ fx, fy, cx, cy, width, height }: Camera): number[] {
  const [x, y] = [(2 * fx) / width, (2 * fy) / height];
  const [right, up] = [1 - (2 * cx) / width, (2 * cy) / height - 1];
  const depth = [(FAR + NEAR) / (NEAR - FAR), (2 * FAR * NEAR) / (NEAR - FAR)] as const;
  return [x, 0, right, 0, 0, y, up, 0, 0, 0, ...depth, 0, 0, -1, 0];
}

/** A matrix given row by row, column by column. */
export function columns(rows: readonly number[]): number[] {
  return rows.map((_, i) => rows[4 * (i % 4) + Math.floor(i / 4)]!);
}

export async function afterFrames(draw: () => unknown): Promise<void> {
  for (let i = 0; i < FRAMES; i++) {
    await draw();
    await new Promise((done) => setTimeout(done, PAUSE));
  }
  await draw();
}

/** An empty page with a canvas. */
export function freshCanvas({ width, height }: Camera): HTMLCanvasElement {
  const canvas = Object.assign(document.createElement("canvas"), { width, height });
  Object.assign(canvas.style, { width: `${width}px`, height: `${height}px` });
  document.body.replaceChildren(canvas);
  return canvas;
}

/** The pixels that a canvas shows. */
export function pixelsOn(canvas: HTMLCanvasElement): string {
  const { width, height } = canvas;
  const copy = Object.assign(document.createElement("canvas"), { width, height }).getContext("2d")!;
  copy.setTransform(1, 0, 0, -1, 0, height); // the lowest row first, as WebGL has it
  copy.drawImage(canvas, 0, 0);
  return text(copy.getImageData(0, 0, width, height).data);
}

export function text(pixels: Uint8Array | Uint8ClampedArray): string {
  let found = "";
  for (let i = 0; i < pixels.length; i += 2 ** 14) found += String.fromCharCode(...pixels.subarray(i, i + 2 ** 14));
  return btoa(found);
}
