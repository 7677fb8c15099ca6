// A packed scene as arrays; the twin of sundae_ns/storage/packing/scene.py and of its checks.

import { cellsOf, positions, rotations, transformed } from "./codecs";
import { checkRatio, type Header, isObject, type JsonObject, PackError, readAll, readHeader } from "./container";
import { gaps, levels, neighboursOf } from "./entropy";
import { type Head, readHead } from "./head";
import { Reader } from "./reader";

export type Floats = Float32Array<ArrayBuffer>;

/** The parameters of N primitives, as sundae_ns/gaussians/parameters.py names them. */
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
};

const MOST_PRIMITIVES = 2 ** 28;
const MOST_WIDTH = 256;
/** Random backgrounds are shown in viser's colour. */
const BACKGROUNDS: Record<string, [number, number, number]> = {
  random: [0.149, 0.1647, 0.2157],
  black: [0, 0, 0],
  white: [1, 1, 1],
};

/** Reads a packed scene, with memory bounded by its size; throws a PackError that says what is wrong. */
export async function readScene(file: Uint8Array<ArrayBuffer>): Promise<Scene> {
  const header = await readHeader(file);
  const shape = shapeOf(header);
  checkRatio(4 * shape.count * (14 + shape.rest + shape.features), file.length);
  const reader = new Reader(header, file.length, await readAll(file, header));
  const model = modelOf(reader);
  const degree = Math.sqrt(shape.rest / 3 + 1) - 1;
  if (degree > model.degree) throw reader.refuse("its header states a lower SH degree than it has");
  const field = readField(reader, shape);
  const head = readHead(reader, model.head);
  if (head !== null && head.kind.features !== shape.features) {
    throw reader.refuse("its header states another head than it has");
  }
  return {
    field,
    features: head === null ? 0 : shape.features,
    degree,
    logits: model.degree === 0,
    antialiased: model.antialiased,
    background: model.background,
    head,
    trainedFocal: model.trainedFocal,
    cameras: readCameras(reader),
  };
}

type Shape = { count: number; rest: number; features: number };

/** Numbers of primitives, of SH values of degrees 1 and up, and of features, from the header alone. */
function shapeOf(header: Header): Shape {
  const refusal = new PackError("The file is not a valid scene (its header contradicts itself); pack it again.");
  const { attributes, primitives } = header.meta;
  const whole = (value: unknown, most: number): value is number =>
    typeof value === "number" && Number.isInteger(value) && 1 <= value && value < most;
  if (!isObject(attributes) || !whole(primitives, MOST_PRIMITIVES)) throw refusal;
  const width = (name: string): number => {
    const about = attributes[name];
    if (about === undefined) return 0;
    if (!isObject(about) || !whole(about.width, MOST_WIDTH + 1)) throw refusal;
    return about.width;
  };
  const rest = width("features_rest");
  if (rest % 3 !== 0 || ![1, 2, 3, 4, 5].includes(Math.sqrt(rest / 3 + 1))) throw refusal;
  return { count: primitives, rest, features: width("features") };
}

function readField(reader: Reader, { count, rest, features }: Shape): Field {
  const none = new Float32Array(0);
  const about = reader.about("means", ["blocks"]);
  const bits = reader.whole(about, "bits", 4, 16);
  const block = reader.whole(about, "block", 16, 2 ** 20);
  const [low, high] = ["low", "high"].map(
    (end) => reader.section(`means/${end}`, ["<f4"], [Math.ceil(count / block), 3]) as Float32Array,
  );
  const cells = cellsOf(gaps(reader.stream("means/gaps"), count, block, bits));
  const near = neighboursOf(cells, block);
  const rows = (name: string, width: number): Float32Array => (width ? readRows(reader, name, near, width) : none);
  return {
    count,
    means: positions(cells, low!, high!, bits, block),
    quats: rotations(...readLevels(reader, "quats", "xyz", near, 3)),
    scales: rows("scales", 3),
    opacities: rows("opacities", 1),
    features_dc: rows("features_dc", 3),
    features_rest: rows("features_rest", rest),
    features: rows("features", features),
  } as Field;
}

/** Levels [N, width] of an attribute, and their step. */
function readLevels(
  reader: Reader,
  name: string,
  codec: string,
  near: Int32Array,
  width: number,
): [Int32Array, number] {
  const about = reader.about(name, [codec]);
  const [step] = reader.numbers([about.step ?? null], "step", 1);
  return [levels(reader.stream(`${name}/levels`), width, near), step!];
}

function readRows(reader: Reader, name: string, near: Int32Array, width: number): Float32Array {
  const [found, step] = readLevels(reader, name, "transform", near, width);
  const mean = reader.section(`${name}/mean`, ["<f4"], [width]) as Float32Array;
  const basis = reader.section(`${name}/basis`, ["|i1"], [width * width]) as Int8Array;
  return transformed(found, mean, basis, step);
}

function readCameras(reader: Reader): Camera[] {
  if (!reader.has("cameras/poses")) return [];
  const count = reader.rows("cameras/poses");
  const poses = reader.section("cameras/poses", ["<f4"], [count, 3, 4]);
  const intrinsics = reader.section("cameras/intrinsics", ["<f8"], [count, 4]);
  const sizes = reader.section("cameras/sizes", ["<u4"], [count, 2]);
  if (sizes.some((side) => side < 1 || side > 2 ** 16)) throw reader.refuse("a camera has an invalid image size");
  return Array.from({ length: count }, (_, i) => {
    const [fx, fy, cx, cy] = intrinsics.subarray(4 * i, 4 * i + 4);
    const [width, height] = sizes.subarray(2 * i, 2 * i + 2);
    const pose = [...poses.subarray(12 * i, 12 * i + 12)];
    return { pose, fx: fx!, fy: fy!, cx: cx!, cy: cy!, width: width!, height: height! };
  });
}

type Model = {
  degree: number;
  antialiased: boolean;
  background: [number, number, number];
  head: JsonObject[string] | undefined;
  trainedFocal: [number, number] | null;
};

function modelOf(reader: Reader): Model {
  const stated = reader.header.meta.model;
  if (!isObject(stated)) throw reader.refuse("its header states no model");
  const { rasterize_mode: mode, background_color: background, trained_focal: focal = null } = stated;
  if (mode !== "classic" && mode !== "antialiased") throw reader.refuse("its header states an unknown rasterize_mode");
  if (typeof background !== "string" || !Object.hasOwn(BACKGROUNDS, background)) {
    throw reader.refuse("its header states an unknown background_color");
  }
  const positive = focal === null ? [] : reader.numbers(focal, "trained_focal", 2);
  if (positive.some((value) => value <= 0)) throw reader.refuse("its header states impossible focal lengths");
  return {
    degree: reader.whole(stated, "sh_degree", 0, 4),
    antialiased: mode === "antialiased",
    background: BACKGROUNDS[background]!,
    head: stated.head,
    trainedFocal: focal === null ? null : [positive[0]!, positive[1]!],
  };
}
