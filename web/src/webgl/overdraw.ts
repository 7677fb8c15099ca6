// How many fragments the quads of a view have, before they are drawn: WebGL has no way to stop.

import type { View } from "../view";

const NEAR = 0.01;
const BLUR = 0.3;
const FOV_MARGIN = 0.15;
const REACH = 3.4;

/** Length of the longest axis of each primitive. */
export function extentsOf(geometry: Float32Array): Float32Array {
  return Float32Array.from({ length: geometry.length / 16 }, (_, i) => {
    const lengths = [4, 8, 12].map((at) => Math.hypot(...geometry.subarray(16 * i + at, 16 * i + at + 3)));
    return Math.max(...lengths);
  });
}

/** Bounds of the slopes of a camera at which footprints are linearised, along one axis. */
function slopes(focal: number, centre: number, size: number): [number, number] {
  const margin = (FOV_MARGIN * size) / focal;
  return [-centre / focal - margin, (size - centre) / focal + margin];
}

/** Length of the part of an image's side that `centre` plus or minus `reach` covers. */
const covered = (centre: number, reach: number, size: number): number =>
  Math.max(Math.min(centre + reach, size) - Math.max(centre - reach, 0), 0) || 0;

/** A number that `fragmentsOf` does not exceed, of all primitives by their extents; fast. */
export function boundOf(geometry: Float32Array, extents: Float32Array, view: View): number {
  const [, , , , , , , , x, y, z, w] = view.worldToCamera;
  const steepest = (focal: number, centre: number, size: number) =>
    Math.max(...slopes(focal, centre, size).map(Math.abs));
  const across = view.fx * Math.hypot(1, steepest(view.fx, view.cx, view.width));
  const down = view.fy * Math.hypot(1, steepest(view.fy, view.cy, view.height));
  let sum = 0;
  extents.forEach((extent, i) => {
    const at = 16 * i;
    const depth = x! * geometry[at]! + y! * geometry[at + 1]! + z! * geometry[at + 2]! + w!;
    if (!(depth >= NEAR)) return;
    const [wide, high] = [across, down].map((focal) => 2 * REACH * Math.hypot((focal * extent) / depth, BLUR ** 0.5));
    sum += Math.min(wide!, view.width) * Math.min(high!, view.height) || 0;
  });
  return sum;
}

/** Fragments of the quads of splats.vert, summed over all primitives. */
export function fragmentsOf(geometry: Float32Array, view: View): number {
  const m = view.worldToCamera;
  const { fx, fy, cx, cy, width, height } = view;
  const [limitsX, limitsY] = [slopes(fx, cx, width), slopes(fy, cy, height)];
  const along = (row: number, at: number): number =>
    m[4 * row]! * geometry[at]! + m[4 * row + 1]! * geometry[at + 1]! + m[4 * row + 2]! * geometry[at + 2]!;
  let sum = 0;
  for (let at = 0; at < geometry.length; at += 16) {
    const z = along(2, at) + m[11]!;
    if (!(z >= NEAR)) continue;
    const [x, y] = [(along(0, at) + m[3]!) / z, (along(1, at) + m[7]!) / z];
    const slopeX = Math.min(Math.max(x, limitsX[0]), limitsX[1]);
    const slopeY = Math.min(Math.max(y, limitsY[0]), limitsY[1]);
    let [xx, yy] = [BLUR, BLUR];
    for (let column = at + 4; column < at + 16; column += 4) {
      const ahead = along(2, column);
      xx += ((fx / z) * (along(0, column) - slopeX * ahead)) ** 2;
      yy += ((fy / z) * (along(1, column) - slopeY * ahead)) ** 2;
    }
    const visible = 255 * geometry[at + 3]!;
    if (!(visible >= 1)) continue;
    const reach = Math.min(Math.sqrt(2 * Math.log(visible)), REACH);
    sum += covered(fx * x + cx, reach * Math.sqrt(xx), width) * covered(fy * y + cy, reach * Math.sqrt(yy), height);
  }
  return sum;
}
