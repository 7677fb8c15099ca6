// Sections of a file; each is checked before use.

import { type Header, isObject, type Json, type JsonObject, PackError, type Stored } from "./container";

export type Numbers =
  | Uint8Array<ArrayBuffer>
  | Uint16Array<ArrayBuffer>
  | Uint32Array<ArrayBuffer>
  | Int8Array<ArrayBuffer>
  | Int16Array<ArrayBuffer>
  | Float32Array<ArrayBuffer>
  | Float64Array<ArrayBuffer>;

/** Arrays of the dtypes that a scene uses. */
const ARRAYS: Record<string, new (bytes: ArrayBuffer) => Numbers> = {
  "|u1": Uint8Array,
  "<u2": Uint16Array,
  "<u4": Uint32Array,
  "|i1": Int8Array,
  "<i2": Int16Array,
  "<f4": Float32Array,
  "<f8": Float64Array,
};
// Levels are below 2^24 and a transform adds up to 2^8 products; the sums must stay finite in float32.
const LARGEST = 3.4028234663852886e38 / 2 ** 34;

export class Reader {
  constructor(
    readonly header: Header,
    /** Bytes of the file. */
    readonly size: number,
    private readonly stored: Map<string, Stored>,
  ) {}

  refuse(reason: string): PackError {
    return new PackError(`The file is not a valid scene (${reason}); pack it again.`);
  }

  has(name: string): boolean {
    return this.stored.has(name);
  }

  /** Length of the first dimension of a section. */
  rows(name: string): number {
    return this.stored.get(name)!.shape[0]!;
  }

  /** A finite array with one of the dtypes and the shape, in which null matches any length. */
  section(name: string, dtypes: string[], shape: (number | null)[]): Numbers {
    const found = this.stored.get(name);
    const fits = found !== undefined && dtypes.includes(found.dtype) && found.shape.length === shape.length;
    if (!fits || shape.some((side, i) => side !== null && side !== found.shape[i])) {
      throw this.refuse(`${name} is missing or has another shape`);
    }
    const array = new ARRAYS[found.dtype]!(found.bytes);
    if (found.dtype.includes("f") && !array.every(Number.isFinite)) {
      throw this.refuse(`${name} has values that are not finite`);
    }
    return array;
  }

  /** The header's entry of an attribute, with one of the codecs. */
  about(name: string, codecs: string[]): JsonObject {
    const attributes = this.header.meta.attributes;
    const entry = isObject(attributes) ? attributes[name] : undefined;
    if (!isObject(entry) || typeof entry.codec !== "string" || !codecs.includes(entry.codec)) {
      throw this.refuse(`its header has no codec for ${name} that this page knows`);
    }
    return entry;
  }

  /** A whole number from `minimum` to `maximum`. */
  whole(about: JsonObject, key: string, minimum: number, maximum: number): number {
    const value = about[key];
    if (typeof value !== "number" || !Number.isInteger(value) || value < minimum || value > maximum) {
      throw this.refuse(`${key} is not one of ${minimum} to ${maximum}`);
    }
    return value;
  }

  /** A list of `count` numbers within the range of float32. */
  numbers(value: Json | undefined, key: string, count: number): number[] {
    const fits = (number: Json): number is number => typeof number === "number" && Math.abs(number) < LARGEST;
    if (!Array.isArray(value) || value.length !== count || !value.every(fits)) {
      throw this.refuse(`${key} is not a list of ${count} numbers within float32`);
    }
    return value;
  }

  /** A section of coded numbers. */
  stream(name: string): Uint8Array {
    return this.section(name, ["|u1"], [null]) as Uint8Array;
  }
}
