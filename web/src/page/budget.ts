// A budget of Gaussians for phones: those that cover most stay.

import type { Field, Floats, Scene } from "../scene/scene";

/** Most Gaussians on a phone; `?all` in the address draws all of them. */
const MOST = 400_000;
/** Longest short side of the screen of a phone, CSS pixels; tablets have more. */
const PHONE = 600;

const isPhone = (): boolean =>
  matchMedia("(pointer: coarse)").matches && Math.min(screen.width, screen.height) <= PHONE;

/** The scene, on a phone with the Gaussians of its budget. */
export const onThisDevice = (scene: Scene): Scene =>
  isPhone() && !new URLSearchParams(location.search).has("all") ? thinned(scene, MOST) : scene;

/** The scene with at most this many Gaussians, in their order: those of the largest product of opacity and area. */
export function thinned(scene: Scene, most: number): Scene {
  const { field } = scene;
  const { count, opacities, scales } = field;
  if (count <= most) return scene;
  const weights = new Float32Array(count);
  for (let i = 0; i < count; i++) {
    const [a, b, c] = [scales[3 * i]!, scales[3 * i + 1]!, scales[3 * i + 2]!];
    weights[i] = a + b + c - Math.min(a, b, c) - Math.log1p(Math.exp(-opacities[i]!));
  }
  const least = weights.slice().sort()[count - most]!;
  const above = weights.reduce((sum, weight) => sum + Number(weight > least), 0);
  let ties = most - above;
  const kept = [...weights.keys()].filter((i) => weights[i]! > least || (weights[i] === least && ties-- > 0));
  const rows = (values: Floats): Floats => {
    const width = values.length / count;
    const chosen = new Float32Array(most * width);
    kept.forEach((from, to) => {
      chosen.set(values.subarray(from * width, (from + 1) * width), to * width);
    });
    return chosen;
  };
  const arrays = Object.entries(field).filter(([, value]) => value instanceof Float32Array) as [keyof Field, Floats][];
  const fewer = Object.fromEntries(arrays.map(([name, values]) => [name, rows(values)]));
  return { ...scene, field: { ...field, ...fewer, count: most } };
}
