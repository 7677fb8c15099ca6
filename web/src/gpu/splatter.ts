// From the primitives to an image of colours, accumulation and features.

import { coefficientsOf, featuresOf, geometryOf } from "../arrays";
import { mostPairs } from "../limits";
import type { Scene } from "../scene/scene";
import type { View } from "../view";
import blendCode from "./blend.wgsl";
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
import projectCode from "./project.wgsl";
import scanCode from "./scan.wgsl";
import sortCode from "./sort.wgsl";
import tilesCode from "./tiles.wgsl";
import viewCode from "./view.wgsl";

export const TILE = 16;
const THREADS = 256;
const SORT_BLOCK = 2048;
const DIGIT_BITS = 8;
/** Pairs of a tile and a primitive that the buffers first hold, for each primitive. */
const PAIRS = 4;
/** Factor by which lists grow at once; in between, the view is timed. */
const GROWTH = 4;
/** Seconds that a view may be expected to take: a software adapter needs minutes where a GPU needs one second. */
const MOST_SECONDS = 60;
const SPLAT_BYTES = 32;
/** Most workgroups along one axis that the scan of blocks uses. */
const ROW = 32768;

/** Covers many workgroups by two axes, because one has at most 65,535. */
const grid = (groups: number): [number, number] => [Math.min(groups, ROW), Math.ceil(groups / ROW)];

/** The buffers of one image: its view, its lists of tiles and its pixels. */
class Target {
  readonly view: GPUBuffer;
  readonly ranges: GPUBuffer;
  readonly pixels: GPUBuffer;
  readonly tiles: [number, number];

  constructor(
    device: GPUDevice,
    readonly width: number,
    readonly height: number,
    readonly groups: number,
  ) {
    this.tiles = [blocksOf(width, TILE), blocksOf(height, TILE)];
    this.view = uniform(device, 112);
    this.ranges = storage(device, this.tiles[0] * this.tiles[1] * 8);
    this.pixels = storage(device, width * height * groups * 16);
  }

  destroy(): void {
    for (const buffer of [this.view, this.ranges, this.pixels]) buffer.destroy();
  }
}

/** The kernels of a sort, and the uniform buffers of its digits. */
class SortKernels {
  readonly count: GPUComputePipeline;
  readonly scan: GPUComputePipeline;
  readonly scatter: GPUComputePipeline;
  readonly shifts: GPUBuffer[];

  constructor(device: GPUDevice) {
    const module = shader(device, scanCode, sortCode);
    this.count = kernel(device, module, "count");
    this.scan = kernel(device, module, "scan");
    this.scatter = kernel(device, module, "scatter");
    this.shifts = [0, 1, 2, 3].map((digit) => {
      const buffer = uniform(device, 16);
      device.queue.writeBuffer(buffer, 0, new Uint32Array([digit * DIGIT_BITS]));
      return buffer;
    });
  }
}

/** A stable radix sort of keys with values; the number of them lies in a buffer. */
class Sorter {
  private readonly steps: { count: Step; scan: Step; scatter: Step }[];
  private readonly counts: GPUBuffer;

  /**
   * @param length - the number of keys
   * @param keys - the keys, and space of the same size; the result of an even number of digits lies in the first
   * @param values - the values, and space of the same size
   * @param most - the highest number of keys
   * @param digits - digits of the keys that differ, eight bits each
   */
  constructor(
    device: GPUDevice,
    kernels: SortKernels,
    length: GPUBuffer,
    keys: [GPUBuffer, GPUBuffer],
    values: [GPUBuffer, GPUBuffer],
    most: number,
    digits: number,
  ) {
    const counts = storage(device, (blocksOf(most, SORT_BLOCK) + 1) * 256 * 4);
    this.counts = counts;
    this.steps = Array.from({ length: digits }, (_, digit) => {
      const [from, to] = [digit % 2, 1 - (digit % 2)] as const;
      const counted = { 0: length, 1: keys[from]!, 3: counts, 6: kernels.shifts[digit]! };
      const moved = { ...counted, 2: values[from]!, 4: keys[to]!, 5: values[to]! };
      return {
        count: new Step(device, kernels.count, counted),
        scan: new Step(device, kernels.scan, { 0: length, 3: counts }),
        scatter: new Step(device, kernels.scatter, moved),
      };
    });
  }

