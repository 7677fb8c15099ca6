// A decoder of zstandard frames (RFC 8878), the twin of sundae_ns/storage/packing/zstd.py, which says why both have it:
// every bit of a frame must be used, and nothing may follow it.

const LENGTHS = 0;
const OFFSETS = 1;
const MATCHES = 2;
const LONGEST_CODE = 11;
const MOST_LITERALS = 2 ** 17;

export class FrameError extends Error {}

const check = (valid: boolean): void => {
  if (!valid) throw new FrameError("the frame is damaged, or has another size");
};

const highest = (value: number): number => 31 - Math.clz32(value);
const repeated = (value: number, count: number): number[] => new Array<number>(count).fill(value);

/** The smallest value of each code of a sequence, and how many bits follow it. */
function baselines(first: number, bits: number[]): { first: number[]; bits: number[] } {
  let next = first;
  const starts = bits.map((count) => {
    const start = next;
    next += 2 ** count;
    return start;
  });
  return { first: starts, bits };
}

const TAIL = [7, 8, 9, 10, 11, 12, 13, 14, 15, 16];
const LENGTH_VALUES = baselines(0, [...repeated(0, 16), 1, 1, 1, 1, 2, 2, 3, 3, 4, 6, ...TAIL]);
const MATCH_VALUES = baselines(3, [...repeated(0, 32), 1, 1, 1, 1, 2, 2, 3, 3, 4, 4, 5, ...TAIL]);
/** What a kind of code has: most bits of a table, last symbol, and the table where a block states none. */
const KINDS = [
  {
    mostLog: 9,
    last: 35,
    log: 6,
    chances: [4, 3, ...repeated(2, 11), 1, 1, 1, ...repeated(2, 9), 3, 2, ...repeated(1, 5), ...repeated(-1, 4)],
  },
  { mostLog: 8, last: 31, log: 5, chances: [...repeated(1, 6), 2, 2, 2, ...repeated(1, 15), ...repeated(-1, 5)] },
  { mostLog: 9, last: 52, log: 6, chances: [1, 4, 3, ...repeated(2, 6), ...repeated(1, 37), ...repeated(-1, 7)] },
];

/** A decoding table of finite state entropy: symbols, bits and bases of the next state, by state. */
type Table = { log: number; symbols: number[]; bits: number[]; bases: number[] };
/** Symbols and lengths of the Huffman codes that begin with each number of `log` bits. */
type Codes = { log: number; symbols: Uint8Array; lengths: Uint8Array };

/** The `count` bits, at most 16, from `place` on; 0 outside of the bytes. */
function bitsOf(bytes: Uint8Array, place: number, count: number): number {
  const byte = place >> 3;
  const value = (bytes[byte] ?? 0) | ((bytes[byte + 1] ?? 0) << 8) | ((bytes[byte + 2] ?? 0) << 16);
  return (value >> (place & 7)) & ((1 << count) - 1);
}

/** A stream, which is read backwards from the mark at its end. */
class Backwards {
  /** Bits that are left; negative once more were read than there are. */
  left: number;

  constructor(private readonly bytes: Uint8Array) {
    const mark = bytes[bytes.length - 1];
    check(mark !== undefined && mark !== 0);
    this.left = 8 * (bytes.length - 1) + highest(mark!);
  }

  /** The next bits, at most 16, without reading them. */
  peek(count: number): number {
    return bitsOf(this.bytes, this.left - count, count);
  }

  /** The next bits, at most 32. */
  read(count: number): number {
    this.left -= count;
    const low = bitsOf(this.bytes, this.left, Math.min(count, 16));
    return count <= 16 ? low : low + 65536 * bitsOf(this.bytes, this.left + 16, count - 16);
  }
}

