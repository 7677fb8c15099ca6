// Numbers of the sections back to values; the twin of sundae_ns/io/pack/codecs.py.

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

/** Cells [N, 3] of Morton codes below 2^48. */
export function cellsOf(codes: Float64Array): Int32Array {
  const out = new Int32Array(codes.length * 3);
  codes.forEach((code, i) => {
    for (let axis = 0; axis < 3; axis++) out[3 * i + axis] = separate(code >>> 0, Math.floor(code / 2 ** 32), axis);
  });
  return out;
}

/**
 * Positions [N, 3] from cells [N, 3].
 *
 * @param low - lower bounds of the blocks [B, 3]
 * @param high - upper bounds of the blocks [B, 3]
 */
export function positions(
  cells: Int32Array,
  low: Float32Array,
  high: Float32Array,
  bits: number,
  block: number,
): Float32Array {
  return Float32Array.from(cells, (cell, i) => {
    const at = 3 * Math.floor(i / 3 / block) + (i % 3);
    return cell * ((high[at]! - low[at]!) / (2 ** bits - 1)) + low[at]!;
  });
}

/** Unit quaternions wxyz [N, 4] from levels of x, y and z [N, 3]; w is positive. */
export function rotations(levels: Int32Array, step: number): Float32Array {
  const n = levels.length / 3;
  const out = new Float32Array(n * 4);
  for (let i = 0; i < n; i++) {
    const [x = 0, y = 0, z = 0] = levels.subarray(3 * i, 3 * i + 3);
    const three = [x, y, z].map((level) => Math.fround(level * step));
    const square = three.reduce((sum, part) => sum + part * part, 0);
    const w = Math.sqrt(Math.max(1 - square, 0));
    const length = Math.sqrt(w * w + square);
    out.set(
      [w, ...three].map((part) => part / length),
      4 * i,
    );
  }
  return out;
}

/** Rows [N, D] of levels [N, D]; `basis` [D, D] is in 127ths of the step. */
export function transformed(levels: Int32Array, mean: Float32Array, basis: Int8Array, step: number): Float32Array {
  const width = mean.length;
  const unit = Math.fround(step / 127);
  const scaled = Float32Array.from(basis, (value) => value * unit);
  const out = new Float32Array(levels.length);
  const row = new Float64Array(width);
  for (let at = 0; at < levels.length; at += width) {
    row.set(mean);
    for (let k = 0; k < width; k++) {
      const level = levels[at + k]!;
      if (level === 0) continue;
      for (let d = 0; d < width; d++) row[d]! += level * scaled[k * width + d]!;
    }
    out.set(row, at);
  }
  return out;
}
