// The canvas and what draws on it: WebGPU with the head, or base colours by WebGL2 once WebGPU is missing or lost.

import type { Drawer } from "../drawer";
import { openGpu } from "../gpu/device";
import { Renderer } from "../gpu/renderer";
import { PackError } from "../scene/container";
import type { Scene } from "../scene/scene";
import { openPainter } from "../webgl/painter";

/** WebGL2 contexts opened in a row: a GPU process that ends takes its context along, and its successor gives another. */
const CONTEXTS = 3;

export class Stage {
  /** What draws: webgpu, webgl or image. */
  drawn: "webgpu" | "webgl" | "image" = "image";
  /** Why base colours are shown; empty where nothing is missing. */
  notice = "";
  private drawer: Drawer | null = null;
  private device: GPUDevice | null = null;
  /** Why the current drawer cannot draw any more; null while it can. */
  private lost: string | null = null;
  private contexts = 0;
  /** Gaussians over each pixel of the last view if they are too many; 0 for any other view. */
  crowded = 0;

  /**
   * @param place - takes the canvas, and keeps mouse and touch when the canvas is replaced
   * @param onChange - called when the canvas has to be drawn again, by the next drawer
   */
  constructor(
    private readonly scene: Scene,
    private readonly place: HTMLElement,
    private readonly onChange: () => void,
  ) {}

  /** Opens the first drawer; throws a PackError where there is neither WebGPU nor WebGL2. */
  async open(): Promise<void> {
    // An adapter may be refused as well as missing.
    const gpu = await openGpu().catch(() => null);
    if (gpu === null) {
      this.openPainter("This browser has no WebGPU");
      return;
    }
    const { device } = gpu;
    this.device = device;
    this.drawn = "webgpu";
    const lose = (reason: string): void => {
      if (this.device !== device) return;
      this.lost ??= `The browser lost the GPU (${reason})`;
      this.onChange();
    };
    device.lost.then(({ message }) => lose(message.trim() || "no reason given"));
    device.addEventListener("uncapturederror", ({ error }) => lose(error.message.split("\n")[0]!));
    try {
      this.drawer = new Renderer(gpu, this.scene, this.canvas);
    } catch (error) {
      this.lost ??= `WebGPU failed (${error})`;
    }
  }

  get canvas(): HTMLCanvasElement {
    return this.place.querySelector("canvas")!;
  }

  /** Base colours by WebGL2, on a new canvas: a canvas has one kind of context for its life. */
  private openPainter(reason: string): void {
    const { device } = this;
    this.drawer = this.device = this.lost = null;
    this.drawn = "image";
    device?.destroy();
    const canvas = this.canvas.cloneNode() as HTMLCanvasElement;
    this.canvas.replaceWith(canvas);
    this.contexts += 1;
    const painter = this.contexts > CONTEXTS ? null : openPainter(this.scene, canvas);
    if (painter === null) throw new PackError(`${reason}, and WebGL2 is missing too, so the page shows one image.`);
    canvas.addEventListener("webglcontextlost", () => {
      if (this.drawer !== painter) return;
      this.lost ??= reason;
      this.onChange();
    });
    this.drawer = painter;
    this.drawn = "webgl";
    this.onChange();
    // Without a head nothing is missing.
    this.notice = this.scene.head ? `${reason}: base colours; the compensation head is not shown.` : "";
  }

  /** How many of the Gaussians of the file are drawn; empty for all. */
  get left(): string {
    const { total, field } = this.scene;
    const [shown, all] = [field.count, total].map((n) => n.toLocaleString("en"));
    return field.count < total ? `${shown} of ${all} Gaussians, for a phone` : "";
  }

  get hasHead(): boolean {
    return this.drawer?.hasHead ?? false;
  }

  /** Does work with the drawer, again with the next one if it is lost; throws a PackError when none is left. */
  async use<T>(work: (drawer: Drawer) => Promise<T>): Promise<T> {
    for (;;) {
      if (this.lost !== null) this.openPainter(this.lost);
      const drawer = this.drawer!;
      try {
        const result = await work(drawer);
        if (this.lost !== null) continue;
        // What has drawn once draws again: only contexts that are lost before their first image are counted.
        this.contexts = 0;
        return result;
      } catch (error) {
        if (error instanceof PackError) throw error;
        this.lost ??= this.drawn === "webgpu" ? `WebGPU failed (${error})` : "WebGL2 failed";
      }
    }
  }
}
