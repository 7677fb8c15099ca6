// A packed scene as arrays; the twin of sundae_ns/io/pack/packed_scene.py and of its checks.

import { cellsOf, positions, rotations, transformed } from "./codecs";
import { checkRatio, damaged, readAll, readHeader } from "./container";
import { gaps, levels, neighboursOf } from "./entropy";
import { type Head, readHead, type StatedHead } from "./head";
import { type Numbers, Reader } from "./reader";
import { violation } from "./schema";
import { reachOf } from "./size";

export type Floats = Float32Array<ArrayBuffer>;

/** The parameters of N primitives, as sundae_ns/core/gaussians.py names them. */
export type Field = {
  count: number;
  means: Floats;
  quats: Floats;
  scales: Floats;
  opacities: Floats;
  features_dc: Floats;
  /** [N, K, 3]. */
  features_rest: Floats;
  features: Floats;
};

/** A camera of the capture: camera-to-world [3, 4] with OpenGL axes; fx, fy, cx, cy, width and height in pixels. */
export type Camera = { pose: number[]; fx: number; fy: number; cx: number; cy: number; width: number; height: number };

export type Scene = {
  field: Field;
  /** Gaussians of the file; a phone draws fewer. */
  total: number;
  /** Median distance of the primitives from their middle, world units; 1 in nerfstudio's model. */
  extent: number;
  /** Length of a feature vector; 0 without features. */
  features: number;
  /** SH degree of the stored colours. */
  degree: number;
  /** Whether `features_dc` holds logits of colours, not harmonics. */
  logits: boolean;
  antialiased: boolean;
  background: [number, number, number];
  head: Head | null;
  trainedFocal: [number, number] | null;
  cameras: Camera[];
  /** The direction that is upwards, about of unit length; null where the file states none. */
  up: number[] | null;
  /** The camera that the page opens with; null for the first one. */
  start: Camera | null;
};

/** Random backgrounds are shown in viser's colour. */
const BACKGROUNDS: Record<string, [number, number, number]> = {
  random: [0.149, 0.1647, 0.2157],
  black: [0, 0, 0],
  white: [1, 1, 1],
};

type OnProgress = (share: number) => void;

/** Reads a packed scene, with memory bounded by its size; throws a PackError that says what is wrong. */
export async function readScene(file: Uint8Array<ArrayBuffer>, onProgress: OnProgress = () => {}): Promise<Scene> {
  const header = await readHeader(file);
  const wrong = violation(header.meta, "header") ?? violation(header.meta.model, "model", "model");
  if (wrong !== null) throw damaged(`its header has no valid ${wrong}`);
  const { primitives, attributes, model: stated, up = null, start = null, source } = header.meta as unknown as Stated;
  const width = (name: string): number => attributes[name]?.width ?? 0;
  const shape = { count: primitives, rest: width("features_rest"), features: width("features") };
  checkRatio(4 * shape.count * (14 + shape.rest + shape.features), file.length);
  const reader = new Reader(header, file.length, await readAll(file, header));
  const degree = Math.sqrt(shape.rest / 3 + 1) - 1;
  if (degree > stated.sh_degree) throw reader.refuse("its header states a lower SH degree than it has");
  const field = readField(reader, shape, onProgress);
  const head = readHead(reader, stated.head ?? null);
  if ((head?.kind.features ?? 0) !== shape.features) {
    throw reader.refuse("its header states another number of features than it has");
  }
  return {
    field,
    total: field.count,
    extent: source?.model_frame === false ? reachOf({ field }) : 1,
    features: shape.features,
    degree,
    logits: stated.sh_degree === 0,
    antialiased: stated.rasterize_mode === "antialiased",
    background: BACKGROUNDS[stated.background_color]!,
    head,
    trainedFocal: stated.trained_focal ?? null,
    cameras: readCameras(reader),
    up,
    start: start && cameraOf(start.pose.flat(), start.intrinsics, start.size),
  };
}

type Shape = { count: number; rest: number; features: number };

/** What the header states, once it is checked. */
type Stated = {
  primitives: number;
  attributes: Record<string, { width?: number }>;
  model: {
    sh_degree: number;
    rasterize_mode: string;
    background_color: string;
    head?: StatedHead | null;
    trained_focal?: [number, number] | null;
  };
  source?: { model_frame?: boolean };
  up?: number[];
  start?: { pose: number[][]; intrinsics: number[]; size: number[] };
};

function cameraOf(pose: number[], [fx, fy, cx, cy]: number[], [width, height]: number[]): Camera {
  return { pose, fx: fx!, fy: fy!, cx: cx!, cy: cy!, width: width!, height: height! };
}

function readField(reader: Reader, { count, rest, features }: Shape, onProgress: OnProgress): Field {
  const none = new Float32Array(0);
  const { bits, block } = reader.about("means");
  const blocks = Math.ceil(count / block);
  const [low, high] = ["low", "high"].map((end) => reader.array("means", end, { blocks }) as Float32Array);
  const cells = cellsOf(gaps(reader.array("means", "gaps") as Uint8Array, count, block, bits));
  const near = neighboursOf(cells, block);
  // Positions and rotations come first, six columns.
  let columns = 6;
  const rows = (name: string, width: number): Float32Array => {
    onProgress(columns / (13 + rest + features));
    columns += width;
    return width ? readRows(reader, name, near, width) : none;
  };
  return {
    count,
    means: positions(cells, low!, high!, bits, block),
    quats: rotations(...readLevels(reader, "quats", near, 3)),
    scales: rows("scales", 3),
    opacities: rows("opacities", 1),
    features_dc: rows("features_dc", 3),
    features_rest: rows("features_rest", rest),
    features: rows("features", features),
  } as Field;
}

/** Levels [N, width] of an attribute, and their step. */
function readLevels(reader: Reader, name: string, near: Int32Array, width: number): [Int32Array, number] {
  return [levels(reader.array(name, "levels") as Uint8Array, width, near), reader.about(name).step];
}

function readRows(reader: Reader, name: string, near: Int32Array, width: number): Float32Array {
  const [found, step] = readLevels(reader, name, near, width);
  const mean = reader.array(name, "mean", { width }) as Float32Array;
  const basis = reader.array(name, "basis", { square: width * width }) as Int8Array;
  return transformed(found, mean, basis, step);
}

function readCameras(reader: Reader): Camera[] {
  if (!reader.has("cameras/poses")) return [];
  const count = reader.rows("cameras/poses");
  const [poses, intrinsics, sizes] = ["poses", "intrinsics", "sizes"].map((part) =>
    reader.array("cameras", part, { cameras: count }),
  ) as [Numbers, Numbers, Numbers];
  return Array.from({ length: count }, (_, i) => {
    const row = (array: Numbers, length: number): number[] => [...array.subarray(length * i, length * (i + 1))];
    return cameraOf(row(poses, 12), row(intrinsics, 4), row(sizes, 2));
  });
}
