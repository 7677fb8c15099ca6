// Where the primitives lie and how far they reach. Tiny scenes are enlarged: the shaders' near plane would hide them.

import type { Floats, Scene } from "./scene";

/** Primitives of a sample, which is enough for a median. */
const SAMPLE = 5000;
const SMALLEST = 1e-30;

export type Point = [number, number, number];

const median = (values: number[]): number => values.sort((a, b) => a - b)[(values.length - 1) >> 1] ?? 0;

/** The median of a value of each primitive. */
function medianOf(count: number, value: (i: number) => number): number {
  const stride = Math.max(Math.floor(count / SAMPLE), 1);
  return median(Array.from({ length: Math.ceil(count / stride) }, (_, i) => value(i * stride)));
}

/** The middle of the primitives. */
export const middleOf = ({ field: { count, means } }: Pick<Scene, "field">): Point =>
  [0, 1, 2].map((axis) => medianOf(count, (i) => means[3 * i + axis]!)) as Point;

/** The median distance from the middle; of primitives in one place, a size. The twin of sundae_ns/scene/scene.py. */
export function reachOf(scene: Pick<Scene, "field">): number {
  const { count, means, scales } = scene.field;
  const middle = middleOf(scene);
  const reach = medianOf(count, (i) => Math.hypot(...middle.map((value, axis) => means[3 * i + axis]! - value)));
  const size = () => 3 * Math.exp(medianOf(count, (i) => Math.max(...scales.subarray(3 * i, 3 * i + 3))));
  return Math.max(reach || size(), SMALLEST);
}

/** World units in one unit of the page, whose near plane is then at most a hundredth of the extent. */
export const unitOf = ({ extent }: Scene): number => Math.min(1, extent);

/** The scene with all lengths in units of the page. */
export function enlarged(scene: Scene, unit: number): Scene {
  if (unit === 1) return scene;
  const { field, cameras, start, extent } = scene;
  const placed = <T extends { pose: number[] }>(camera: T): T => ({
    ...camera,
    pose: camera.pose.map((value, i) => (i % 4 === 3 ? value / unit : value)),
  });
  const means: Floats = field.means.map((value) => value / unit);
  const scales: Floats = field.scales.map((value) => value - Math.log(unit));
  const seen = { cameras: cameras.map(placed), start: start && placed(start) };
  return { ...scene, ...seen, field: { ...field, means, scales }, extent: extent / unit };
}
