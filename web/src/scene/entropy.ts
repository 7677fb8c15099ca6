// Whole numbers from streams of the entropy coder; the twin of sundae_ns/io/pack/entropy.py, which explains it.
// Both compute with the same integers, so they decode the same numbers.

import { damaged } from "./container";

const CONTEXTS = 4;
const NEIGHBOURS = 4;
const WINDOW = 128;
const NODES = 128;
const SIDE = 64;
const LAST = 24;
const CLASSES = 16;
const EVEN = 1 << 15;
const WEIGHT_LIMIT = 1 << 19;

const clamp = (value: number, low: number, high: number): number => Math.min(Math.max(value, low), high);

/** Probabilities of 12 bits for -2047 to 2047 in 256ths of their logits. */
const SQUASH = Int32Array.from({ length: 4095 }, (_, i) =>
  clamp(Math.round(4096 / (1 + Math.exp((2047 - i) / 256))), 1, 4095),
);
/** The first logit of each probability of 12 bits. */
const STRETCH = Int32Array.from({ length: 4096 }, (_, chance) => {
  const first = SQUASH.findIndex((value) => value >= chance);
  return (first < 0 ? 4094 : first) - 2047;
});
const RATES = Int32Array.from({ length: 256 }, (_, count) => Math.floor((65536 * 5) / (5 * count + 8)));

/** The state of a decoder: an interval of 32 bits, a place in it, and chances that adapt. */
class Decoder {
  private low = 0;
  private high = 0xffffffff;
  private code = 0;
  private next = 0;
  private readonly model: Uint16Array;
  private readonly counts: Uint8Array;
  private readonly weights: Int32Array;
  private readonly scores = new Int32Array(CONTEXTS);
  /** First node of each context of the number that is decoded. */
  readonly places = new Int32Array(CONTEXTS);

  constructor(
    private readonly stream: Uint8Array,
    contexts: number,
    rows: number,
  ) {
    this.model = new Uint16Array(contexts * NODES).fill(EVEN);
    this.counts = new Uint8Array(contexts * NODES);
    this.weights = new Int32Array(rows * NODES * CONTEXTS).fill(0x5000);
    for (let i = 0; i < 4; i++) this.code = ((this.code << 8) | this.byte()) >>> 0;
  }

  private byte(): number {
    return this.stream[this.next++] ?? 0;
  }

  /** A bit that is 1 with `chance` of 65536. */
  private coded(chance: number): number {
    const reach = this.high - this.low;
    const middle = this.low + (reach >>> 16) * chance + (((reach & 0xffff) * chance) >>> 16);
    const bit = this.code <= middle ? 1 : 0;
    if (bit) this.high = middle;
    else this.low = middle + 1;
    while ((this.low ^ this.high) >>> 24 === 0) {
      this.code = ((this.code << 8) | this.byte()) >>> 0;
      this.low = (this.low << 8) >>> 0;
      this.high = ((this.high << 8) | 255) >>> 0;
    }
    return bit;
  }

  /** The decision `node`, by the mix of its chances in all contexts. */
  decided(row: number, node: number): number {
    const { model, counts, weights, scores, places } = this;
    const first = row * CONTEXTS;
    let total = 0;
    for (let c = 0; c < CONTEXTS; c++) {
      scores[c] = STRETCH[model[places[c]! + node]! >> 4]!;
      total += scores[c]! * weights[first + c]!;
    }
    const chance = SQUASH[clamp(Math.floor(total / 65536), -2047, 2047) + 2047]!;
    const bit = this.coded(chance << 4);
    const error = ((bit << 12) - chance) * 10;
    for (let c = 0; c < CONTEXTS; c++) {
      const weight = weights[first + c]! + ((scores[c]! * error + 0x8000) >> 16);
      weights[first + c] = clamp(weight, -WEIGHT_LIMIT, WEIGHT_LIMIT);
      const place = places[c]! + node;
      const count = counts[place]!;
      const old = model[place]!;
      model[place] = clamp(old + ((((bit * 65535 - old) >> 3) * RATES[count]!) >> 13), 16, 65519);
      if (count < 127) counts[place] = count + 1;
    }
    return bit;
  }

  /** Refuses a stream of more or fewer numbers: four bytes are read where the encoder wrote the last one. */
  end(): void {
    if (this.next - 3 !== this.stream.length) throw damaged("a stream does not end with its last number");
  }

  even(): number {
    return this.coded(EVEN);
  }

  /** A number: is it 0, its sign, how many binary digits it has, and these. */
  number(first: number): number {
    if (this.decided(first, 0)) return 0;
    const negative = this.decided(first + 1, 1);
    const side = SIDE * negative;
    let digits = 0;
    while (digits < LAST - 1) {
      const node = side + Math.min(2 + digits, 17);
      if (!this.decided(first + node, node)) break;
      digits++;
    }
    let found = 1;
    for (let k = 0; k < digits; k++) {
      if (k < 2 && digits < 15) {
        const node = side + 18 + 3 * digits + (k ? k + (found & 1) : 0);
        found = 2 * found + this.decided(first + node, node);
      } else found = 2 * found + this.even();
    }
    return negative ? -found : found;
  }
}

