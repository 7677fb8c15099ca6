// Renders views of a scene with WebGPU: splats, runs the head, and composes the image.

import type { Drawer, Times } from "../drawer";
import type { Scene } from "../scene/scene";
import { scalePlan, type View, zoomed } from "../view";
import composeCode from "./compose.wgsl";
import { blocksOf, type Gpu, kernel, largestBuffer, Step, shader, storage, uniform } from "./device";
import { Network, type Plan } from "./network";
import presentCode from "./present.wgsl";
import { Splatter, type Target } from "./splatter";

const SIDE = 8;
/** Longest side of an image in pixels, so that two bytes name a tile. */
const LONGEST = 4096;
/** Seconds by which other work may delay a view. */
const DELAY = 2;
/** Nanoseconds of a pass are rounded by browsers; times are shown in milliseconds. */
const NANOSECONDS = 1e6;

/** The buffers of frames of one size. */
class Frame {
  readonly texture: GPUTexture;
  readonly sizes: GPUBuffer;

  constructor(
    device: GPUDevice,
    /** The image itself. */
    readonly base: Target,
    /** What the head sees: the image itself, or one at the scale that the head was trained at. */
    readonly seen: Target | null,
    readonly head: Plan | null,
  ) {
    this.sizes = uniform(device, 32);
    this.sizes.label = "image";
    this.texture = device.createTexture({
      size: [base.width, base.height],
      format: "rgba8unorm",
      usage: GPUTextureUsage.STORAGE_BINDING | GPUTextureUsage.TEXTURE_BINDING | GPUTextureUsage.COPY_SRC,
    });
  }

  destroy(): void {
    this.texture.destroy();
    this.sizes.destroy();
    this.head?.destroy();
    if (this.seen !== this.base) this.seen?.destroy();
    this.base.destroy();
  }
}

export class Renderer implements Drawer {
  private readonly device: GPUDevice;
  private readonly canvas: GPUCanvasContext;
  private readonly splatter: Splatter;
  private readonly network: Network | null;
  private readonly compose: GPUComputePipeline;
  private readonly present: GPURenderPipeline;
  private readonly sampler: GPUSampler;
  private readonly none: GPUBuffer;
  private readonly results: GPUBuffer;
  private readonly queries: GPUQuerySet | null;
  private frame: Frame | null = null;
  private frameKey = "";
  /** Weight of the whole correction in the last image; 0 if the head did not run. */
  private weight = 0;
  private times: Times = { splat: Number.NaN, head: Number.NaN, withoutHead: false, crowded: 0 };

  constructor(
    gpu: Gpu,
    private readonly scene: Scene,
    canvas: HTMLCanvasElement,
  ) {
    const { device } = gpu;
    this.device = device;
    const format = navigator.gpu.getPreferredCanvasFormat();
    this.canvas = canvas.getContext("webgpu")!;
    this.canvas.configure({ device, format, alphaMode: "opaque" });
    this.splatter = new Splatter(gpu, scene);
    this.network = scene.head && new Network(gpu, scene.head, scene.background);
    this.compose = kernel(device, shader(device, composeCode), "compose");
    const module = shader(device, presentCode);
    this.present = device.createRenderPipeline({
      layout: "auto",
      vertex: { module },
      fragment: { module, targets: [{ format }] },
    });
    this.sampler = device.createSampler({ magFilter: "linear", minFilter: "linear" });
    this.none = storage(device, 16);
    this.queries = gpu.timed ? device.createQuerySet({ type: "timestamp", count: 4 }) : null;
    // The number of pairs of two splats, and four times.
    this.results = device.createBuffer({
      size: 256 + 32,
      usage: GPUBufferUsage.QUERY_RESOLVE | GPUBufferUsage.COPY_SRC | GPUBufferUsage.COPY_DST,
    });
  }

  get hasHead(): boolean {
    return this.network !== null;
  }

  limit(width: number, height: number): number {
    const pixels = largestBuffer(this.device) / 16;
    return Math.min(1, LONGEST / Math.max(width, height), Math.sqrt(pixels / (width * height)));
  }

