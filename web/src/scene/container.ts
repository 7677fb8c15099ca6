// The container of docs/formats.md: named arrays behind a JSON header, all bytes under checksums.
// Its twin is sundae_ns/io/pack/container.py; both refuse the same files.

import { type JsonObject, LIMITS, parsed, violation } from "./schema";

export class PackError extends Error {}

const MAGIC = [0x89, 0x53, 0x55, 0x4e, 0x44, 0x41, 0x45, 0x0a];
const PREAMBLE = 48;
const PADDING = "padding";

/** A section as the header states it. */
type Stated = { name: string; dtype: string; shape: number[]; parts: number[]; sha256: string };
/** A section with its first byte in the file. */
type Section = Stated & { offset: number };

/** One section: its bytes, little-endian, with the dtype and the shape that the header states. */
export type Stored = { dtype: string; shape: number[]; bytes: ArrayBuffer };

export type Header = {
  meta: JsonObject;
  sections: Map<string, Section>;
};

export const damaged = (reason: string): PackError =>
  new PackError(`The file is not a whole packed scene (${reason}); get it again, or pack it again.`);

const sha256 = async (bytes: Uint8Array<ArrayBuffer>): Promise<string> => {
  if (!globalThis.crypto?.subtle) {
    throw new PackError("The browser checks files only in a secure page; open it from disk, or over https.");
  }
  const digest = new Uint8Array(await crypto.subtle.digest("SHA-256", bytes));
  return [...digest].map((byte) => byte.toString(16).padStart(2, "0")).join("");
};

const itemSize = (section: Section): number => Number(section.dtype[2]);
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
  if (version !== LIMITS.version) {
    throw new PackError(
      `The file has version ${version} of the format, this page reads ${LIMITS.version}; pack the run again.`,
    );
  }
  const length = preamble.getUint32(12, true);
  if (length > Math.min(LIMITS.header, file.length - PREAMBLE)) throw damaged("it ends in its header");
  const text = file.subarray(PREAMBLE, PREAMBLE + length);
  const stated = [...file.subarray(16, 48)].map((byte) => byte.toString(16).padStart(2, "0")).join("");
  if ((await sha256(text)) !== stated) throw damaged("the checksum of its header is wrong");
  const meta = parsed(text);
  if (meta === null) throw damaged("its header is not JSON");
  const wrong = violation(meta, "container");
  if (wrong !== null) throw damaged(`its header has no valid ${wrong}`);
  const { sections } = meta as { sections: Stated[] };
  return { meta: meta as JsonObject, sections: readSections(sections, PREAMBLE + length, file.length) };
}

function readSections(entries: Stated[], start: number, size: number): Map<string, Section> {
  const sections = new Map<string, Section>();
  let offset = start;
  let total = 0;
  for (const entry of entries) {
    const section = { ...entry, offset };
    const [bytes, planes] = [sizeOf(section), planesOf(section)];
    const { name, parts } = section;
    if (parts.length !== (bytes ? planes : 0) || parts.some((part) => part > bytes / planes)) {
      throw damaged(`its header states impossible parts of ${name}`);
    }
    sections.set(name, section);
    offset += sum(parts);
    total += bytes;
  }
  if (offset !== size) throw damaged(`its header states ${offset} bytes, it has ${size}`);
  checkRatio(total, size);
  return sections;
}

/** Refuses a file of `size` bytes that unpacks to far more. */
export function checkRatio(unpacked: number, size: number): void {
  if (!(unpacked <= LIMITS.spare + LIMITS.ratio * size)) throw damaged(`${size} bytes would unpack to ${unpacked}`);
}

/** Reads all sections except padding, after their checksums. */
export async function readAll(file: Uint8Array<ArrayBuffer>, header: Header): Promise<Map<string, Stored>> {
  for (const section of header.sections.values()) {
    const stored = file.subarray(section.offset, section.offset + sum(section.parts));
    if ((await sha256(stored)) !== section.sha256) throw damaged(`the checksum of ${section.name} is wrong`);
  }
  const arrays = new Map<string, Stored>();
  for (const section of header.sections.values()) {
    if (section.name !== PADDING) arrays.set(section.name, await join(file, section));
  }
  return arrays;
}

/** Joins the planes of a section: one for each index of the first dimension and each byte of a number. */
async function join(file: Uint8Array<ArrayBuffer>, section: Section): Promise<Stored> {
  const { dtype, shape } = section;
  const out = new Uint8Array(sizeOf(section));
  const item = itemSize(section);
  const length = out.length / Math.max(planesOf(section), 1);
  let start = section.offset;
  for (const [index, part] of section.parts.entries()) {
    const plane = await inflated(file.subarray(start, start + part), length);
    start += part;
    const first = Math.floor(index / item) * length * item + (index % item);
    if (item === 1) out.set(plane, first);
    else for (let i = 0; i < length; i++) out[first + i * item] = plane[i]!;
  }
  return { dtype, shape, bytes: out.buffer };
}

/** A plane of `size` bytes: stored, or a raw deflate stream that ends with it. */
async function inflated(part: Uint8Array<ArrayBuffer>, size: number): Promise<Uint8Array> {
  if (part.length === size) return part;
  const plane = new Uint8Array(size);
  const reader = new Blob([part]).stream().pipeThrough(new DecompressionStream("deflate-raw")).getReader();
  let length = 0;
  try {
    for (let next = await reader.read(); !next.done; next = await reader.read()) {
      plane.set(next.value, length); // throws where a stream holds more
      length += next.value.length;
    }
  } catch {
    await reader.cancel().catch(() => {});
    length = -1;
  }
  if (length !== size) throw damaged("a section cannot be decompressed");
  return plane;
}