  /** Sorts with as many workgroups as `sizes` says at its start. */
  encode(pass: GPUComputePassEncoder, sizes: GPUBuffer): void {
    for (const { count, scan, scatter } of this.steps) {
      count.runAs(pass, sizes, 0);
      scan.run(pass, 4);
      scatter.runAs(pass, sizes, 0);
    }
  }

  destroy(): void {
    this.counts.destroy();
  }
}

/** The lists of tiles, whose buffers grow with the views. */
class Pairs {
  readonly count: GPUBuffer;
  readonly tiles: [GPUBuffer, GPUBuffer];
  readonly ids: [GPUBuffer, GPUBuffer];
  readonly sizes: GPUBuffer;
  readonly sorter: Sorter;

  constructor(
    device: GPUDevice,
    kernels: SortKernels,
    readonly capacity: number,
  ) {
    this.count = storage(device, 8);
    this.tiles = [storage(device, capacity * 4), storage(device, capacity * 4)];
    this.ids = [storage(device, capacity * 4), storage(device, capacity * 4)];
    this.sizes = storage(device, 24, GPUBufferUsage.INDIRECT);
    // Two digits name 65,536 tiles: images of up to 4,096 pixels a side.
    this.sorter = new Sorter(device, kernels, this.count, this.tiles, this.ids, capacity, 2);
  }

  destroy(): void {
    this.sorter.destroy();
    for (const buffer of [this.count, ...this.tiles, ...this.ids, this.sizes]) buffer.destroy();
  }
}

export class Splatter {
  private readonly device: GPUDevice;
  private readonly splats: GPUBuffer;
  private readonly colors: GPUBuffer;
  private readonly primitives: GPUBuffer;
  private readonly coefficients: GPUBuffer;
  private readonly features: GPUBuffer;
  private readonly depths: [GPUBuffer, GPUBuffer];
  private readonly ids: [GPUBuffer, GPUBuffer];
  private readonly blockSums: GPUBuffer;
  private readonly starts: GPUBuffer;
  private readonly depthSizes: GPUBuffer;
  private readonly sorting: SortKernels;
  private readonly depthSorter: Sorter;
  private readonly groups: number;
  private readonly kernels: Record<"project" | "measure" | "place" | "emit" | "findRanges", GPUComputePipeline>;
  private readonly blends = new Map<number, GPUComputePipeline>();
  private pairs: Pairs;
  /** Pairs for which the GPU takes the time that a view may take. */
  private mostInTime = Number.MAX_SAFE_INTEGER;

  constructor(
    gpu: Gpu,
    private readonly scene: Scene,
  ) {
    const { device } = gpu;
    const { count } = scene.field;
    this.device = device;
    this.groups = groupsOf(scene.features);
    this.primitives = filled(device, geometryOf(scene));
    this.coefficients = filled(device, coefficientsOf(scene));
    this.features = filled(device, featuresOf(scene));
    this.splats = storage(device, count * SPLAT_BYTES);
    this.colors = storage(device, count * 16);
    this.depths = [storage(device, count * 4), storage(device, count * 4)];
    this.ids = [storage(device, count * 4), storage(device, count * 4)];
    this.blockSums = storage(device, blocksOf(count, THREADS) * 4);
    this.starts = storage(device, count * 4);
    this.depthSizes = filled(device, new Uint32Array([blocksOf(count, SORT_BLOCK), 1, 1]), GPUBufferUsage.INDIRECT);
    const length = filled(device, new Uint32Array([count]));
    this.sorting = new SortKernels(device);
    this.depthSorter = new Sorter(device, this.sorting, length, this.depths, this.ids, count, 4);
    const colored = { DEGREE: scene.degree, LOGITS: scene.logits };
    const tiles = shader(device, scanCode, viewCode, tilesCode);
    this.kernels = {
      project: kernel(device, shader(device, constants(colored), viewCode, projectCode), "project"),
      measure: kernel(device, tiles, "measure"),
      place: kernel(device, tiles, "place"),
      emit: kernel(device, tiles, "emit"),
      findRanges: kernel(device, tiles, "find_ranges"),
    };
    this.pairs = new Pairs(device, this.sorting, this.fitting(PAIRS * count + 2 ** 16));
  }

  private fitting(pairs: number): number {
    return Math.min(pairs, Math.floor(largestBuffer(this.device) / 4));
  }

