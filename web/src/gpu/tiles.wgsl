// Depth-ordered lists of the primitives of each tile: pairs of a tile and a primitive, made in order of depth and then
// sorted by tile.

struct Pairs {
  count: u32,
  // Pairs that the view needs, which may be more than the buffers hold; the largest number stands for any larger one.
  wanted: u32,
}

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> splats: array<Splat>;
@group(0) @binding(2) var<storage, read> order: array<u32>;
@group(0) @binding(3) var<storage, read_write> block_sums: array<u32>;
@group(0) @binding(4) var<storage, read_write> pairs: Pairs;
@group(0) @binding(5) var<storage, read_write> blocks: array<u32>;
@group(0) @binding(6) var<storage, read_write> pair_tiles: array<u32>;
@group(0) @binding(7) var<storage, read_write> pair_ids: array<u32>;
// The first place of each rank among those of its block.
@group(0) @binding(8) var<storage, read_write> starts: array<u32>;
@group(1) @binding(0) var<storage, read_write> ranges: array<vec2u>;

const SORT_BLOCK = 2048u;
// Pairs that a thread makes.
const RUN = SORT_BLOCK / THREADS;

fn corners(splat: Splat) -> vec4u {
  return vec4u(splat.low & 0xffffu, splat.low >> 16u, splat.high & 0xffffu, splat.high >> 16u);
}

fn num_tiles(rank: u32) -> u32 {
  if (rank >= view.count) {
    return 0u;
  }
  let box = corners(splats[order[rank]]);
  return (box.z - box.x) * (box.w - box.y);
}

// The number of pairs of each block of 256 ranks, and the places of its ranks.
@compute @workgroup_size(256)
fn measure(@builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u,
           @builtin(local_invocation_index) thread: u32) {
  let block = group.x + group.y * groups.x;
  let rank = block * THREADS + thread;
  let sums = sums_before(thread, num_tiles(rank));
  if (rank >= view.count) {
    return;
  }
  starts[rank] = sums.x;
  if (thread == 0u) {
    // One less than a block can have, so that sums of 256 blocks do not overflow.
    block_sums[block] = min(sums.y, 0xffffffu);
  }
}

// The first place of each block, by one workgroup; and how much the sort by tile has to do.
@compute @workgroup_size(256)
fn place(@builtin(local_invocation_index) thread: u32) {
  let count = (view.count + THREADS - 1u) / THREADS;
  var total = 0u;
  for (var start = 0u; start < count; start += THREADS) {
    var value = 0u;
    if (start + thread < count) {
      value = block_sums[start + thread];
    }
    let before = sums_before(thread, value);
    if (start + thread < count) {
      block_sums[start + thread] = total + before.x;
    }
    total = select(total + before.y, 0xffffffffu, total + before.y < total);
    workgroupBarrier();
  }
  if (thread == 0u) {
    pairs.wanted = total;
    // Of a view with too many nothing is drawn.
    pairs.count = select(min(total, view.capacity), 0u, total > view.most);
    blocks[0] = (pairs.count + SORT_BLOCK - 1u) / SORT_BLOCK;
    blocks[1] = 1u;
    blocks[2] = 1u;
    let ranged = (pairs.count + THREADS - 1u) / THREADS;
    blocks[3] = min(ranged, 32768u);
    blocks[4] = (ranged + 32767u) / 32768u;
    blocks[5] = 1u;
  }
}

fn start_of(rank: u32) -> u32 {
  return block_sums[rank / THREADS] + starts[rank];
}

// Threads share the pairs, not the primitives: one may cover all tiles, and the frame would wait for its thread.
@compute @workgroup_size(256)
fn emit(@builtin(global_invocation_id) thread: vec3u) {
  var slot = thread.x * RUN;
  let end = min(slot + RUN, pairs.count);
  // The last rank that starts at the first pair or before it.
  var rank = 0u;
  var after = view.count;
  while (after - rank > 1u) {
    let middle = (rank + after) / 2u;
    if (start_of(middle) <= slot) {
      rank = middle;
    } else {
      after = middle;
    }
  }
  for (; slot < end; rank++) {
    let id = order[rank];
    let box = corners(splats[id]);
    let width = box.z - box.x;
    let start = start_of(rank);
    let stop = min(start + num_tiles(rank), end);
    for (; slot < stop; slot++) {
      let place = slot - start;
      pair_tiles[slot] = (box.y + place / width) * view.tiles.x + box.x + place % width;
      pair_ids[slot] = id;
    }
  }
}

// Where the list of each tile begins and ends; the buffer starts as zeros.
@compute @workgroup_size(256)
fn find_ranges(@builtin(global_invocation_id) thread: vec3u) {
  let i = thread.x + thread.y * 32768u * THREADS;
  if (i >= pairs.count) {
    return;
  }
  let tile = pair_tiles[i];
  if (i == 0u || pair_tiles[i - 1u] != tile) {
    ranges[tile].x = i;
  }
  if (i + 1u == pairs.count || pair_tiles[i + 1u] != tile) {
    ranges[tile].y = i + 1u;
  }
}
