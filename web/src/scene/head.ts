// The compensation head of a scene: its kind, and its tensors; see sundae_ns/head.

import { checkRatio } from "./container";
import { levels, predecessors } from "./entropy";
import type { Reader } from "./reader";

const WIDTHS: Record<string, [number, number]> = {
  tiny: [8, 64],
  compact: [32, 64],
  wide: [64, 64],
  regular: [64, 512],
};
const LEVELS = 4;

/** What the header states of a head. */
export type StatedHead = { mode: string; size: string; pixel_unshuffle: number; num_features: number };

export type HeadKind = {
  /** Whether the head corrects the base colours; otherwise it makes the image from features alone. */
  residual: boolean;
  fold: number;
  features: number;
  /** Channels of each level, the finest first. */
  widths: number[];
};

export type Tensor = { shape: number[]; values: Float32Array<ArrayBuffer> };
export type Head = { kind: HeadKind; tensors: Map<string, Tensor> };

/** One convolution of the network: the prefix of its tensors, and its channels. */
export type Layer = { name: string; inputs: number; outputs: number; side: number };

/** Channels of the image that the network sees. */
export const inputChannels = (kind: HeadKind): number => kind.features + (kind.residual ? 4 : 0);

/** All convolutions: the encoder's from fine to coarse, the decoder's from coarse to fine, and the last one. */
export function layersOf(kind: HeadKind): { encoder: Layer[][]; decoder: Layer[][]; out: Layer } {
  const { fold, widths } = kind;
  const pair = (name: string, inputs: number, outputs: number): Layer[] => [
    { name: `${name}.0`, inputs, outputs, side: 3 },
    { name: `${name}.2`, inputs: outputs, outputs, side: 3 },
  ];
  const encoder = widths.map((width, level) =>
    pair(`net.encoder.${level}`, level === 0 ? inputChannels(kind) * fold ** 2 : widths[level - 1]!, width),
  );
  const decoder = widths
    .slice(0, -1)
    .reverse()
    .map((width, i) => pair(`net.decoder.${i}`, widths[LEVELS - 1 - i]! + width, width));
  return { encoder, decoder, out: { name: "net.out", inputs: widths[0]!, outputs: 3 * fold ** 2, side: 1 } };
}

function kindOf({ mode, size, pixel_unshuffle, num_features }: StatedHead): HeadKind {
  const [width, most] = WIDTHS[size]!;
  return {
    residual: mode === "residual",
    fold: pixel_unshuffle,
    features: num_features,
    widths: Array.from({ length: LEVELS }, (_, level) => Math.min(width * 2 ** level, most)),
  };
}

/** The head, or null for a scene without one. */
export function readHead(reader: Reader, stated: StatedHead | null): Head | null {
  const weighted = reader.has("head/levels");
  if (stated === null) {
    if (weighted) throw reader.refuse("its header states no head, but it has one");
    return null;
  }
  const kind = kindOf(stated);
  const tensors = weighted ? readTensors(reader) : new Map<string, Tensor>();
  const { encoder, decoder, out } = layersOf(kind);
  const layers = [...encoder.flat(), ...decoder.flat(), out];
  for (const { name, inputs, outputs, side } of layers) {
    const wanted: [string, number[]][] = [
      ["weight", [outputs, inputs, side, side]],
      ["bias", [outputs]],
    ];
    for (const [part, shape] of wanted) {
      const found = tensors.get(`${name}.${part}`);
      if (found === undefined || found.shape.join() !== shape.join()) {
        throw reader.refuse("its header states another head than it has");
      }
    }
  }
  if (tensors.size !== 2 * layers.length) throw reader.refuse("its header states another head than it has");
  return { kind, tensors };
}

function readTensors(reader: Reader): Map<string, Tensor> {
  const { tensors: shapes, weights: stated } = reader.about("head");
  const [plain, steps, columns] = ["plain", "steps", "columns"].map((part) => reader.array("head", part)) as [
    Float32Array,
    Float32Array,
    Float32Array,
  ];
  const sizeOf = (shape: number[]): number => shape.reduce((product, side) => product * side, 1);
  const weights = shapes.reduce((sum, [, shape]) => sum + (shape.length > 1 ? sizeOf(shape) : 0), 0);
  if (stated !== weights) throw reader.refuse("the head has another number of weights than it states");
  checkRatio(4 * weights, reader.size);
  const found = levels(reader.array("head", "levels") as Uint8Array, 1, predecessors(weights));
  const taken = { plain: 0, levels: 0, steps: 0, columns: 0 };
  const take = <T extends Float32Array | Int32Array>(name: keyof typeof taken, source: T, count: number): T => {
    const start = taken[name];
    taken[name] += count;
    if (taken[name] > source.length) throw reader.refuse("the head has fewer weights than it states");
    return source.subarray(start, taken[name]) as T;
  };
  const tensors = new Map<string, Tensor>();
  for (const [name, shape] of shapes) {
    const count = sizeOf(shape);
    const single = shape.length <= 1;
    const values = Float32Array.from(single ? take("plain", plain, count) : take("levels", found, count));
    if (!single) {
      const [outputs, inputs] = [shape[0]!, shape[1]!];
      const [rows, factors] = [take("steps", steps, outputs), take("columns", columns, inputs)];
      const kernel = count / outputs / inputs;
      for (let i = 0; i < count; i++) {
        const pair = Math.floor(i / kernel);
        values[i]! *= Math.fround(rows[Math.floor(pair / inputs)]! * factors[pair % inputs]!);
      }
      if (!values.every(Number.isFinite)) throw reader.refuse("the head has weights beyond float32");
    }
    tensors.set(name, { shape, values });
  }
  return tensors;
}
