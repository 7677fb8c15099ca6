// Times the page's renderer under Node, on the adapter that Dawn finds: a JSON line for each scene of a folder that
// bench_page.py --dawn wrote, with the head off and on. A frame is timed as the page draws it, from the call to the
// moment when its results are on the host. Other frames time each kernel, in a pass of its own.
//
//     node timing.mjs FOLDER

import { existsSync, readFileSync } from "node:fs";
import { join } from "node:path";
import { create, globals } from "webgpu";
import { openGpu } from "../src/gpu/device";
import { Renderer } from "../src/gpu/renderer";
import { type HeadKind, layersOf } from "../src/scene/head";
import { readScene } from "../src/scene/scene";
import { scalePlan, type View, viewOf, zoomed } from "../src/view";
import { medianOf, quantileOf, Stopwatch } from "./stopwatch";

type Task = {
  name: string;
  /** Most frames of each kind, and the seconds after which no further one begins. */
  frames: number;
  seconds: number;
  /** Cameras whose images are compared, and the distance of the rows that Python's images have. */
  scenes: { file: string; compared: number[]; step: number }[];
};

/** Frames before those that are timed, for each camera: the first ones compile shaders and make buffers. */
const WARM = 2;

const folder = process.argv[2]!;
const task = JSON.parse(readFileSync(join(folder, "task.json"), "utf8")) as Task;

/** PSNR in decibels of an image in bytes against Python's rows of it, which have 16 bits. */
function psnrOf(pixels: Uint8ClampedArray, width: number, reference: string, step: number): number {
  const bytes = readFileSync(join(folder, reference));
  const truth = new Uint16Array(bytes.buffer, bytes.byteOffset, bytes.byteLength / 2);
  let sum = 0;
  for (let i = 0; i < truth.length; i++) {
    const [pixel, channel] = [Math.floor(i / 3), i % 3];
    const place = Math.floor(pixel / width) * step * width + (pixel % width);
    sum += (pixels[4 * place + channel]! / 255 - truth[i]! / 65535) ** 2;
  }
  return Number((-10 * Math.log10(sum / truth.length + 1e-12)).toFixed(2));
}

/** Billions of multiplications and additions of the head's convolutions on an image of this size. */
function workOf(kind: HeadKind, { width, height }: View): number {
  const { encoder, decoder, out } = layersOf(kind);
  const stride = kind.fold * 2 ** (encoder.length - 1);
  const pixels = Math.ceil(width / stride) * Math.ceil(height / stride) * 4 ** (encoder.length - 1);
  const at = (level: number) => pixels / 4 ** level;
  const levels = [...encoder.map((layers, i) => ({ layers, level: i })), { layers: [out], level: 0 }];
  levels.push(...decoder.map((layers, i) => ({ layers, level: encoder.length - 2 - i })));
  const terms = levels.flatMap(({ layers, level }) =>
    layers.map(({ inputs, outputs, side }) => 2 * inputs * outputs * side ** 2 * at(level)),
  );
  return terms.reduce((sum, term) => sum + term, 0) / 1e9;
}

/** Calls `work` for one view after the other, up to the limits of the task, but at least once for each view. */
async function repeat(views: View[], work: (view: View, camera: number) => Promise<void>): Promise<void> {
  const started = performance.now();
  const late = () => performance.now() - started > task.seconds * 1000;
  for (let i = 0; i < views.length || (i < task.frames && !late()); i++) {
    await work(views[i % views.length]!, i % views.length);
  }
}

Object.assign(globalThis, globals);
// Browsers round the times of passes to 0.1 ms, which is longer than some kernels take.
const dawn = create(["disable-dawn-features=timestamp_quantization"]);
Object.defineProperty(globalThis, "navigator", { value: { gpu: dawn } });
const gpu = await openGpu().catch(() => null);
if (gpu === null) {
  console.log(
    JSON.stringify({ error: "Dawn finds no adapter: install libvulkan1 and the GPU's driver, or Mesa 25 or newer" }),
  );
  process.exit(1);
}
const { device, half, timed } = gpu;
device.addEventListener("uncapturederror", ({ error }) => {
  console.error(error.message);
  process.exit(1);
});
const { vendor, architecture, description } = device.adapterInfo;
const adapter = { adapter: description, vendor, architecture, half, timed };
const stopwatch = timed ? new Stopwatch(device) : null;

for (const { file, compared, step } of task.scenes) {
  const scene = await readScene(new Uint8Array(readFileSync(join(folder, file))));
  const decoded = performance.now();
  const views = scene.cameras.map(viewOf);
  const { width, height } = views[0]!;
  const texture = device.createTexture({
    size: [width, height],
    format: navigator.gpu.getPreferredCanvasFormat(),
    usage: GPUTextureUsage.RENDER_ATTACHMENT,
  });
  /** Stands for the canvas: the page's last pass draws on its texture. */
  const context = { configure: () => undefined, getCurrentTexture: () => texture };
  const renderer = new Renderer(gpu, scene, { getContext: () => context } as unknown as HTMLCanvasElement);
  await renderer.render(views[0]!, false, 1);
  /** From the decoded scene to its first image, shaders included. */
  const first = Number((performance.now() - decoded).toFixed(1));
  for (const head of scene.head ? [false, true] : [false]) {
    const psnr: number[] = [];
    for (const camera of compared) {
      const pixels = await renderer.image(views[camera]!, head);
      const reference = `${file}.${camera}.${head ? "rgb" : "base_rgb"}`;
      if (existsSync(join(folder, reference))) psnr.push(psnrOf(pixels, width, reference, step));
    }
    for (let i = 0; i < WARM; i++) for (const view of views) await renderer.render(view, head, 1);
    const frames = { whole: [] as number[], splat: [] as number[], head: [] as number[] };
    const byCamera: number[][] = views.map(() => []);
    let undrawn = 0;
    await repeat(views, async (view, camera) => {
      const started = performance.now();
      const times = await renderer.render(view, head, 1);
      const spent = performance.now() - started;
      frames.whole.push(spent);
      byCamera[camera]!.push(spent);
      frames.splat.push(times.splat);
      frames.head.push(times.head);
      undrawn += Number(times.crowded > 0 || times.withoutHead);
    });
    const kernels = new Map<string, number[]>();
    if (stopwatch) {
      await repeat(views, async (view) => {
        stopwatch.start();
        await renderer.render(view, head, 1);
        for (const [name, spent] of await stopwatch.stop()) {
          if (!kernels.has(name)) kernels.set(name, []);
          kernels.get(name)!.push(spent);
        }
      });
    }
    const { whole } = frames;
    const seen = views.map((view) => zoomed(view, scalePlan(view, scene.trainedFocal).zoom));
    const work = head ? seen.map((view) => workOf(scene.head!.kind, view)) : [0];
    const passes = timed ? { ms_splat: medianOf(frames.splat), ms_head: medianOf(frames.head) } : {};
    const row = {
      scene: task.name,
      ...adapter,
      primitives: scene.field.count,
      size: `${width}x${height}`,
      head,
      head_gflop: medianOf(work),
      cameras: views.length,
      frames: whole.length,
      undrawn,
      ms_first: first,
      ms_frame: medianOf(whole),
      ms_frame_tenths: [quantileOf(whole, 0.1), quantileOf(whole, 0.9)],
      ms_frame_by_camera: byCamera.map(medianOf),
      ...passes,
      ms_kernels: Object.fromEntries([...kernels].map(([name, spent]) => [name, medianOf(spent)])),
      psnr,
    };
    console.log(JSON.stringify(row));
  }
  texture.destroy();
}
process.exit();
