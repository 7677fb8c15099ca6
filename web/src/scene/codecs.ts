// Numbers of the sections back to values; the twin of sundae_ns/storage/packing/quantize.py and transform.py.

const ROOT_HALF = Math.SQRT1_2;

/** Every third bit of a number of at most 24 bits, moved together. */
function everyThird(bits: number): number {
  let x = bits & 0x249249;
  x = (x | (x >> 2)) & 0x0c30c3;
  x = (x | (x >> 4)) & 0x00f00f;
  return (x | (x >> 8)) & 0x0000ff;
}

/** One coordinate of the cell of a Morton code, given as its low and high 32 bits. */
function separate(low: number, high: number, axis: number): number {
  // 24 bits hold eight bits of each axis, and the next 24 bits begin at the same axis.
  const first = low & 0xffffff;
  const second = ((low >>> 24) | (high << 8)) & 0xffffff;
  const third = high >>> 16;
  const cell = everyThird(first >> axis) | (everyThird(second >> axis) << 8) | (everyThird(third >> axis) << 16);
  return cell & 0x1fffff;
}

/**
 * Positions [N, 3] from differences of Morton codes, given as low and high halves.
 *
 * @param low - lower bounds of the blocks [B, 3]
 * @param high - upper bounds of the blocks [B, 3]
 */
export function positions(
  deltas: Uint32Array,
  low: Float32Array,
  high: Float32Array,
  bits: number,
  block: number,
): Float32Array {
  const n = deltas.length / 2;
  const out = new Float32Array(n * 3);
  let codeLow = 0;
  let codeHigh = 0;
  for (let i = 0; i < n; i++) {
    const b = Math.floor(i / block);
    if (i % block === 0) codeLow = codeHigh = 0;
    const total = codeLow + deltas[2 * i]!;
    codeLow = total >>> 0;
    codeHigh = (codeHigh + deltas[2 * i + 1]! + (total > 0xffffffff ? 1 : 0)) >>> 0;
    for (let axis = 0; axis < 3; axis++) {
      const at = 3 * b + axis;
      const step = (high[at]! - low[at]!) / (2 ** bits - 1);
      out[3 * i + axis] = separate(codeLow, codeHigh, axis) * step + low[at]!;
    }
  }
  return out;
}

/** Unit quaternions wxyz [N, 4] from their three smallest components [3, N]; the largest is positive. */
export function rotations(codes: Uint8Array | Uint16Array, largest: Uint8Array, bits: number): Float32Array {
  const n = codes.length / 3;
  const out = new Float32Array(n * 4);
  const three = [0, 0, 0];
  for (let i = 0; i < n; i++) {
    for (let k = 0; k < 3; k++) three[k] = Math.fround(((codes[k * n + i]! * 2) / (2 ** bits - 1) - 1) * ROOT_HALF);
    const square = three[0]! ** 2 + three[1]! ** 2 + three[2]! ** 2;
    const fourth = Math.sqrt(Math.max(1 - square, 0));
    const length = Math.max(Math.sqrt(square + fourth ** 2), 1.2e-38);
    const place = (largest[i >> 2]! >> (2 * (i & 3))) & 3;
    for (let k = 0, next = 0; k < 4; k++) out[4 * i + k] = (k === place ? fourth : three[next++]!) / length;
  }
  return out;
}

/** Values [N, C] of codes [C, N]: low + step * code, and the exceptions at their places. */
export function uniform(
  codes: Uint8Array | Uint16Array,
  low: number[],
  step: number[],
  places: Uint32Array,
  exceptions: Float32Array,
): Float32Array {
  const width = low.length;
  const n = codes.length / width;
  const out = new Float32Array(n * width);
  for (let c = 0; c < width; c++) {
    for (let i = 0; i < n; i++) out[i * width + c] = low[c]! + codes[c * n + i]! * step[c]!;
  }
  places.forEach((place, e) => {
    out[(place % n) * width + Math.floor(place / n)] = exceptions[e]!;
  });
  return out;
}

/** Codes of three channels of which the first and the last are stored as differences from the second. */
export function withoutDifferences<T extends Uint8Array | Uint16Array>(codes: T): T {
  const n = codes.length / 3;
  const out = codes.slice() as T;
  for (let i = 0; i < n; i++) {
    // Typed arrays wrap around, as the format does.
    out[i] = codes[i]! + codes[n + i]!;
    out[2 * n + i] = codes[2 * n + i]! + codes[n + i]!;
  }
  return out;
}

/** Rows [N, D] of transform coefficients [D, N]; `basis` [D, D] is in 127ths of the step, `exact` replaces some rows. */
export function transformed(
  codes: Int8Array | Int16Array,
  basis: Int8Array,
  step: number,
  rows: Uint32Array,
  exact: Float32Array,
): Float32Array {
  const width = Math.sqrt(basis.length);
  const n = codes.length / width;
  const unit = Math.fround(step / 127);
  const scaled = Float32Array.from(basis, (value) => value * unit);
  const out = new Float32Array(n * width);
  const row = new Float64Array(width);
  for (let i = 0; i < n; i++) {
    row.fill(0);
    for (let k = 0; k < width; k++) {
      const code = codes[k * n + i]!;
      if (code === 0) continue;
      for (let d = 0; d < width; d++) row[d]! += code * scaled[k * width + d]!;
    }
    out.set(row, i * width);
  }
  rows.forEach((place, e) => {
    out.set(exact.subarray(e * width, (e + 1) * width), place * width);
  });
  return out;
}

/** A half-precision number of its 16 bits (IEEE 754). */
export function half(bits: number): number {
  const sign = bits & 0x8000 ? -1 : 1;
  const exponent = (bits >> 10) & 31;
  const fraction = bits & 0x3ff;
  if (exponent === 0) return sign * fraction * 2 ** -24;
  if (exponent === 31) return fraction ? Number.NaN : sign * Number.POSITIVE_INFINITY;
  return sign * (1 + fraction / 1024) * 2 ** (exponent - 15);
}
