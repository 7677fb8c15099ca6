// The page: loads the scene, draws it when something changes, and connects the controls.

import { decode } from "../decoding";
import type { Drawer, Times } from "../drawer";
import { openGpu } from "../gpu/device";
import { Renderer } from "../gpu/renderer";
import { PackError } from "../scene/container";
import type { Scene } from "../scene/scene";
import { viewOf, zoomed } from "../view";
import { openPainter } from "../webgl/painter";
import { Navigation } from "./navigation";

/** What scripts, and the tests of this repository, may ask of the page. */
export type Handle = {
  state: "loading" | "ready" | "failed";
  /** The error message, if any. */
  message: string;
  /** What draws: webgpu, webgl or image. */
  drawn: string;
  /** Milliseconds from the start of the page to the first image. */
  firstImage: number;
  times: Times | null;
  /** Frames drawn so far. */
  frames: number;
  cameras: number;
  /** Pixels of one camera of the capture, RGBA in bytes. */
  image: (camera: number, head: boolean, scale?: number) => Promise<{ width: number; height: number; pixels: string }>;
};

const FRAMES = 10;

const element = <T extends HTMLElement>(id: string): T => {
  const found = document.getElementById(id);
  if (found === null) throw new Error(`the page has no ${id}`);
  return found as T;
};

const controls = () => ({
  canvas: element<HTMLCanvasElement>("canvas"),
  poster: element<HTMLImageElement>("poster"),
  panel: element("panel"),
  message: element("message"),
  head: element<HTMLInputElement>("head"),
  headLabel: element("head-label"),
  fly: element<HTMLInputElement>("fly"),
  scale: element<HTMLInputElement>("scale"),
  scaleValue: element<HTMLOutputElement>("scale-value"),
  before: element<HTMLButtonElement>("before"),
  after: element<HTMLButtonElement>("after"),
  stop: element<HTMLOutputElement>("stop"),
  stats: element("stats"),
});

/** The bytes of the scene: in the page itself, or in a file beside it. */
async function sceneFile(): Promise<Uint8Array<ArrayBuffer>> {
  const place = element<HTMLScriptElement>("scene");
  const source = place.dataset.source;
  if (!source) {
    const text = atob(place.textContent!.trim());
    const bytes = new Uint8Array(text.length);
    for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
    place.remove();
    return bytes;
  }
  const advice = "serve this folder over http, for example by python -m http.server";
  const answer = await fetch(source).catch(() => {
    throw new PackError(`${source} cannot be loaded; ${advice}.`);
  });
  if (!answer.ok) throw new PackError(`${source} cannot be loaded (${answer.status}); put it beside this page.`);
  return new Uint8Array(await answer.arrayBuffer());
}

export async function start(program: string): Promise<void> {
  const page = controls();
  const handle: Handle = {
    state: "loading",
    message: "",
    drawn: "image",
    firstImage: Number.NaN,
    times: null,
    frames: 0,
    cameras: 0,
    image: () => Promise.reject(new Error("the scene is not ready")),
  };
  Object.assign(window, { sundae: handle });
  // The first message stays: later ones follow from it.
  const say = (text: string): void => {
    handle.message ||= text;
    page.message.textContent = handle.message;
    page.message.hidden = false;
  };
  try {
    const scene = await decode(await sceneFile(), program);
    const drawer = await openDrawer(scene, page.canvas, handle, say);
    await show(drawer, scene, page, handle, say);
    handle.state = "ready";
  } catch (error) {
    say(error instanceof PackError ? error.message : `The page failed (${error}).`);
    handle.state = "failed";
  }
}

const tooMany = (crowded: number): string =>
  `This view is not drawn: ${Math.round(crowded).toLocaleString("en")} primitives cover each of its pixels, ` +
  "too many for this page or for this GPU.";

/** WebGPU with the head, or base colours by WebGL2. */
async function openDrawer(
  scene: Scene,
  canvas: HTMLCanvasElement,
  handle: Handle,
  say: (text: string) => void,
): Promise<Drawer> {
  const gpu = await openGpu();
  if (gpu !== null) {
    handle.drawn = "webgpu";
    gpu.device.lost.then(({ message }) => say(`The browser lost the GPU (${message}); reload the page.`));
    gpu.device.addEventListener("uncapturederror", (event) => say(`The GPU failed (${event.error.message}).`));
    return new Renderer(gpu, scene, canvas);
  }
  const painter = openPainter(scene, canvas);
  if (painter === null) throw new PackError("This browser has neither WebGPU nor WebGL2, so the page shows one image.");
  handle.drawn = "webgl";
  say(`This browser has no WebGPU: base colours${scene.head ? ", without the compensation head" : ""}.`);
  return painter;
}

