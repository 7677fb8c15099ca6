// The compensation head: from a splatted image to the correction of its colours.

import { type Head, inputChannels, type Layer, layersOf } from "../scene/head";
import {
  blocksOf,
  constants,
  filled,
  type Gpu,
  groupsOf,
  kernel,
  largestBuffer,
  Step,
  shader,
  storage,
  uniform,
} from "./device";
import foldCode from "./fold.wgsl";
import networkCode from "./network.wgsl";
import type { Target } from "./splatter";

const LEVELS = 4;
/** Pixels of a row that one thread of a convolution computes, and threads along each side of a workgroup. */
const RUN = 4;
const SIDE = 8;
const LARGEST_HALF = "65504.0";
const LARGEST_SINGLE = "3.4e38";

/** Rounds to half precision; returns the bits. */
function toHalf(value: number): number {
  const sign = value < 0 || Object.is(value, -0) ? 0x8000 : 0;
  const size = Math.min(Math.abs(value), 65504);
  const exponent = Math.max(Math.floor(Math.log2(size || 1)), -14);
  const steps = Math.round(size / 2 ** (exponent - 10));
  // The implicit bit of a normal number carries into the exponent, and so does rounding up to the next power of two.
  return sign | (size < 2 ** -14 ? steps : ((exponent + 14) << 10) + steps);
}

/** Weights of one layer on the GPU. */
type Loaded = { layer: Layer; weights: GPUBuffer; bias: GPUBuffer };

/** Something to run for one frame. */
type Action = (pass: GPUComputePassEncoder) => void;

/** An image in a buffer: it begins after `offset` groups of four channels of pixels. */
type Region = { buffer: GPUBuffer; offset: number };

export class Network {
  private readonly device: GPUDevice;
  private readonly encoder: Loaded[][];
  private readonly decoder: Loaded[][];
  private readonly out: Loaded;
  private readonly kernels: Record<
    "fold" | "unfold" | "pool" | "upsample" | "convolve" | "project",
    GPUComputePipeline
  >;
  private readonly bytes: number;

  constructor(
    gpu: Gpu,
    private readonly head: Head,
    private readonly background: [number, number, number],
  ) {
    this.device = gpu.device;
    this.bytes = gpu.half ? 2 : 4;
    const { fold, residual } = head.kind;
    const precision = gpu.half ? "enable f16;\nalias number = f16;\n" : "alias number = f32;\n";
    const network = shader(
      gpu.device,
      precision,
      constants({ LARGEST: gpu.half ? LARGEST_HALF : LARGEST_SINGLE }),
      networkCode,
    );
    const folded = constants({
      CHANNELS: `${inputChannels(head.kind)}u`,
      // The head that makes the image from features alone does not see colours and accumulation.
      FIRST_CHANNEL: residual ? "0u" : "4u",
      FOLD: `${fold}u`,
      RESIDUAL: residual,
    });
    const folding = shader(gpu.device, precision, folded, foldCode);
    this.kernels = {
      fold: kernel(gpu.device, folding, "fold"),
      unfold: kernel(gpu.device, folding, "unfold"),
      pool: kernel(gpu.device, network, "pool"),
      upsample: kernel(gpu.device, network, "upsample"),
      convolve: kernel(gpu.device, network, "convolve"),
      project: kernel(gpu.device, network, "project"),
    };
    const load = (layer: Layer) => this.load(layer);
    const { encoder, decoder, out } = layersOf(head.kind);
    this.encoder = encoder.map((pair) => pair.map(load));
    this.decoder = decoder.map((pair) => pair.map(load));
    this.out = load(out);
  }

  private load(layer: Layer): Loaded {
    const { name, inputs, outputs, side } = layer;
    const weight = this.head.tensors.get(`${name}.weight`)!.values;
    const [groupsIn, groupsOut, taps] = [groupsOf(inputs), groupsOf(outputs), side * side];
    const blocks = new Float32Array(groupsOut * groupsIn * taps * 16);
    for (let o = 0; o < outputs; o++) {
      for (let i = 0; i < inputs; i++) {
        for (let tap = 0; tap < taps; tap++) {
          const matrix = ((o >> 2) * groupsIn + (i >> 2)) * taps + tap;
          blocks[matrix * 16 + (i & 3) * 4 + (o & 3)] = weight[(o * inputs + i) * taps + tap]!;
        }
      }
    }
    const bias = new Float32Array(groupsOut * 4);
    bias.set(this.head.tensors.get(`${name}.bias`)!.values);
    return {
      layer,
      weights: filled(this.device, this.bytes === 2 ? Uint16Array.from(blocks, toHalf) : blocks),
      bias: filled(this.device, bias),
    };
  }

  /** Width and height of the folded image of an image, padded to the stride of the network. */
  private folded(width: number, height: number): [number, number] {
    const stride = this.head.kind.fold * 2 ** (LEVELS - 1);
    const side = (length: number) => blocksOf(length, stride) * 2 ** (LEVELS - 1);
    return [side(width), side(height)];
  }

  /** Whether the device has buffers for an image of this size. */
  fits(width: number, height: number): boolean {
    const [across, down] = this.folded(width, height);
    const { widths, fold } = this.head.kind;
    const channels = Math.max(widths[0]! + widths[1]!, inputChannels(this.head.kind) * fold ** 2);
    const splatted = (1 + groupsOf(this.head.kind.features)) * 16 * width * height;
    const most = largestBuffer(this.device);
    return across * down * groupsOf(channels) * 4 * this.bytes <= most && splatted <= most;
  }

  /** Everything to run for images in a target. */
  plan(target: Target): Plan {
    return new Plan(this.device, target, (plan) => this.build(plan, target));
  }