/** A table of symbols with these chances; whether they fill it is checked. */
function spread(chances: number[], log: number): Table {
  const size = 1 << log;
  const symbols = repeated(0, size);
  const following = chances.map(Math.abs);
  let rare = size;
  chances.forEach((chance, symbol) => {
    if (chance < 0) symbols[--rare] = symbol;
  });
  let place = 0;
  const step = (size >> 1) + (size >> 3) + 3;
  chances.forEach((chance, symbol) => {
    for (let i = 0; i < chance; i++) {
      symbols[place] = symbol;
      do place = (place + step) & (size - 1);
      while (place >= rare);
    }
  });
  check(place === 0);
  const bits: number[] = [];
  const bases = symbols.map((symbol, i) => {
    const state = following[symbol]!++;
    bits[i] = log - highest(state);
    return (state << bits[i]!) - size;
  });
  return { log, symbols, bits, bases };
}

/** Reads a table of finite state entropy; returns it and the byte behind it. */
function readTable(bytes: Uint8Array, at: number, mostLog: number, last: number): [Table, number] {
  check(at < bytes.length);
  const log = (bytes[at]! & 15) + 5;
  check(log <= mostLog);
  const chances: number[] = [];
  let place = 8 * at + 4;
  let left = 1 << log;
  while (left > 0) {
    check(chances.length <= last);
    // Numbers from 0 to left + 1; the smallest take one bit less.
    let width = highest(left + 1) + 1;
    const short = (1 << width) - 2 - left;
    let value = bitsOf(bytes, place, width);
    const small = value & ((1 << (width - 1)) - 1);
    if (small < short) {
      value = small;
      width--;
    } else if (value !== small) value -= short;
    place += width;
    chances.push(value - 1);
    left -= Math.abs(value - 1);
    while (value === 1) {
      const zeros = bitsOf(bytes, place, 2);
      place += 2;
      chances.push(...repeated(0, zeros));
      if (zeros < 3 || chances.length > last) break;
    }
  }
  const behind = (place + 7) >> 3;
  check(chances.length <= last + 1 && behind <= bytes.length);
  return [spread(chances, log), behind];
}

/** Reads Huffman weights that are coded by finite state entropy. */
function readWeights(bytes: Uint8Array): number[] {
  const [table, at] = readTable(bytes, 0, 6, 15);
  const stream = new Backwards(bytes.subarray(at));
  check(stream.left >= 2 * table.log);
  let state = stream.read(table.log);
  let other = stream.read(table.log);
  const weights: number[] = [];
  // Two states take turns; the bits end in the middle of a turn, and the other state has the last weight.
  while (weights.length < 254) {
    weights.push(table.symbols[state]!);
    const next = table.bases[state]! + stream.read(table.bits[state]!);
    if (stream.left < 0) return [...weights, table.symbols[other]!];
    [state, other] = [other, next];
  }
  throw new FrameError("too many weights");
}

/** Reads the codes of Huffman symbols; returns them and the byte behind them. */
function readCodes(bytes: Uint8Array, at: number): [Codes, number] {
  check(at < bytes.length);
  const head = bytes[at]!;
  const first = at + 1;
  const behind = first + (head < 128 ? head : (head - 126) >> 1);
  check(behind <= bytes.length);
  const weights =
    head < 128
      ? readWeights(bytes.subarray(first, behind))
      : Array.from({ length: head - 127 }, (_, i) => (bytes[first + (i >> 1)]! >> (i % 2 ? 0 : 4)) & 15);
  const total = weights.reduce((sum, weight) => sum + ((1 << weight) >> 1), 0);
  const log = highest(total) + 1;
  const rest = 2 ** log - total;
  // The last weight fills the table.
  weights.push(highest(rest) + 1);
  const ones = weights.filter((weight) => weight === 1).length;
  check(log <= LONGEST_CODE && total > 0 && (rest & (rest - 1)) === 0 && ones >= 2 && ones % 2 === 0);
  const codes = { log, symbols: new Uint8Array(1 << log), lengths: new Uint8Array(1 << log) };
  let place = 0;
  for (let weight = 1; weight <= log; weight++) {
    weights.forEach((found, symbol) => {
      if (found !== weight) return;
      const stop = place + (1 << (weight - 1));
      codes.symbols.fill(symbol, place, stop);
      codes.lengths.fill(log + 1 - weight, place, stop);
      place = stop;
    });
  }
  return [codes, behind];
}

