// The container of docs/formats.md: named arrays behind a JSON header, all bytes under checksums.
// Its twin is sundae_ns/storage/packing/container.py; both refuse the same files.

import { decompress } from "fzstd";

export class PackError extends Error {}

export type Json = null | boolean | number | string | Json[] | { [key: string]: Json };
export type JsonObject = { [key: string]: Json };

const MAGIC = [0x89, 0x53, 0x55, 0x4e, 0x44, 0x41, 0x45, 0x0a];
const VERSION = 2;
const PREAMBLE = 48;
const MAX_HEADER = 4 << 20;
const SPARE = 8 << 20;
const MAX_RATIO = 32;
const PADDING = "padding";
const ITEM_SIZES = new Map([
  ["|u1", 1],
  ["<u2", 2],
  ["<u4", 4],
  ["<u8", 8],
  ["|i1", 1],
  ["<i2", 2],
  ["<f2", 2],
  ["<f4", 4],
  ["<f8", 8],
]);

type Section = {
  name: string;
  dtype: string;
  shape: number[];
  parts: number[];
  sha256: string;
  /** First byte in the file. */
  offset: number;
};

/** One section: its bytes, little-endian, with the dtype and the shape that the header states. */
export type Stored = { dtype: string; shape: number[]; bytes: ArrayBuffer };

export type Header = {
  meta: JsonObject;
  sections: Map<string, Section>;
};

export const damaged = (reason: string): PackError =>
  new PackError(`The file is not a whole packed scene (${reason}); get it again, or pack it again.`);

export const isObject = (value: Json | undefined): value is JsonObject =>
  typeof value === "object" && value !== null && !Array.isArray(value);

const sha256 = async (bytes: Uint8Array<ArrayBuffer>): Promise<string> => {
  if (!globalThis.crypto?.subtle) {
    throw new PackError("The browser checks files only in a secure page; open it from disk, or over https.");
  }
  const digest = new Uint8Array(await crypto.subtle.digest("SHA-256", bytes));
  return [...digest].map((byte) => byte.toString(16).padStart(2, "0")).join("");
};

const itemSize = (section: Section): number => ITEM_SIZES.get(section.dtype)!;
const rowsOf = (shape: number[]): number => (shape.length > 1 ? shape[0]! : 1);
const countOf = (shape: number[]): number => shape.reduce((product, side) => product * side, 1);
const sizeOf = (section: Section): number => countOf(section.shape) * itemSize(section);
const planesOf = (section: Section): number => rowsOf(section.shape) * itemSize(section);
const sum = (values: number[]): number => values.reduce((total, value) => total + value, 0);

/** Reads and checks the header, without the sections. */
export async function readHeader(file: Uint8Array<ArrayBuffer>): Promise<Header> {
  if (MAGIC.some((byte, i) => file[i] !== byte)) {
    throw new PackError("The file is not a packed scene; give a file that sundae pack wrote.");
  }
  if (file.length < PREAMBLE) throw damaged("it ends before its header");
  const preamble = new DataView(file.buffer, file.byteOffset, PREAMBLE);
  const version = preamble.getUint32(8, true);
  if (version !== VERSION) {
    throw new PackError(`The file has version ${version} of the format, this page reads ${VERSION}; export it again.`);
  }
  const length = preamble.getUint32(12, true);
  if (length > Math.min(MAX_HEADER, file.length - PREAMBLE)) throw damaged("it ends in its header");
  const text = file.subarray(PREAMBLE, PREAMBLE + length);
  const stated = [...file.subarray(16, 48)].map((byte) => byte.toString(16).padStart(2, "0")).join("");
  if ((await sha256(text)) !== stated) throw damaged("the checksum of its header is wrong");
  let meta: Json;
  try {
    meta = JSON.parse(new TextDecoder("utf-8", { fatal: true }).decode(text));
  } catch {
    throw damaged("its header is not JSON");
  }
  if (!isObject(meta) || !Array.isArray(meta.sections)) throw damaged("its header lists no sections");
  return { meta, sections: readSections(meta.sections, PREAMBLE + length, file.length) };
}