  render(view: View, head: boolean, share: number): Promise<Times> {
    return this.whole(view, head, true, share);
  }

  async fade(share: number): Promise<void> {
    const { device, frame } = this;
    if (frame === null) return;
    const encoder = device.createCommandEncoder();
    this.encodeImage(encoder, frame, share);
    this.show(encoder, frame);
    device.queue.submit([encoder.finish()]);
    await device.queue.onSubmittedWorkDone();
  }

  /** Draws a view, and again with longer lists of tiles if it needs them. */
  private async whole(view: View, head: boolean, shown: boolean, share = 1): Promise<Times> {
    let wanted = await this.draw(view, head, shown, true, share);
    let grown = false;
    while (!this.crowded(wanted) && this.splatter.grow(Math.max(...wanted))) {
      grown = true;
      wanted = await this.measure(view, head);
    }
    if (grown) await this.draw(view, head, shown, true, share);
    this.times.crowded = this.crowded(wanted);
    return this.times;
  }

  /** Splats a view, and learns how long it takes; returns what `draw` returns. */
  private async measure(view: View, head: boolean): Promise<number[]> {
    let [wanted, seconds]: [number[], number] = [[], 0];
    // Twice, because other work can delay a fast view for a moment.
    for (let i = 0; i < 2 && seconds < DELAY; i++) {
      const started = performance.now();
      wanted = await this.draw(view, head, false, false);
      const spent = (performance.now() - started) / 1000;
      seconds = i === 0 ? spent : Math.min(seconds, spent);
    }
    this.splatter.learn(Math.max(...wanted), seconds);
    return wanted;
  }

  /** Primitives in each tile if they are too many, given the pairs that the image and what the head sees wanted. */
  private crowded(wanted: number[]): number {
    const { base, seen } = this.frame!;
    const found = [base, seen ?? base].map((target, i) =>
      wanted[i]! > this.splatter.most(target) ? wanted[i]! / target.tiles[0] / target.tiles[1] : 0,
    );
    return Math.max(...found);
  }

  async image(view: View, head: boolean): Promise<Uint8ClampedArray<ArrayBuffer>> {
    await this.whole(view, head, false);
    const row = Math.ceil((view.width * 4) / 256) * 256;
    const usage = GPUBufferUsage.COPY_DST | GPUBufferUsage.MAP_READ;
    const copy = this.device.createBuffer({ size: row * view.height, usage });
    const encoder = this.device.createCommandEncoder();
    const size = [view.width, view.height];
    encoder.copyTextureToBuffer({ texture: this.frame!.texture }, { buffer: copy, bytesPerRow: row }, size);
    this.device.queue.submit([encoder.finish()]);
    await copy.mapAsync(GPUMapMode.READ);
    const rows = new Uint8Array(copy.getMappedRange());
    const out = new Uint8ClampedArray(view.width * view.height * 4);
    for (let y = 0; y < view.height; y++) out.set(rows.subarray(y * row, y * row + view.width * 4), y * view.width * 4);
    copy.destroy();
    return out;
  }

  /**
   * Draws one frame; returns how many pairs of tiles and primitives the image and what the head sees wanted.
   *
   * @param complete - whether the head runs; otherwise only its image is splatted
   * @param share - of the correction in the image
   */
  private async draw(view: View, head: boolean, shown: boolean, complete = true, share = 1): Promise<number[]> {
    const { device } = this;
    const plan = scalePlan(view, this.scene.trainedFocal);
    const seen = zoomed(view, plan.zoom);
    const asked = head && this.network !== null && plan.weight > 0;
    const corrected = asked && this.network!.fits(seen.width, seen.height) && this.limit(seen.width, seen.height) === 1;
    this.times = { splat: Number.NaN, head: Number.NaN, withoutHead: asked && !corrected, crowded: 0 };
    const frame = this.frameFor(view, corrected ? seen : null);
    this.weight = corrected ? plan.weight : 0;

    const encoder = device.createCommandEncoder();
    this.splatter.encode(encoder, view, frame.base, this.timed(0));
    this.splatter.copyWanted(encoder, this.results, 256);
    encoder.clearBuffer(this.results, 260, 4);
    if (frame.seen && frame.seen !== frame.base) {
      this.splatter.encode(encoder, seen, frame.seen);
      this.splatter.copyWanted(encoder, this.results, 260);
    }
    if (complete) frame.head?.encode(encoder, this.timed(2));
    this.encodeImage(encoder, frame, share);
    if (shown) this.show(encoder, frame);
    return this.finish(encoder, corrected && complete);
  }