  private build(plan: Plan, target: Target): Action[] {
    const { device, kernels } = this;
    const { widths, fold } = this.head.kind;
    const [width, height] = this.folded(target.width, target.height);
    const size = (level: number): [number, number] => [width >> level, height >> level];
    const image = (channels: number, level: number): GPUBuffer => {
      const [across, down] = size(level);
      return plan.keep(storage(device, groupsOf(channels) * across * down * 4 * this.bytes));
    };
    const actions: Action[] = [];

    const layer = (level: number, from: Region, to: Region, fromLevel = level, inputs = 0): GPUBuffer => {
      const pixels = (at: number) => size(at)[0] * size(at)[1];
      const buffer = plan.keep(uniform(device, 32));
      const values = [...size(level), from.offset * pixels(fromLevel), to.offset * pixels(level), groupsOf(inputs)];
      device.queue.writeBuffer(buffer, 0, new Uint32Array(values));
      return buffer;
    };
    const convolve = (
      { layer: { inputs, outputs, side }, weights, bias }: Loaded,
      level: number,
      from: Region,
      to: Region,
    ): void => {
      const sizes = layer(level, from, to, level, inputs);
      const bindings = { 0: sizes, 1: from.buffer, 2: to.buffer, 3: weights, 4: bias };
      const step = new Step(device, side === 3 ? kernels.convolve : kernels.project, bindings);
      const [across, down] = size(level);
      const groups = groupsOf(outputs);
      // A convolution of three pixels computes four pixels of two groups of channels in each thread.
      const [run, depth] = side === 3 ? [RUN, groups / 2] : [1, groups];
      actions.push((pass) => step.run(pass, blocksOf(across, SIDE * run), blocksOf(down, SIDE), depth));
    };
    const resample = (kind: "pool" | "upsample", channels: number, level: number, from: Region, to: Region): void => {
      const sizes = layer(level, from, to, kind === "pool" ? level - 1 : level + 1);
      const step = new Step(device, kernels[kind], { 0: sizes, 1: from.buffer, 2: to.buffer });
      const [across, down] = size(level);
      actions.push((pass) => step.run(pass, blocksOf(across, SIDE), blocksOf(down, SIDE), groupsOf(channels)));
    };

    const sizes = plan.keep(uniform(device, 32));
    const data = new ArrayBuffer(32);
    new Uint32Array(data).set([target.width, target.height, width, height]);
    new Float32Array(data, 16).set(this.background);
    device.queue.writeBuffer(sizes, 0, data);
    const inputs = inputChannels(this.head.kind) * fold ** 2;
    let seen: Region = { buffer: image(inputs, 0), offset: 0 };
    const folding = new Step(device, kernels.fold, { 0: sizes, 1: target.pixels, 2: seen.buffer });
    actions.push((pass) => folding.run(pass, blocksOf(width, SIDE), blocksOf(height, SIDE), groupsOf(inputs)));

    // Each finer level keeps its image behind the space for the coarser one, so that no copy joins them.
    const joined = widths.map((channels, level) => image(channels + (widths[level + 1] ?? 0), level));
    const between = widths.map((channels, level) => image(channels, level));
    const skip = (level: number): Region => ({ buffer: joined[level]!, offset: groupsOf(widths[level + 1] ?? 0) });
    const front = (level: number): Region => ({ buffer: joined[level]!, offset: 0 });
    const middle = (level: number): Region => ({ buffer: between[level]!, offset: 0 });
    widths.forEach((_, level) => {
      if (level > 0) {
        const pooled = { buffer: image(widths[level - 1]!, level), offset: 0 };
        resample("pool", widths[level - 1]!, level, seen, pooled);
        seen = pooled;
      }
      convolve(this.encoder[level]![0]!, level, seen, middle(level));
      seen = skip(level);
      convolve(this.encoder[level]![1]!, level, middle(level), seen);
    });
    this.decoder.forEach((pair, i) => {
      const level = LEVELS - 2 - i;
      resample("upsample", widths[level + 1]!, level, front(level + 1), front(level));
      convolve(pair[0]!, level, front(level), middle(level));
      convolve(pair[1]!, level, middle(level), front(level));
    });
    const last = { buffer: image(this.out.layer.outputs, 0), offset: 0 };
    convolve(this.out, 0, front(0), last);
    const unfold = { 0: sizes, 1: target.pixels, 3: last.buffer, 4: plan.correction };
    const unfolding = new Step(device, kernels.unfold, unfold);
    actions.push((pass) => unfolding.run(pass, blocksOf(target.width, SIDE), blocksOf(target.height, SIDE)));
    return actions;
  }
}

/** The head for images of one size, with its buffers. */
export class Plan {
  /** The correction of the colours of each pixel [H, W], the fourth component unused. */
  readonly correction: GPUBuffer;
  private readonly buffers: GPUBuffer[] = [];
  private readonly actions: Action[];

  constructor(device: GPUDevice, target: Target, build: (plan: Plan) => Action[]) {
    this.correction = this.keep(storage(device, target.width * target.height * 16));
    this.actions = build(this);
  }

  keep(buffer: GPUBuffer): GPUBuffer {
    this.buffers.push(buffer);
    return buffer;
  }

  encode(encoder: GPUCommandEncoder, timestampWrites?: GPUComputePassTimestampWrites): void {
    const pass = encoder.beginComputePass(timestampWrites ? { timestampWrites } : {});
    for (const action of this.actions) action(pass);
    pass.end();
  }

  destroy(): void {
    for (const buffer of this.buffers) buffer.destroy();
  }
}