  /** Buffers for images of one size, with features or without. */
  target(width: number, height: number, features: boolean): Target {
    return new Target(this.device, width, height, 1 + (features ? this.groups : 0));
  }

  private blend(groups: number): GPUComputePipeline {
    let found = this.blends.get(groups);
    if (!found) {
      const module = shader(this.device, constants({ FEATURE_GROUPS: `${groups}u` }), viewCode, blendCode);
      found = kernel(this.device, module, "blend");
      this.blends.set(groups, found);
    }
    return found;
  }

  /** Splats a view into a target of its size. */
  encode(
    encoder: GPUCommandEncoder,
    view: View,
    target: Target,
    timestampWrites?: GPUComputePassTimestampWrites,
  ): void {
    const { device, pairs, scene } = this;
    const { count } = scene.field;
    const data = new ArrayBuffer(112);
    new Float32Array(data).set([...view.worldToCamera, ...view.center, 0, view.fx, view.fy, view.cx, view.cy]);
    const sizes = [view.width, view.height, ...target.tiles, count, Number(scene.antialiased)];
    const whole = [...sizes, pairs.capacity, this.most(target)];
    new Uint32Array(data, 80).set(whole);
    device.queue.writeBuffer(target.view, 0, data);
    encoder.clearBuffer(target.ranges);
    const pass = encoder.beginComputePass(timestampWrites ? { timestampWrites } : {});
    const { kernels, splats, colors, blockSums, starts } = this;
    const [depths, ids] = [this.depths[0], this.ids[0]];
    const geometry = { 0: target.view, 1: this.primitives, 2: this.coefficients, 3: splats, 4: colors };
    new Step(device, kernels.project, { ...geometry, 5: depths, 6: ids }).run(pass, ...grid(blocksOf(count, THREADS)));
    this.depthSorter.encode(pass, this.depthSizes);
    const ranked = { 0: target.view, 1: splats, 2: ids, 3: blockSums, 8: starts };
    new Step(device, kernels.measure, ranked).run(pass, ...grid(blocksOf(count, THREADS)));
    new Step(device, kernels.place, { 0: target.view, 3: blockSums, 4: pairs.count, 5: pairs.sizes }).run(pass, 1);
    const listed = { ...ranked, 4: pairs.count, 6: pairs.tiles[0], 7: pairs.ids[0] };
    new Step(device, kernels.emit, listed).runAs(pass, pairs.sizes, 0);
    pairs.sorter.encode(pass, pairs.sizes);
    const ranges = new Step(device, kernels.findRanges, { 4: pairs.count, 6: pairs.tiles[0] }, { 0: target.ranges });
    ranges.runAs(pass, pairs.sizes, 12);
    const lists = { 4: pairs.ids[0], 5: target.ranges, 6: target.pixels };
    const blended = { 0: target.view, 1: splats, 2: colors, 3: this.features, ...lists };
    new Step(device, this.blend(target.groups - 1), blended).run(pass, ...target.tiles);
    pass.end();
  }

  /** Most pairs of a view that is drawn into a target. */
  most({ tiles }: Target): number {
    return this.fitting(Math.min(mostPairs(tiles[0] * tiles[1], this.scene.field.count), this.mostInTime));
  }

  /** Learns that a view took `seconds`, of `wanted` pairs or as many as the buffers hold. */
  learn(wanted: number, seconds: number): void {
    this.mostInTime = Math.floor((MOST_SECONDS / seconds) * Math.min(wanted, this.pairs.capacity));
  }

  /** Copies the number of pairs that the last view wanted into a buffer. */
  copyWanted(encoder: GPUCommandEncoder, into: GPUBuffer, offset: number): void {
    encoder.copyBufferToBuffer(this.pairs.count, 4, into, offset, 4);
  }

  /** Makes space for so many pairs, or for some of them; returns whether the last image lacked some and got space. */
  grow(wanted: number): boolean {
    const capacity = this.fitting(Math.min(Math.ceil(wanted * 1.25), GROWTH * this.pairs.capacity));
    if (wanted <= this.pairs.capacity || capacity <= this.pairs.capacity) return false;
    this.pairs.destroy();
    this.pairs = new Pairs(this.device, this.sorting, capacity);
    return true;
  }
}

export type { Target };