/** Fills `out` with the Huffman symbols of one stream. */
function readStream(bytes: Uint8Array, { log, symbols, lengths }: Codes, out: Uint8Array): void {
  const stream = new Backwards(bytes);
  for (let i = 0; i < out.length; i++) {
    check(stream.left > 0);
    const index = stream.peek(log);
    out[i] = symbols[index]!;
    stream.left -= lengths[index]!;
  }
  check(stream.left === 0);
}

/** A frame that is decoded: its content so far, and what a block may use of those before. */
class Frame {
  private done = 0;
  private codes: Codes | null = null;
  private readonly tables: (Table | null)[] = [null, null, null];
  private readonly recent = [1, 4, 8];

  constructor(private readonly out: Uint8Array) {}

  /** Decodes the blocks, which are all of `bytes`. */
  decode(bytes: Uint8Array): void {
    let at = 0;
    let last = false;
    while (!last) {
      check(at + 3 <= bytes.length);
      const head = bytes[at]! | (bytes[at + 1]! << 8) | (bytes[at + 2]! << 16);
      const [kind, length] = [(head >> 1) & 3, head >> 3];
      last = (head & 1) === 1;
      at += 3;
      const end = at + (kind === 1 ? 1 : length);
      check(kind !== 3 && end <= bytes.length);
      if (kind === 2) this.block(bytes.subarray(at, end));
      else {
        check(length <= this.out.length - this.done);
        if (kind === 1) this.out.fill(bytes[at]!, this.done, this.done + length);
        else this.out.set(bytes.subarray(at, end), this.done);
        this.done += length;
      }
      at = end;
    }
    check(at === bytes.length && this.done === this.out.length);
  }

  /** Reads the literals of a block; returns them and the byte behind them. */
  private literals(bytes: Uint8Array): [Uint8Array, number] {
    check(bytes.length > 0);
    const [kind, form] = [bytes[0]! & 3, (bytes[0]! >> 2) & 3];
    const width = (kind < 2 ? [1, 2, 1, 3] : [3, 3, 4, 5])[form]!;
    check(width <= bytes.length);
    let head = 0;
    for (let k = width - 1; k >= 0; k--) head = 256 * head + bytes[k]!;
    const space = Math.min(this.out.length - this.done, MOST_LITERALS);
    if (kind < 2) {
      const count = head >> (width === 1 ? 3 : 4);
      const stop = width + (kind === 0 ? count : 1);
      check(stop <= bytes.length && count <= space);
      return [kind === 0 ? bytes.subarray(width, stop) : new Uint8Array(count).fill(bytes[width]!), stop];
    }
    const range = 2 ** [10, 10, 14, 18][form]!;
    const count = Math.floor(head / 16) % range;
    const stop = width + Math.floor(head / 16 / range);
    check(stop <= bytes.length && count <= space);
    const stored = bytes.subarray(0, stop);
    let at = width;
    if (kind === 2) [this.codes, at] = readCodes(stored, at);
    const { codes } = this;
    check(codes !== null);
    const out = new Uint8Array(count);
    if (form === 0) readStream(stored.subarray(at), codes!, out);
    else {
      check(count >= 6 && at + 6 <= stop);
      const quarter = (count + 3) >> 2;
      let start = at + 6;
      for (let k = 0; k < 4; k++) {
        const behind = k === 3 ? stop : start + stored[at + 2 * k]! + (stored[at + 2 * k + 1]! << 8);
        check(behind <= stop);
        const part = k === 3 ? out.subarray(3 * quarter) : out.subarray(k * quarter, (k + 1) * quarter);
        readStream(stored.subarray(start, behind), codes!, part);
        start = behind;
      }
    }
    return [out, stop];
  }

  /** Reads the tables of a block's sequences; returns the byte behind them. */
  private readTables(bytes: Uint8Array, first: number): number {
    check(first < bytes.length && (bytes[first]! & 3) === 0);
    let at = first + 1;
    KINDS.forEach(({ mostLog, last, log, chances }, kind) => {
      const mode = (bytes[first]! >> (6 - 2 * kind)) & 3;
      if (mode === 0) this.tables[kind] = spread(chances, log);
      else if (mode === 1) {
        check(at < bytes.length && bytes[at]! <= last);
        this.tables[kind] = { log: 0, symbols: [bytes[at]!], bits: [0], bases: [0] };
        at++;
      } else if (mode === 2) [this.tables[kind], at] = readTable(bytes, at, mostLog, last);
      check(this.tables[kind] !== null);
    });
    return at;
  }

