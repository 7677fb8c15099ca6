// When the page draws, and what: base colours while the camera moves, then the whole image, whose head fades in.

import type { Times } from "../drawer";
import type { View } from "../view";
import type { Navigation } from "./navigation";
import { Pace } from "./pace";
import type { Stage } from "./stage";

/** Milliseconds without a movement after which the camera rests. */
const REST = 150;
/** Milliseconds in which the head fades in. */
const FADE = 150;

export type Frame = {
  times: Times;
  /** Milliseconds that it took, and whether the camera moves. */
  spent: number;
  moving: boolean;
};

/** An image: RGBA in bytes. */
export type Image = { width: number; height: number; pixels: Uint8ClampedArray<ArrayBuffer> };

export class Loop {
  /** Whether the image on show is the final one of its view. */
  still = false;
  private changed = true;
  private movedAt = performance.now();
  /** Whether the last image had the resolution and the head of a camera at rest. */
  private whole = false;
  /** The share of the head in the image on show. */
  private share = 0;
  private fadingSince = 0;
  /** Pixels of the screen in one of the page; a window that moves to another screen may keep its size. */
  private ratio = devicePixelRatio;
  private readonly pace = new Pace();
  /** One at a time: frames and other images share the buffers of the drawer. */
  private busy: Promise<unknown> = Promise.resolve();

  /**
   * @param place - gives the canvas its size
   * @param wanted - the share of the full resolution, and whether the head is enabled
   * @param onFrame - called after each image that is not a part of a fade
   */
  constructor(
    private readonly stage: Stage,
    private readonly navigation: Navigation,
    private readonly place: HTMLElement,
    private readonly wanted: () => { scale: number; head: boolean },
    private readonly onFrame: (frame: Frame) => void,
  ) {}

  /** Draws again, because something other than the camera has changed. */
  mark(): void {
    this.changed = true;
    this.still = false;
  }

  /** Draws again, because the camera has moved. */
  moved(): void {
    this.movedAt = performance.now();
    this.mark();
  }

  /** Draws the first image, then one after the other as they are needed; `fail` is called when none can be drawn. */
  async run(fail: (error: unknown) => void): Promise<void> {
    await this.draw(true);
    const next = (now: number): void => {
      if (this.navigation.move(now) || this.ratio !== devicePixelRatio) this.moved();
      this.busy = this.busy.then(() => this.step());
      this.busy.then(() => requestAnimationFrame(next), fail);
    };
    requestAnimationFrame(next);
  }

  private async step(): Promise<void> {
    const now = performance.now();
    if (now - this.movedAt < REST) {
      if (this.changed) await this.draw(true);
    } else if (this.changed || !this.whole) await this.draw(false);
    else if (!this.still) await this.fade(Math.min((now - this.fadingSince) / FADE, 1));
  }

  private async draw(moving: boolean): Promise<void> {
    this.changed = false;
    this.ratio = devicePixelRatio;
    const { scale, head } = this.wanted();
    const shown = moving ? this.pace.share : 1;
    const corrected = head && this.stage.hasHead;
    const fades = corrected && this.share === 0 && !matchMedia("(prefers-reduced-motion: reduce)").matches;
    const started = performance.now();
    const times = await this.stage.use((drawer) => {
      const view = this.fitted(scale * shown * drawer.limit(...this.size));
      return drawer.render(view, corrected && !moving, fades ? 0 : 1);
    });
    const spent = performance.now() - started;
    if (moving) this.pace.learn(spent);
    this.whole = !moving || (shown === 1 && !corrected);
    this.share = corrected && !moving && !fades ? 1 : 0;
    this.fadingSince = performance.now();
    this.still = this.whole && !this.changed && this.share === Number(corrected);
    this.onFrame({ times, spent, moving });
  }

  private async fade(share: number): Promise<void> {
    await this.stage.use((drawer) => drawer.fade(share));
    this.share = share;
    this.still = share === 1 && !this.changed;
  }

  /** Width and height of the page in pixels of the screen. */
  private get size(): [number, number] {
    return [this.place.clientWidth * this.ratio, this.place.clientHeight * this.ratio];
  }

  /** The view of the canvas, which gets its size. */
  private fitted(scale: number): View {
    const { canvas } = this.stage;
    const [width, height] = this.size.map((side) => Math.max(Math.round(side * scale), 1)) as [number, number];
    // Even the same size would clear the canvas. The browser enlarges a smaller one.
    if (canvas.width !== width) canvas.width = width;
    if (canvas.height !== height) canvas.height = height;
    return this.navigation.view(width, height);
  }

  /** An image of some view; of what the page shows, at full resolution, without one. */
  image(view: View | null, head: boolean): Promise<Image> {
    const image = this.busy.then(() =>
      this.stage.use(async (drawer) => {
        const [across, down] = this.size;
        const factor = drawer.limit(across, down);
        const seen =
          view ?? this.navigation.view(...([across, down].map((s) => Math.round(s * factor)) as [number, number]));
        return { width: seen.width, height: seen.height, pixels: await drawer.image(seen, head) };
      }),
    );
    // The image lies in the buffers of a fade, or, with WebGL2, has cleared the canvas.
    const after = (): void => {
      if (!this.still || this.stage.drawn === "webgl") this.mark();
    };
    this.busy = image.then(after, after);
    return image;
  }
}