function readSections(entries: Json[], start: number, size: number): Map<string, Section> {
  const sections = new Map<string, Section>();
  let offset = start;
  let total = 0;
  for (const entry of entries) {
    const section = readSection(entry, offset);
    if (section === null || sections.has(section.name)) throw damaged("its header describes an invalid section");
    sections.set(section.name, section);
    offset += sum(section.parts);
    total += sizeOf(section);
  }
  if (offset !== size) throw damaged(`its header states ${offset} bytes, it has ${size}`);
  checkRatio(total, size);
  return sections;
}

/** Refuses a file of `size` bytes that unpacks to far more. */
export function checkRatio(unpacked: number, size: number): void {
  if (!(unpacked <= SPARE + MAX_RATIO * size)) throw damaged(`${size} bytes would unpack to ${unpacked}`);
}

const isCount = (value: Json): value is number =>
  Number.isInteger(value) && 0 <= Number(value) && Number(value) < 2 ** 28;

function readSection(entry: Json, offset: number): Section | null {
  if (!isObject(entry)) return null;
  const { name, dtype, shape, parts, sha256 } = entry;
  if (typeof name !== "string" || typeof dtype !== "string" || typeof sha256 !== "string") return null;
  if (!Array.isArray(shape) || !Array.isArray(parts) || !ITEM_SIZES.has(dtype)) return null;
  if (shape.length < 1 || shape.length > 3 || !shape.every(isCount) || !parts.every(isCount)) return null;
  const section: Section = { name, dtype, shape, parts, sha256, offset };
  const empty = sizeOf(section) === 0;
  if (parts.length !== (empty ? 0 : planesOf(section))) return null;
  const longest = sizeOf(section) / planesOf(section);
  return !empty && parts.some((part) => part > longest) ? null : section;
}

/** Reads all sections except padding, after their checksums. */
export async function readAll(file: Uint8Array<ArrayBuffer>, header: Header): Promise<Map<string, Stored>> {
  for (const section of header.sections.values()) {
    const stored = file.subarray(section.offset, section.offset + sum(section.parts));
    if ((await sha256(stored)) !== section.sha256) throw damaged(`the checksum of ${section.name} is wrong`);
  }
  const wanted = [...header.sections.values()].filter((section) => section.name !== PADDING);
  return new Map(wanted.map((section) => [section.name, join(file, section)]));
}

/** Joins the planes of a section: one for each index of the first dimension and each byte of a number. */
function join(file: Uint8Array, section: Section): Stored {
  const { dtype, shape } = section;
  const out = new Uint8Array(sizeOf(section));
  const item = itemSize(section);
  const length = out.length / Math.max(planesOf(section), 1);
  let start = section.offset;
  section.parts.forEach((part, index) => {
    const plane = unpack(file.subarray(start, start + part), length);
    start += part;
    const first = Math.floor(index / item) * length * item + (index % item);
    if (item === 1) out.set(plane, first);
    else for (let i = 0; i < length; i++) out[first + i * item] = plane[i]!;
  });
  return { dtype, shape, bytes: out.buffer };
}

/** Decompresses a plane of `size` bytes; a frame that states another size is refused. */
function unpack(part: Uint8Array, size: number): Uint8Array {
  if (part.length === size) return part;
  if (contentSize(part) !== size) throw damaged("a section does not unpack to the size that the header states");
  try {
    const plane = decompress(part, new Uint8Array(size));
    if (plane.length === size) return plane;
  } catch {
    // The reason of the decoder says no more than the message below.
  }
  throw damaged("a section cannot be decompressed");
}

/** The size that a zstandard frame states (RFC 8878, section 3.1.1.1); -1 for none. */
function contentSize(frame: Uint8Array): number {
  const bytes = new DataView(frame.buffer, frame.byteOffset, frame.byteLength);
  if (frame.length < 6 || bytes.getUint32(0, true) !== 0xfd2fb528) return -1;
  const descriptor = frame[4]!;
  const single = (descriptor >> 5) & 1;
  const kind = descriptor >> 6;
  const at = 5 + (single ? 0 : 1) + [0, 1, 2, 4][descriptor & 3]!;
  const width = kind === 0 ? single : 1 << kind;
  if (width === 0 || at + width > frame.length) return -1;
  if (width === 1) return frame[at]!;
  if (width === 2) return bytes.getUint16(at, true) + 256;
  return width === 4 ? bytes.getUint32(at, true) : Number(bytes.getBigUint64(at, true));
}
