// One pass of a stable radix sort of keys with values, by a digit of eight bits.
//
// A workgroup takes BLOCK keys in rounds of 256. `count` counts its digits, `scan` sums the counts of each digit over the
// workgroups, and `scatter` moves keys and values to their places.

struct Length {
  count: u32,
}

@group(0) @binding(0) var<storage, read> length_of: Length;
@group(0) @binding(1) var<storage, read> keys: array<u32>;
@group(0) @binding(2) var<storage, read> values: array<u32>;
// [workgroups, 256], and then the total of each digit [256].
@group(0) @binding(3) var<storage, read_write> counts: array<u32>;
@group(0) @binding(4) var<storage, read_write> sorted_keys: array<u32>;
@group(0) @binding(5) var<storage, read_write> sorted_values: array<u32>;

@group(0) @binding(6) var<uniform> shift: u32;

const ROUNDS = 8u;
const BLOCK = THREADS * ROUNDS;

var<workgroup> digits: array<atomic<u32>, 256>;
// One bit for each thread and digit.
var<workgroup> members: array<array<atomic<u32>, 8>, 256>;

fn num_blocks() -> u32 {
  return (length_of.count + BLOCK - 1u) / BLOCK;
}

fn num_rounds(block: u32) -> u32 {
  return min((length_of.count - block * BLOCK + THREADS - 1u) / THREADS, ROUNDS);
}

fn digit_of(key: u32) -> u32 {
  return (key >> shift) & 255u;
}

@compute @workgroup_size(256)
fn count(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) thread: u32) {
  let block = group.x;
  atomicStore(&digits[thread], 0u);
  workgroupBarrier();
  for (var round = 0u; round < num_rounds(block); round++) {
    let i = block * BLOCK + round * THREADS + thread;
    if (i < length_of.count) {
      atomicAdd(&digits[digit_of(keys[i])], 1u);
    }
  }
  workgroupBarrier();
  counts[block * 256u + thread] = atomicLoad(&digits[thread]);
}

// One thread sums one digit; neighbouring threads read neighbouring numbers.
@compute @workgroup_size(64)
fn scan(@builtin(global_invocation_id) place: vec3u) {
  let blocks = num_blocks();
  var total = 0u;
  for (var block = 0u; block < blocks; block++) {
    let at = block * 256u + place.x;
    let value = counts[at];
    counts[at] = total;
    total += value;
  }
  counts[blocks * 256u + place.x] = total;
}

@compute @workgroup_size(256)
fn scatter(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) thread: u32) {
  let block = group.x;
  let blocks = num_blocks();
  // Place of the next key of each digit.
  let first = sums_before(thread, counts[blocks * 256u + thread]).x;
  atomicStore(&digits[thread], first + counts[block * 256u + thread]);
  let word = thread / 32u;
  let bit = 1u << (thread % 32u);
  for (var round = 0u; round < num_rounds(block); round++) {
    for (var k = 0u; k < 8u; k++) {
      atomicStore(&members[thread][k], 0u);
    }
    workgroupBarrier();
    let i = block * BLOCK + round * THREADS + thread;
    let exists = i < length_of.count;
    var key = 0u;
    if (exists) {
      key = keys[i];
      atomicOr(&members[digit_of(key)][word], bit);
    }
    let digit = digit_of(key);
    workgroupBarrier();
    if (exists) {
      var place = atomicLoad(&digits[digit]) + countOneBits(atomicLoad(&members[digit][word]) & (bit - 1u));
      for (var k = 0u; k < word; k++) {
        place += countOneBits(atomicLoad(&members[digit][k]));
      }
      sorted_keys[place] = key;
      sorted_values[place] = values[i];
    }
    workgroupBarrier();
    var added = 0u;
    for (var k = 0u; k < 8u; k++) {
      added += countOneBits(atomicLoad(&members[thread][k]));
    }
    atomicAdd(&digits[thread], added);
    // Thread `thread` alone clears its own row next, so only the sums need a barrier, which the next round has.
  }
}
