// The one description of headers and sections, and the checks by it; the twin of sundae_ns/io/pack/container.py.

import format from "../../../sundae_ns/io/pack/format.json";

export type Json = null | boolean | number | string | Json[] | { [key: string]: Json };
export type JsonObject = { [key: string]: Json };

/** JSON Schema with the keywords that `fault` reads; container.py says what `uniqueBy`, `counts` and `orthonormal` mean. */
type Schema = {
  type?: string | string[];
  enum?: Json[];
  pattern?: string;
  minimum?: number;
  maximum?: number;
  minItems?: number;
  maxItems?: number;
  prefixItems?: Schema[];
  items?: Schema;
  uniqueBy?: string | number;
  counts?: number;
  orthonormal?: boolean;
  required?: string[];
  additionalProperties?: boolean;
  properties?: Record<string, Schema>;
};

/** A section of the file: null in a shape matches any length, and a list is a range for each column. */
export type SectionFormat = {
  dtype: string;
  shape: (string | number | null)[];
  minimum?: number | number[];
  maximum?: number | number[];
};

const SCHEMAS: Record<"container" | "header" | "model", Schema> = format;
export const LIMITS = format.limits;
/** Sections by codec and part. */
export const SECTIONS: Record<string, Record<string, SectionFormat>> = format.sections;

const isObject = (value: Json): value is JsonObject =>
  typeof value === "object" && value !== null && !Array.isArray(value);

function is(value: Json, kind: string): boolean {
  if (kind === "integer") return Number.isInteger(value);
  if (kind === "array") return Array.isArray(value);
  if (kind === "object") return isObject(value);
  return kind === "null" ? value === null : typeof value === kind;
}

const joined = (place: string, key: string | number): string => (place ? `${place}.${key}` : `${key}`);

/** The place of the first violation of a schema, as dotted keys from `place` on; null for a valid value. */
export function fault(value: Json | undefined, schema: Schema, place: string): string | null {
  if (value === undefined) return place;
  const kinds = [schema.type ?? []].flat();
  if (kinds.length > 0 && !kinds.some((kind) => is(value, kind))) return place;
  if (schema.enum && !schema.enum.includes(value)) return place;
  if (typeof value === "string") return schema.pattern && !new RegExp(schema.pattern).test(value) ? place : null;
  if (typeof value === "number") {
    return (schema.minimum ?? value) <= value && value <= (schema.maximum ?? value) ? null : place;
  }
  if (Array.isArray(value)) return faultOfList(value, schema, place);
  return isObject(value) ? faultOfObject(value, schema, place) : null;
}

function faultOfList(value: Json[], schema: Schema, place: string): string | null {
  const count = value.length;
  if (count < (schema.minItems ?? 0) || count > (schema.maxItems ?? count)) return place;
  for (const [i, item] of value.entries()) {
    const found = fault(item, schema.prefixItems?.[i] ?? schema.items ?? {}, joined(place, i));
    if (found !== null) return found;
  }
  const most = schema.counts;
  if (most !== undefined && !value.every((item) => is(item, "integer") && 0 <= Number(item) && Number(item) <= most)) {
    return place;
  }
  const key = schema.uniqueBy;
  if (key !== undefined && new Set(value.map((item) => (item as JsonObject)[key])).size < count) return place;
  return schema.orthonormal && !isOrthonormal(value as number[] | number[][]) ? place : null;
}

const CROOKED = 0.1;
type Row = [number, number, number];
const dot = (a: Row, b: Row): number => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];

/** Whether a checked list is a direction, or the rows of a rotation, before their fourth number. */
function isOrthonormal(value: number[] | number[][]): boolean {
  const rows = (Array.isArray(value[0]) ? value : [value]) as Row[];
  const straight = rows.every((row, i) =>
    rows.slice(0, i + 1).every((other, j) => Math.abs(dot(row, other) - (i === j ? 1 : 0)) <= CROOKED),
  );
  if (!straight || rows.length < 3) return straight;
  const [[a, b, c], [d, e, f], last] = rows as [Row, Row, Row];
  return dot([b * f - c * e, c * d - a * f, a * e - b * d], last) > 0;
}

function faultOfObject(value: JsonObject, schema: Schema, place: string): string | null {
  const properties = schema.properties ?? {};
  const missing = schema.required?.find((key) => !Object.hasOwn(value, key));
  if (missing !== undefined) return joined(place, missing);
  if (schema.additionalProperties === false && !Object.keys(value).every((key) => Object.hasOwn(properties, key))) {
    return place;
  }
  for (const [key, wanted] of Object.entries(properties)) {
    const found = Object.hasOwn(value, key) ? fault(value[key], wanted, joined(place, key)) : null;
    if (found !== null) return found;
  }
  return null;
}

/** The place where a value violates a schema of the format; null for a valid one. */
export const violation = (value: Json | undefined, schema: keyof typeof SCHEMAS, place = ""): string | null =>
  fault(value, SCHEMAS[schema], place);

/** Whether lists and objects are nested at most `depth` deep, and all numbers are finite. */
function isPlain(value: Json, depth: number): boolean {
  if (typeof value === "number") return Number.isFinite(value);
  if (typeof value !== "object" || value === null) return true;
  return depth > 0 && Object.values(value).every((item) => isPlain(item, depth - 1));
}

/** A JSON value of UTF-8; null for anything else, if it is nested too deeply, or has numbers beyond float64. */
export function parsed(bytes: Uint8Array): Json {
  try {
    const value: Json = JSON.parse(new TextDecoder("utf-8", { fatal: true, ignoreBOM: true }).decode(bytes));
    return isPlain(value, LIMITS.depth) ? value : null;
  } catch {
    return null;
  }
}
