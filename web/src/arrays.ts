// The parameters of a scene as shaders read them.

import type { Scene } from "./scene/scene";

/** A primitive for the shader: centre, opacity, and the columns of a root of its covariance, 16 numbers. */
export function geometryOf({ field }: Scene): Float32Array<ArrayBuffer> {
  const out = new Float32Array(field.count * 16);
  for (let i = 0; i < field.count; i++) {
    const at = 16 * i;
    const [w = 1, x = 0, y = 0, z = 0] = field.quats.subarray(4 * i, 4 * i + 4);
    const scale = [0, 1, 2].map((axis) => Math.exp(field.scales[3 * i + axis]!));
    const columns = [
      [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
      [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
      [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
    ];
    out.set(field.means.subarray(3 * i, 3 * i + 3), at);
    out[at + 3] = 1 / (1 + Math.exp(-field.opacities[i]!));
    columns.forEach((column, c) => {
      column.forEach((value, row) => {
        out[at + 4 + 4 * c + row] = value * scale[c]!;
      });
    });
  }
  return out;
}

/** All SH coefficients, or the logits of the colours [N, K, 3]. */
export function coefficientsOf({ field, degree }: Scene): Float32Array<ArrayBuffer> {
  const width = 3 * (degree + 1) ** 2;
  const out = new Float32Array(field.count * width);
  for (let i = 0; i < field.count; i++) {
    out.set(field.features_dc.subarray(3 * i, 3 * i + 3), i * width);
    out.set(field.features_rest.subarray((width - 3) * i, (width - 3) * (i + 1)), i * width + 3);
  }
  return out;
}

/** Features in groups of four channels, the last one padded by zeros. */
export function featuresOf({ field, features }: Scene): Float32Array<ArrayBuffer> {
  const width = 4 * Math.ceil(features / 4);
  const out = new Float32Array(field.count * width);
  for (let i = 0; i < field.count; i++) out.set(field.features.subarray(features * i, features * (i + 1)), width * i);
  return out;
}