  /** Composes the image of a frame from its colours and a share of its correction. */
  private encodeImage(encoder: GPUCommandEncoder, frame: Frame, share: number): void {
    const { base } = frame;
    const correction = frame.seen ?? base;
    const data = new ArrayBuffer(32);
    new Uint32Array(data).set([base.width, base.height, correction.width, correction.height]);
    new Float32Array(data, 16).set([...this.scene.background, share * this.weight]);
    this.device.queue.writeBuffer(frame.sizes, 0, data);
    const pass = encoder.beginComputePass();
    const bindings = { 0: frame.sizes, 1: base.pixels, 2: frame.head?.correction ?? this.none };
    const composing = new Step(this.device, this.compose, { ...bindings, 3: frame.texture.createView() });
    composing.run(pass, blocksOf(base.width, SIDE), blocksOf(base.height, SIDE));
    pass.end();
  }

  private timed(first: number): GPUComputePassTimestampWrites | undefined {
    if (!this.queries) return undefined;
    return { querySet: this.queries, beginningOfPassWriteIndex: first, endOfPassWriteIndex: first + 1 };
  }

  private frameFor(view: View, seen: View | null): Frame {
    const key = [view.width, view.height, seen?.width, seen?.height].join();
    if (this.frame && key === this.frameKey) return this.frame;
    this.frame?.destroy();
    const same = seen !== null && seen.width === view.width && seen.height === view.height;
    const base = this.splatter.target(view.width, view.height, same);
    const target = seen === null || same ? seen && base : this.splatter.target(seen.width, seen.height, true);
    this.frame = new Frame(this.device, base, target, target && this.network!.plan(target));
    this.frameKey = key;
    return this.frame;
  }

  private show(encoder: GPUCommandEncoder, frame: Frame): void {
    const pass = encoder.beginRenderPass({
      colorAttachments: [{ view: this.canvas.getCurrentTexture().createView(), loadOp: "clear", storeOp: "store" }],
    });
    pass.setPipeline(this.present);
    const entries = [
      { binding: 0, resource: frame.texture.createView() },
      { binding: 1, resource: this.sampler },
    ];
    pass.setBindGroup(0, this.device.createBindGroup({ layout: this.present.getBindGroupLayout(0), entries }));
    pass.draw(3);
    pass.end();
  }

  private async finish(encoder: GPUCommandEncoder, corrected: boolean): Promise<number[]> {
    const usage = GPUBufferUsage.COPY_DST | GPUBufferUsage.MAP_READ;
    const copy = this.device.createBuffer({ size: this.results.size, usage });
    if (this.queries) encoder.resolveQuerySet(this.queries, 0, corrected ? 4 : 2, this.results, 0);
    encoder.copyBufferToBuffer(this.results, 0, copy, 0, this.results.size);
    this.device.queue.submit([encoder.finish()]);
    await copy.mapAsync(GPUMapMode.READ);
    const data = copy.getMappedRange();
    if (this.queries) {
      const stamps = new BigUint64Array(data, 0, 4);
      const between = (first: number) => Number(stamps[first + 1]! - stamps[first]!) / NANOSECONDS;
      this.times = { ...this.times, splat: between(0), head: corrected ? between(2) : 0 };
    }
    const wanted = [...new Uint32Array(data, 256, 2)];
    copy.destroy();
    return wanted;
  }
}