  /** The offset of a match; values up to 3 name a recent one, the next if no literals come before. 0 is invalid. */
  private offset(value: number, short: boolean): number {
    const { recent } = this;
    const kept = value > 3 ? 2 : value - 1 + Number(short);
    const found = value > 3 ? value - 3 : kept < 3 ? recent[kept]! : recent[0]! - 1;
    for (let k = Math.min(kept, 2); k > 0; k--) recent[k] = recent[k - 1]!;
    recent[0] = found;
    return found;
  }

  private block(bytes: Uint8Array): void {
    const { out } = this;
    const [literals, behind] = this.literals(bytes);
    let at = behind + 1;
    check(behind < bytes.length);
    let count = bytes[behind]!;
    if (count >= 128) {
      const wide = count === 255 ? 2 : 1;
      check(at + wide <= bytes.length);
      count = wide === 2 ? bytes[at]! + (bytes[at + 1]! << 8) + 0x7f00 : ((count - 128) << 8) + bytes[at]!;
      at += wide;
    }
    let used = 0;
    if (count > 0) {
      at = this.readTables(bytes, at);
      const stream = new Backwards(bytes.subarray(at));
      const tables = this.tables as Table[];
      const states = tables.map(({ log }) => stream.read(log));
      check(stream.left >= 0);
      const symbol = (kind: number): number => tables[kind]!.symbols[states[kind]!]!;
      for (let i = 0; i < count; i++) {
        const code = symbol(OFFSETS);
        const value = 2 ** code + stream.read(code);
        const match = MATCH_VALUES.first[symbol(MATCHES)]! + stream.read(MATCH_VALUES.bits[symbol(MATCHES)]!);
        const length = LENGTH_VALUES.first[symbol(LENGTHS)]! + stream.read(LENGTH_VALUES.bits[symbol(LENGTHS)]!);
        const offset = this.offset(value, length === 0);
        check(stream.left >= 0 && length <= literals.length - used && length + match <= out.length - this.done);
        out.set(literals.subarray(used, used + length), this.done);
        used += length;
        this.done += length;
        check(offset >= 1 && offset <= this.done);
        for (const end = this.done + match; this.done < end; this.done++) out[this.done] = out[this.done - offset]!;
        if (i === count - 1) break;
        for (const kind of [LENGTHS, MATCHES, OFFSETS]) {
          const { bits, bases } = tables[kind]!;
          states[kind] = bases[states[kind]!]! + stream.read(bits[states[kind]!]!);
        }
      }
      check(stream.left === 0);
      at = bytes.length;
    }
    const rest = literals.subarray(used);
    check(at === bytes.length && rest.length <= out.length - this.done);
    out.set(rest, this.done);
    this.done += rest.length;
  }
}

/** The content of a frame, which must have `size` bytes; throws a FrameError for another or a damaged one. */
export function decompress(frame: Uint8Array, size: number): Uint8Array {
  const at = firstBlock(frame, size);
  check(at >= 0);
  const out = new Uint8Array(size);
  new Frame(out).decode(frame.subarray(at));
  return out;
}

/** Where the blocks of a frame begin that states `size`; -1 for another frame. */
function firstBlock(frame: Uint8Array, size: number): number {
  if (![0x28, 0xb5, 0x2f, 0xfd].every((byte, i) => frame[i] === byte) || frame.length < 5 || frame[4]! & 0x1f)
    return -1;
  const [single, kind] = [(frame[4]! >> 5) & 1, frame[4]! >> 6];
  const at = 6 - single;
  const width = [single, 2, 4, 8][kind]!;
  let stated = 0;
  for (let k = width - 1; k >= 0; k--) stated = 256 * stated + (frame[at + k] ?? 0);
  if (width === 2) stated += 256;
  return width > 0 && at + width <= frame.length && stated === size ? at + width : -1;
}
