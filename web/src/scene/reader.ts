// Sections of a file; each is checked before use.

import { type Header, PackError, type Stored } from "./container";
import { SECTIONS, type SectionFormat } from "./schema";

export type Numbers =
  | Uint8Array<ArrayBuffer>
  | Uint32Array<ArrayBuffer>
  | Int8Array<ArrayBuffer>
  | Float32Array<ArrayBuffer>
  | Float64Array<ArrayBuffer>;

/** Arrays of the dtypes that a scene uses. */
const ARRAYS: Record<string, new (bytes: ArrayBuffer) => Numbers> = {
  "|u1": Uint8Array,
  "<u4": Uint32Array,
  "|i1": Int8Array,
  "<f4": Float32Array,
  "<f8": Float64Array,
};

/** What the header states of an attribute; each has what its codec needs. */
type Attribute = {
  codec: string;
  step: number;
  width: number;
  bits: number;
  block: number;
  weights: number;
  tensors: [string, number[]][];
};

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

  /** The header's entry of an attribute. */
  about(attribute: string): Attribute {
    const entry = (this.header.meta.attributes as Record<string, Attribute>)[attribute];
    if (entry === undefined) throw this.refuse(`its header has no valid attributes.${attribute}`);
    return entry;
  }

  /** A section in the dtype, shape and range that the format states; `lengths` are sides that it names. */
  array(attribute: string, part: string, lengths: Record<string, number> = {}): Numbers {
    const codec = attribute === "cameras" ? attribute : this.about(attribute).codec;
    const format = SECTIONS[codec]![part]!;
    const sides = format.shape.map((side) => (typeof side === "string" ? lengths[side]! : side));
    const name = `${attribute}/${part}`;
    const found = this.stored.get(name);
    const fits = found !== undefined && found.dtype === format.dtype && found.shape.length === sides.length;
    if (!fits || sides.some((side, i) => side !== null && side !== found.shape[i])) {
      throw this.refuse(`${name} is missing or has another shape`);
    }
    const array = new ARRAYS[found.dtype]!(found.bytes);
    if (!inRange(array, format)) throw this.refuse(`${name} has values that are not finite or out of range`);
    return array;
  }
}

function inRange(array: Numbers, { minimum = -Infinity, maximum = Infinity }: SectionFormat): boolean {
  const [lowest, highest] = [[minimum].flat(), [maximum].flat()];
  return array.every(
    (value, i) =>
      Number.isFinite(value) && lowest[i % lowest.length]! <= value && value <= highest[i % highest.length]!,
  );
}
