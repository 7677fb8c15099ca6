// One camera in the rasteriser's form, and the scale at which the head runs.

import type { Camera } from "./scene/scene";

export type View = {
  /** World-to-camera, OpenCV axes [3, 4]. */
  worldToCamera: number[];
  /** Camera centre, world units. */
  center: [number, number, number];
  fx: number;
  fy: number;
  cx: number;
  cy: number;
  width: number;
  height: number;
};

/** A view of a camera-to-world transform [3, 4] with OpenGL axes. */
export function viewOf({ pose, ...lens }: Camera): View {
  const column = (c: number): [number, number, number] => [pose[c]!, pose[4 + c]!, pose[8 + c]!];
  const center = column(3);
  const rows = [column(0), column(1).map((value) => -value), column(2).map((value) => -value)];
  const worldToCamera = rows.flatMap((row) => [...row, -row.reduce((sum, value, i) => sum + value * center[i]!, 0)]);
  return { worldToCamera, center, ...lens };
}

/** The same field of view with sides `factor` times as long, in whole pixels. */
export function zoomed(view: View, factor: number): View {
  const width = Math.max(roundToEven(view.width * factor), 1);
  const height = Math.max(roundToEven(view.height * factor), 1);
  const [x, y] = [width / view.width, height / view.height];
  return { ...view, width, height, fx: view.fx * x, fy: view.fy * y, cx: view.cx * x, cy: view.cy * y };
}

/** Rounds halves to even numbers, as Python does. */
const roundToEven = (value: number): number => {
  const rounded = Math.round(value);
  return value % 1 === 0.5 && rounded % 2 === 1 ? rounded - 1 : rounded;
};

export type ScalePlan = { zoom: number; weight: number };

const TOLERANCE = 1.01;
const FADE: [number, number] = [4, 2];
const MAX_PIXELS = 2 ** 24;
const MARGIN = 1.25;

/** The scale and the share of the correction of a view; the twin of sundae_ns/scene/render.py. */
export function scalePlan(view: View, trained: [number, number] | null): ScalePlan {
  if (trained === null) return { zoom: 1, weight: 1 };
  const focal = (view.fx + view.fy) / 2;
  const pixels = view.width * view.height;
  const zoom = Math.min(Math.max(focal, trained[0]), trained[1]) / focal;
  if (1 / TOLERANCE <= zoom && zoom <= TOLERANCE) return { zoom: 1, weight: 1 };
  const limit = Math.max(MAX_PIXELS, MARGIN ** 2 * pixels);
  return { zoom, weight: Math.min(fading(zoom, ...FADE), fading(pixels * zoom ** 2, 2 * limit, limit)) };
}

/** 1 up to `full`, then linearly down to 0 at `off`. */
const fading = (value: number, off: number, full: number): number =>
  Math.min(Math.max((off - value) / (off - full), 0), 1);
