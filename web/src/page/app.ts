// The page: loads the scene, opens what draws it, and tells how it goes.

import { decode } from "../decoding";
import type { Times } from "../drawer";
import { PackError } from "../scene/container";
import type { Scene } from "../scene/scene";
import { enlarged, unitOf } from "../scene/size";
import { viewOf, zoomed } from "../view";
import { onThisDevice } from "./budget";
import { connect, type Elements, elements, write } from "./controls";
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
  /** Gaussians that are drawn, of each scene. */
  count: number[];
  /** Pixels of one camera of the capture, RGBA in bytes. */
  image: (camera: number, head: boolean, scale?: number) => Promise<{ width: number; height: number; pixels: string }>;
};

/** Images with a moving camera over which the frame rate is a mean. */
const FRAMES = 10;
/** Shares of the loading time: a file beside the page, then decoding, then what the GPU prepares. */
const LOADED = 0.3;
const DECODED = 0.9;

/** The bytes of a scene: in the page itself, or in a file beside it. */
async function sceneFile(
  place: HTMLScriptElement,
  onProgress: (share: number) => void,
): Promise<Uint8Array<ArrayBuffer>> {
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
  const next = () =>
    reader.read().catch(() => {
      throw new PackError(`${source} was cut off while it was loaded; load the page again.`);
    });
  for (let part = await next(); !part.done; part = await next()) {
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
    count: [],
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
  const places = [...document.querySelectorAll<HTMLScriptElement>("script.scene")];
  try {
    const scenes: Scene[] = [];
    for (const [i, place] of places.entries()) {
      const progress = (from: number, to: number) => (share: number) => {
        page.progress.value = (i + from + share * (to - from)) / places.length;
      };
      const file = await sceneFile(place, progress(0, LOADED));
      scenes.push(onThisDevice(await decode(file, program, progress(LOADED, DECODED))));
    }
    const names = places.map((place) => place.dataset.name ?? "");
    await show(scenes, names, page, handle, fail);
    handle.state = "ready";
  } catch (error) {
    fail(error);
  }
}

const tooMany = (crowded: number): string =>
  `This view is not drawn: ${Math.round(crowded).toLocaleString("en")} Gaussians cover each of its pixels, ` +
  "too many for this page or for this GPU.";

/** A place for each scene, side by side, each with the name of its scene. */
function halves(page: Elements, names: string[]): HTMLElement[] {
  if (names.length === 1) return [page.half];
  const copy = page.half.cloneNode(true) as HTMLElement;
  return names.map((name, i) => {
    const half = i ? copy : page.half;
    half.append(Object.assign(document.createElement("span"), { className: "name", textContent: name }));
    page.stage.append(half);
    return half;
  });
}

/** Shows the scenes by one camera, until `fail` is called. */
async function show(
  given: Scene[],
  names: string[],
  page: Elements,
  handle: Handle,
  fail: (error: unknown) => void,
): Promise<void> {
  const unit = Math.min(...given.map(unitOf));
  const scenes = given.map((scene) => enlarged(scene, unit));
  const navigation = new Navigation(scenes[0]!, page.stage, unit);
  const wanted = () => ({ scale: Number(page.scale.value) / 100, head: page.head.checked });
  const places = halves(page, names);
  const stages = scenes.map((scene, i) => new Stage(scene, places[i]!, () => loops[i]!.mark()));
  const loops: Loop[] = stages.map((stage, i) => {
    const told = follow(page, handle, stages, i, navigation);
    return new Loop(stage, navigation, places[i]!, wanted, told);
  });
  const loop = loops[0]!;
  navigation.onChange = () => {
    for (const each of loops) each.moved();
  };
  navigation.follow(location.hash);
  Object.defineProperty(handle, "still", { get: () => loops.every((each) => each.still) });
  for (const stage of stages) await stage.open();
  for (const each of loops) await each.run(fail);
  handle.firstImage = performance.now();
  handle.cameras = scenes[0]!.cameras.length;
  handle.count = scenes.map(({ field }) => field.count);
  handle.image = async (camera, head, scale = 1) => {
    const { pixels, ...size } = await loop.image(zoomed(viewOf(navigation.stops[camera]!), scale), head);
    let text = "";
    for (let i = 0; i < pixels.length; i += 2 ** 14) text += String.fromCharCode(...pixels.subarray(i, i + 2 ** 14));
    return { ...size, pixels: btoa(text) };
  };
  connect(page, navigation, loops);
  page.panel.hidden = false;
  page.poster.hidden = page.progress.hidden = true;
}

/** What tells of each image of a stage: the handle and the figures of the first one, message and panel of all. */
function follow(
  page: Elements,
  handle: Handle,
  stages: Stage[],
  index: number,
  navigation: Navigation,
): (frame: Frame) => void {
  const stage = stages[index]!;
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
    const parts = [rate, ...passes, reason, stage.left];
    if (index === 0) {
      write(page.stats, parts.filter(Boolean).join(" · "));
      Object.assign(handle, { times, drawn: stage.drawn });
    }
    stage.crowded = crowded;
    const most = Math.max(...stages.map((each) => each.crowded));
    const notice = stages.map((each) => each.notice).find(Boolean) ?? "";
    Object.assign(handle, { message: notice, frames: handle.frames + 1 });
    const said = most ? tooMany(most) : notice;
    // A message that was closed stays closed.
    if (said !== page.said.textContent) {
      page.said.textContent = said;
      page.message.hidden = !said;
    }
    page.headLabel.hidden = !stages.some((each) => each.hasHead);
    write(page.play, navigation.playing ? "Stop" : "Play");
    write(page.scaleValue, `${page.scale.value}%`);
    write(page.stop, navigation.stop === null ? "free" : `${navigation.stop + 1} of ${navigation.stops.length}`);
  };
}