async function show(
  renderer: Drawer,
  scene: Scene,
  page: ReturnType<typeof controls>,
  handle: Handle,
  say: (text: string) => void,
): Promise<void> {
  let dirty = true;
  const mark = (): void => {
    dirty = true;
  };
  const navigation = new Navigation(scene, page.canvas, mark);
  const { stops } = navigation;
  page.headLabel.hidden = !renderer.hasHead;
  page.head.addEventListener("change", mark);
  page.scale.addEventListener("input", mark);
  page.fly.addEventListener("change", () => {
    navigation.fly = page.fly.checked;
  });
  let visited = navigation.stop ?? 0;
  const visit = (index: number): void => {
    visited = (index + stops.length) % stops.length;
    navigation.visit(visited);
  };
  page.before.addEventListener("click", () => visit(visited - 1));
  page.after.addEventListener("click", () => visit(visited + 1));
  new ResizeObserver(mark).observe(page.canvas);

  const moments: number[] = [];
  let last = 0;
  const draw = async (): Promise<void> => {
    const { canvas } = page;
    const [across, down] = [canvas.clientWidth * devicePixelRatio, canvas.clientHeight * devicePixelRatio];
    const scale = (Number(page.scale.value) / 100) * renderer.limit(across, down);
    const [width, height] = [across, down].map((length) => Math.max(Math.round(length * scale), 1)) as [number, number];
    // Even the same size would clear the canvas. The browser enlarges a smaller one.
    if (canvas.width !== width) canvas.width = width;
    if (canvas.height !== height) canvas.height = height;
    const started = performance.now();
    handle.times = await renderer.render(navigation.view(width, height), page.head.checked);
    const ended = performance.now();
    moments.push(ended - Math.max(started, last));
    last = ended;
    if (moments.length > FRAMES) moments.shift();
    const fps = (1000 * moments.length) / moments.reduce((sum, value) => sum + value, 0);
    const { splat, head, withoutHead, crowded } = handle.times;
    const passes = Number.isNaN(splat) ? "" : ` · splat ${splat.toFixed(1)} ms · head ${head.toFixed(1)} ms`;
    const reason = withoutHead ? " · the view is too large for the head on this GPU" : "";
    page.stats.textContent = `${fps.toFixed(fps < 10 ? 1 : 0)} fps${passes}${reason}`;
    page.message.textContent = crowded ? tooMany(crowded) : handle.message;
    page.message.hidden = !page.message.textContent;
    page.scaleValue.textContent = `${page.scale.value}%`;
    handle.frames += 1;
    page.stop.textContent = navigation.stop === null ? "free" : `${navigation.stop + 1} of ${stops.length}`;
  };

  await draw();
  handle.firstImage = performance.now();
  handle.cameras = scene.cameras.length;
  page.panel.hidden = false;
  page.poster.hidden = true;

  // One frame at a time: frames and the images of the handle share the buffers of the renderer.
  let busy: Promise<unknown> = Promise.resolve();
  handle.image = (camera, head, scale = 1) => {
    const view = zoomed(viewOf(stops[camera]!), scale);
    const image = busy.then(() => renderer.image(view, head));
    busy = image.catch(() => undefined);
    return image.then((pixels) => {
      let text = "";
      for (let i = 0; i < pixels.length; i += 2 ** 14) text += String.fromCharCode(...pixels.subarray(i, i + 2 ** 14));
      return { width: view.width, height: view.height, pixels: btoa(text) };
    });
  };
  const loop = (now: number): void => {
    if (navigation.move(now)) dirty = true;
    if (!dirty) {
      requestAnimationFrame(loop);
      return;
    }
    dirty = false;
    busy = busy.then(draw).catch((error) => say(`The page failed (${error}).`));
    busy.then(() => requestAnimationFrame(loop));
  };
  requestAnimationFrame(loop);
}