/** Class of a magnitude, 0 to 15: two classes for each doubling. */
function magnitude(value: number): number {
  const size = Math.abs(value);
  if (size < 4) return size;
  if (size >= 192) return CLASSES - 1;
  const digits = 30 - Math.clz32(size);
  return 2 * digits + (size >> digits);
}

/** Class of a number, 0 to 30. */
const signed = (value: number): number => CLASSES - 1 + (value > 0 ? magnitude(value) : -magnitude(value));

/** Numbers [N, width] of N rows, whose neighbours are `near` [N, NEIGHBOURS]. */
export function levels(stream: Uint8Array, width: number, near: Int32Array): Int32Array {
  const n = near.length / NEIGHBOURS;
  const each = 63 + CLASSES * CLASSES;
  const decoder = new Decoder(stream, width * each, width);
  const { places } = decoder;
  const out = new Int32Array(n * width);
  for (let i = 0; i < n; i++) {
    let total = 0;
    for (let k = 0; k < width; k++) {
      let around = 0;
      let nearest = 0;
      let amount = 0;
      for (let q = 0; q < NEIGHBOURS; q++) {
        const j = near[i * NEIGHBOURS + q]!;
        if (j < 0) continue;
        const value = out[j * width + k]!;
        around += value;
        amount += Math.abs(value);
        if (q === 0) nearest = value;
      }
      const start = k * each;
      places[0] = start * NODES;
      places[1] = (start + 1 + signed(nearest)) * NODES;
      places[2] = (start + 32 + signed(around >> 2)) * NODES;
      places[3] = (start + 63 + magnitude(amount >> 1) * CLASSES + magnitude(total)) * NODES;
      const value = decoder.number(k * NODES);
      out[i * width + k] = value;
      total += Math.abs(value);
    }
  }
  decoder.end();
  return out;
}

/** Morton codes [N], which ascend in each block, as whole numbers below 2^48. */
export function gaps(stream: Uint8Array, n: number, block: number, bits: number): Float64Array {
  const decoder = new Decoder(stream, 1 + 3 * 64, 1);
  const { places } = decoder;
  const out = new Float64Array(n);
  let [last, before, average] = [0, 0, 0];
  for (let i = 0; i < n; i++) {
    places[1] = (1 + last) * NODES;
    places[2] = (65 + before) * NODES;
    places[3] = (129 + (average >> 2)) * NODES;
    let node = 1;
    for (let k = 0; k < 6; k++) node = 2 * node + decoder.decided(node, node);
    const digits = Math.min(node - 64, 3 * bits);
    let found = Math.min(digits, 1);
    for (let kind = 0; kind < digits - 1; kind++) {
      if (kind < 2) {
        const at = 64 + (kind === 0 ? 1 : found & 3);
        found = 2 * found + decoder.decided(at, at);
      } else found = 2 * found + decoder.even();
    }
    const previous = i % block === 0 ? 0 : out[i - 1]!;
    out[i] = Math.min(previous + found, 2 ** (3 * bits) - 1);
    before = last;
    last = digits;
    average += digits - (average >> 2);
  }
  decoder.end();
  return out;
}

/** The nearest earlier rows [N, NEIGHBOURS] of cells [N, 3] in the same block, nearest first; -1 for none. */
export function neighboursOf(cells: Int32Array, block: number): Int32Array {
  const n = cells.length / 3;
  const near = new Int32Array(n * NEIGHBOURS).fill(-1);
  const least = new Float64Array(NEIGHBOURS);
  for (let i = 0; i < n; i++) {
    const row = i * NEIGHBOURS;
    let found = 0;
    for (let j = i - 1; j >= Math.max(i - WINDOW, i - (i % block)); j--) {
      let distance = 0;
      for (let axis = 0; axis < 3; axis++) distance += (cells[3 * i + axis]! - cells[3 * j + axis]!) ** 2;
      if (found === NEIGHBOURS && distance >= least[found - 1]!) continue;
      let at = Math.min(found, NEIGHBOURS - 1);
      for (; at > 0 && least[at - 1]! > distance; at--) {
        least[at] = least[at - 1]!;
        near[row + at] = near[row + at - 1]!;
      }
      least[at] = distance;
      near[row + at] = j;
      found = Math.min(found + 1, NEIGHBOURS);
    }
  }
  return near;
}

/** The rows just before each row, for numbers without positions. */
export function predecessors(count: number): Int32Array {
  return Int32Array.from({ length: count * NEIGHBOURS }, (_, i) =>
    Math.max(Math.floor(i / NEIGHBOURS) - 1 - (i % NEIGHBOURS), -1),
  );
}
