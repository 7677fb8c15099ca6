// The controls of the page: panel, buttons and keys.

import type { Loop } from "./loop";
import type { Navigation } from "./navigation";

/** Milliseconds for which a short message stays. */
const MOMENT = 2500;

export const element = <T extends HTMLElement>(id: string): T => {
  const found = document.getElementById(id);
  if (found === null) throw new Error(`the page has no ${id}`);
  return found as T;
};

/** Sets a text; screen readers would read the same one again. */
export const write = (place: HTMLElement, text: string): void => {
  if (place.textContent !== text) place.textContent = text;
};

export const elements = () => ({
  stage: element("stage"),
  /** The place of a scene; another one beside it has a copy. */
  half: document.querySelector<HTMLElement>(".half")!,
  poster: element<HTMLImageElement>("poster"),
  progress: element<HTMLProgressElement>("progress"),
  panel: element("panel"),
  message: element("message"),
  said: element("said"),
  status: element("status"),
  head: element<HTMLInputElement>("head"),
  headLabel: element("head-label"),
  fly: element<HTMLInputElement>("fly"),
  scale: element<HTMLInputElement>("scale"),
  scaleValue: element<HTMLOutputElement>("scale-value"),
  stop: element<HTMLOutputElement>("stop"),
  play: element("play"),
  views: element("views"),
  stats: element("stats"),
});

export type Elements = ReturnType<typeof elements>;

/** Connects the controls with the camera and the loops, one for each scene. */
export function connect(page: Elements, navigation: Navigation, loops: Loop[]): void {
  const { stops } = navigation;
  const mark = (): void => {
    for (const loop of loops) loop.mark();
  };
  const visit = (step: number): void => navigation.visit((navigation.visited + step + stops.length) % stops.length);
  let timer: ReturnType<typeof setTimeout>;
  const tell = (text: string): void => {
    clearTimeout(timer);
    page.status.textContent = text;
    page.status.hidden = false;
    timer = setTimeout(() => {
      page.status.hidden = true;
    }, MOMENT);
  };
  const copyLink = async (): Promise<void> => {
    const hash = navigation.link();
    // A page inside of another may be kept from the clipboard, or from changing its address.
    const link = new URL(hash, location.href).href;
    const copied = await navigator.clipboard?.writeText(link).then(
      () => true,
      () => false,
    );
    let kept = true;
    try {
      history.replaceState(null, "", hash);
    } catch {
      kept = false;
    }
    tell(copied ? "Link copied" : kept ? "The link is in the address bar" : "This browser does not allow to copy here");
  };
  const picture = async (): Promise<void> => {
    const images = await Promise.all(loops.map((loop) => loop.image(null, page.head.checked)));
    const stacked = images.length > 1 && page.stage.clientHeight > page.stage.clientWidth;
    const [across, down] = (["width", "height"] as const).map((side) => images.map((image) => image[side]));
    const sum = (sides: number[]): number => sides.reduce((one, other) => one + other);
    const [width, height] = stacked ? [Math.max(...across!), sum(down!)] : [sum(across!), Math.max(...down!)];
    const canvas = Object.assign(document.createElement("canvas"), { width, height });
    let [x, y] = [0, 0];
    for (const image of images) {
      canvas.getContext("2d")!.putImageData(new ImageData(image.pixels, image.width, image.height), x, y);
      if (stacked) y += image.height;
      else x += image.width;
    }
    const blob = await new Promise<Blob | null>((resolve) => canvas.toBlob(resolve));
    const href = URL.createObjectURL(blob!);
    const download = `${document.title.replace(/[^\p{L}\p{N}.-]+/gu, "_") || "scene"}.png`;
    Object.assign(document.createElement("a"), { href, download }).click();
    setTimeout(() => URL.revokeObjectURL(href), MOMENT);
    tell(`Picture saved, ${width} x ${height}`);
  };
  const save = (): Promise<void> => picture().catch(() => tell("This browser cannot save the picture"));
  const whole = (): void => {
    if (!document.fullscreenEnabled) return;
    const change = document.fullscreenElement
      ? document.exitFullscreen()
      : document.documentElement.requestFullscreen();
    change.catch(() => tell("This browser does not allow a full screen here"));
  };
  const actions: Record<string, () => void> = {
    before: () => visit(-1),
    after: () => visit(1),
    link: copyLink,
    picture: save,
    full: whole,
    play: () => navigation.play(named.map(([, hash]) => hash)),
  };
  const named: [string, string][] = JSON.parse(element("named").textContent || "[]");
  for (const [name, hash] of named) {
    const button = Object.assign(document.createElement("button"), { type: "button", textContent: name });
    button.addEventListener("click", () => navigation.follow(hash));
    page.views.append(button);
  }
  page.views.hidden = named.length === 0;
  for (const [id, act] of Object.entries(actions)) element(id).addEventListener("click", act);
  element("full").hidden = !document.fullscreenEnabled;
  element("close").addEventListener("click", () => {
    page.message.hidden = true;
  });
  page.head.addEventListener("change", mark);
  page.scale.addEventListener("input", mark);
  page.fly.addEventListener("change", () => {
    navigation.fly = page.fly.checked;
  });

  const keys: Record<string, () => void> = {
    PageUp: actions.before!,
    PageDown: actions.after!,
    KeyL: copyLink,
    KeyP: save,
    KeyF: whole,
    KeyH: () => page.head.click(),
  };
  window.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || event.repeat || event.target === page.scale) return;
    keys[event.code]?.();
  });
  window.addEventListener("hashchange", () => navigation.follow(location.hash));
  new ResizeObserver(() => navigation.onChange()).observe(page.stage);
  page.stage.setAttribute("aria-label", `3D view of ${document.title}`);
  // A small page and a phone keep their view free.
  if (page.stage.clientHeight >= 400 && page.stage.clientWidth > 600) page.panel.setAttribute("open", "");
}
