// Renders the cameras of a packed scene in half precision, by the page's own decoder and renderer under Node: Chromium
// takes no software adapter that has shader-f16. Writes the pixels of each camera beside the scene, and prints the
// adapter, or null if it has no half precision.
//
//     node render.mjs FILE

import { readFileSync, writeFileSync } from "node:fs";
import { create, globals } from "webgpu";
import { openGpu } from "../src/gpu/device";
import { Renderer } from "../src/gpu/renderer";
import { readScene } from "../src/scene/scene";
import { viewOf } from "../src/view";

Object.assign(globalThis, globals);
Object.defineProperty(globalThis, "navigator", { value: { gpu: create([]) } });
/** The renderer is given a canvas to show its images on, which these images do without. */
const canvas = { getContext: () => ({ configure: () => undefined }) } as unknown as HTMLCanvasElement;

const file = process.argv[2]!;
const gpu = await openGpu();
if (gpu?.half) {
  gpu.device.addEventListener("uncapturederror", ({ error }) => {
    throw new Error(error.message);
  });
  const scene = await readScene(new Uint8Array(readFileSync(file)));
  const renderer = new Renderer(gpu, scene, canvas);
  for (const [i, camera] of scene.cameras.entries()) {
    writeFileSync(`${file}.${i}`, await renderer.image(viewOf(camera), true));
  }
}
console.log(JSON.stringify(gpu?.half ? gpu.device.adapterInfo.description : null));
process.exit();
