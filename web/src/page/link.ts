// Views in the address of the page: #camera=2 is the second camera, and seven numbers are any other view.

export type Place = {
  position: [number, number, number];
  /** From the camera to the point that it turns around. */
  ahead: [number, number, number];
  /** Index of the camera whose lens is used. */
  lens: number;
};

/** No scene is this large, and no camera this close to the point that it turns around. */
const LARGEST = 1e9;
const SMALLEST = 1e-9;
const DIGITS = 7;

/** The place with lengths times a factor. */
export function resized({ position, ahead, lens }: Place, factor: number): Place {
  const times = (vector: number[]) => vector.map((value) => value * factor) as Place["ahead"];
  return { position: times(position), ahead: times(ahead), lens };
}

/** The part of an address for a stop, or for any other place. */
export const linkTo = (stop: number | null, { position, ahead, lens }: Place): string =>
  `#camera=${stop === null ? [...position, ...ahead].map((n) => Number(n.toPrecision(DIGITS))).concat(lens + 1) : stop + 1}`;

/** The stop or the place that an address names; null if it names none of this scene. */
export function linked(hash: string, stops: number): number | Place | null {
  const text = /^#camera=([-+.,\de]+)$/i.exec(hash.replaceAll("%2C", ","))?.[1];
  const parts = text?.split(",") ?? [];
  const numbers = parts.map((part) => (part === "" ? Number.NaN : Number(part)));
  if (!numbers.every((value) => Math.abs(value) < LARGEST)) return null;
  const last = numbers.at(-1)! - 1;
  if (!(Number.isInteger(last) && last >= 0 && last < stops)) return null;
  if (numbers.length === 1) return last;
  const [x, y, z, dx, dy, dz] = numbers as [number, number, number, number, number, number];
  if (numbers.length !== 7 || Math.hypot(dx, dy, dz) < SMALLEST) return null;
  return { position: [x, y, z], ahead: [dx, dy, dz], lens: last };
}
