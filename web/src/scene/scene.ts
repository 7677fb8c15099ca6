// A packed scene as arrays; the twin of sundae_ns/storage/packing/scene.py and of its checks.

import { positions, rotations, transformed, uniform, withoutDifferences } from "./codecs";
import { checkRatio, type Header, isObject, type JsonObject, PackError, readAll, readHeader } from "./container";
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
const MOST_FEATURES = 256;
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
  const reader = new Reader(header, await readAll(file, header));
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
    if (about === undefined || about === null) return 0;
    if (!isObject(about)) throw refusal;
    const found = header.sections.get(`${name}/codes`)?.shape[0];
    if (!whole(found, MOST_FEATURES + 1)) throw refusal;
    return found;
  };
  const rest = width("features_rest");
  if (rest % 3 !== 0 || ![1, 2, 3, 4, 5].includes(Math.sqrt(rest / 3 + 1))) throw refusal;
  return { count: primitives, rest, features: width("features") };
}

function readField(reader: Reader, { count, rest, features }: Shape): Field {
  const none = new Float32Array(0);
  return {
    count,
    means: readMeans(reader, count),
    quats: readQuats(reader, count),
    scales: readUniform(reader, "scales", count, 3),
    opacities: readUniform(reader, "opacities", count, 1),
    features_dc: readUniform(reader, "features_dc", count, 3),
    features_rest: rest ? readRows(reader, "features_rest", count, rest) : none,
    features: features ? readRows(reader, "features", count, features) : none,
  } as Field;
}

function readMeans(reader: Reader, n: number): Float32Array {
  const about = reader.about("means", ["blocks"]);
  const bits = reader.whole(about, "bits", 4, 21);
  const block = reader.whole(about, "block", 16, 2 ** 20);
  const deltas = reader.section("means/deltas", ["<u8"], [n]) as Uint32Array;
  const [low, high] = ["low", "high"].map(
    (end) => reader.section(`means/${end}`, ["<f4"], [Math.ceil(n / block), 3]) as Float32Array,
  );
  return positions(deltas, low!, high!, bits, block);
}

const codeType = (bits: number): string => (bits <= 8 ? "|u1" : "<u2");

function readQuats(reader: Reader, n: number): Float32Array {
  const bits = reader.whole(reader.about("quats", ["smallest-three"]), "bits", 4, 16);
  const codes = reader.section("quats/codes", [codeType(bits)], [3, n]) as Uint8Array | Uint16Array;
  const largest = reader.section("quats/largest", ["|u1"], [Math.ceil(n / 4)]) as Uint8Array;
  return rotations(codes, largest, bits);
}

function readUniform(reader: Reader, name: string, n: number, width: number): Float32Array {
  const about = reader.about(name, ["uniform"]);
  const bits = reader.whole(about, "bits", 4, 16);
  let codes = reader.section(`${name}/codes`, [codeType(bits)], [width, n]) as Uint8Array | Uint16Array;
  if (about.differences === true) {
    if (width !== 3) throw reader.refuse(`${name} does not have three channels`);
    codes = withoutDifferences(codes);
  }
  const places = reader.places(`${name}/places`, width * n);
  const exceptions = reader.section(`${name}/exceptions`, ["<f4"], [places.length]) as Float32Array;
  const low = reader.numbers(about.low, "low", width);
  return uniform(codes, low, reader.numbers(about.step, "step", width), places, exceptions);
}

function readTransform(reader: Reader, name: string, n: number, width: number): Float32Array {
  const about = reader.about(name, ["transform"]);
  const [step] = reader.numbers([about.step ?? null], "step", 1);
  const codes = reader.section(`${name}/codes`, ["|i1", "<i2"], [width, n]) as Int8Array | Int16Array;
  const basis = reader.section(`${name}/basis`, ["|i1"], [width * width]) as Int8Array;
  const rows = reader.places(`${name}/rows`, n);
  const exact = reader.section(`${name}/exact`, ["<f4"], [rows.length, width]) as Float32Array;
  return transformed(codes, basis, step!, rows, exact);
}

function readRows(reader: Reader, name: string, n: number, width: number): Float32Array {
  const { codec } = reader.about(name, ["transform", "uniform"]);
  return codec === "transform" ? readTransform(reader, name, n, width) : readUniform(reader, name, n, width);
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
