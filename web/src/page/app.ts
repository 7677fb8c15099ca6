// The page: loads the scene, opens what draws it, and tells how it goes.

import { decode } from "../decoding";
import type { Times } from "../drawer";
import { PackError } from "../scene/container";
import type { Scene } from "../scene/scene";
import { viewOf, zoomed } from "../view";
import { connect, type Elements, element, elements, write } from "./controls";
import { type Frame, Loop } from "./loop";
import { Navigation } from "./navigation";
import { Stage } from "./stage";

/** What scripts, and the tests of this repository, may ask of the page. */
export type Handle = {
  state: "loading" | "ready" | "failed";
  /** The error message, if any, or why only base colours are shown. */
  message: string;
  /** What draws: webgpu, webgl or image. */
  drawn: string;
  /** Whether the image on show is the final one: the camera rests, and the head has faded in. */
  readonly still: boolean;
  /** Milliseconds from the start of the page to the first image. */
  firstImage: number;
  /** Of the last image. */
  times: Times | null;
  /** Images drawn so far, without those of a fade. */
  frames: number;
  cameras: number;
  /** Pixels of one camera of the capture, RGBA in bytes. */
  image: (camera: number, head: boolean, scale?: number) => Promise<{ width: number; height: number; pixels: string }>;
};

/** Images with a moving camera over which the frame rate is a mean. */
const FRAMES = 10;
/** Shares of the loading time: a file beside the page, then decoding, then what the GPU prepares. */
const LOADED = 0.3;
const DECODED = 0.9;

/** The bytes of the scene: in the page itself, or in a file beside it. */
async function sceneFile(onProgress: (share: number) => void): Promise<Uint8Array<ArrayBuffer>> {
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
  const length = Number(answer.headers.get("content-length"));
  const chunks: Uint8Array<ArrayBuffer>[] = [];
  let loaded = 0;
  const reader = answer.body!.getReader();
  for (let part = await reader.read(); !part.done; part = await reader.read()) {
    chunks.push(part.value);
    loaded += part.value.length;
    if (length) onProgress(Math.min(loaded / length, 1));
  }
  return new Uint8Array(await new Blob(chunks).arrayBuffer());
}

export async function start(program: string): Promise<void> {
  const page = elements();
  const handle: Handle = {
    state: "loading",
    message: "",
    drawn: "image",
    still: false,
    firstImage: Number.NaN,
    times: null,
    frames: 0,
    cameras: 0,
    image: () => Promise.reject(new Error("the scene is not ready")),
  };
  Object.assign(window, { sundae: handle });
  // The first error stays: later ones follow from it. The image of the file comes back.
  const fail = (error: unknown): void => {
    if (handle.state === "failed") return;
    handle.state = "failed";
    handle.drawn = "image";
    handle.message = error instanceof PackError ? error.message : `The page failed (${error}).`;
    page.said.textContent = handle.message;
    page.message.hidden = page.poster.hidden = false;
    page.stage.hidden = page.panel.hidden = page.progress.hidden = true;
  };
  const progress = (from: number, to: number) => (share: number) => {
    page.progress.value = from + share * (to - from);
  };
  try {
    const file = await sceneFile(progress(0, LOADED));
    const scene = await decode(file, program, progress(LOADED, DECODED));
    await show(scene, page, handle, fail);
    handle.state = "ready";
  } catch (error) {
    fail(error);
  }
}

const tooMany = (crowded: number): string =>
  `This view is not drawn: ${Math.round(crowded).toLocaleString("en")} primitives cover each of its pixels, ` +
  "too many for this page or for this GPU.";

/** Shows the scene, until `fail` is called. */
async function show(scene: Scene, page: Elements, handle: Handle, fail: (error: unknown) => void): Promise<void> {
  const stage = new Stage(scene, page.stage, () => loop.mark());
  const navigation = new Navigation(scene, page.stage);
  const wanted = () => ({ scale: Number(page.scale.value) / 100, head: page.head.checked });
  const told = follow(page, handle, stage, navigation);
  const loop: Loop = new Loop(stage, navigation, page.stage, wanted, told);
  navigation.onChange = () => loop.moved();
  navigation.follow(location.hash);
  Object.defineProperty(handle, "still", { get: () => loop.still });
  await stage.open();
  await loop.run(fail);
  handle.firstImage = performance.now();
  handle.cameras = scene.cameras.length;
  handle.image = async (camera, head, scale = 1) => {
    const { pixels, ...size } = await loop.image(zoomed(viewOf(navigation.stops[camera]!), scale), head);
    let text = "";
    for (let i = 0; i < pixels.length; i += 2 ** 14) text += String.fromCharCode(...pixels.subarray(i, i + 2 ** 14));
    return { ...size, pixels: btoa(text) };
  };
  connect(page, navigation, loop);
  page.panel.hidden = false;
  page.poster.hidden = page.progress.hidden = true;
}

/** What tells of each image: the handle, the message and the panel. */
function follow(page: Elements, handle: Handle, stage: Stage, navigation: Navigation): (frame: Frame) => void {
  const spans: number[] = [];
  return ({ times, spent, moving }) => {
    // The first image also compiles shaders.
    if (moving && handle.frames > 0) spans.push(spent);
    if (spans.length > FRAMES) spans.shift();
    const fps = (1000 * spans.length) / spans.reduce((sum, value) => sum + value, 0);
    const { splat, head, withoutHead, crowded } = times;
    const passes = Number.isNaN(splat)
      ? []
      : [`splat ${splat.toFixed(1)} ms`, head ? `head ${head.toFixed(1)} ms` : ""];
    const reason = withoutHead ? "the view is too large for the head on this GPU" : "";
    const rate = spans.length ? `${fps.toFixed(fps < 10 ? 1 : 0)} fps` : "";
    const parts = [rate, ...passes, reason];
    write(page.stats, parts.filter(Boolean).join(" · "));
    Object.assign(handle, { times, drawn: stage.drawn, message: stage.notice, frames: handle.frames + 1 });
    const said = crowded ? tooMany(crowded) : stage.notice;
    // A message that was closed stays closed.
    if (said !== page.said.textContent) {
      page.said.textContent = said;
      page.message.hidden = !said;
    }
    page.headLabel.hidden = !stage.hasHead;
    write(page.scaleValue, `${page.scale.value}%`);
    write(page.stop, navigation.stop === null ? "free" : `${navigation.stop + 1} of ${navigation.stops.length}`);
  };
}
