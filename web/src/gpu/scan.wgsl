// Sums over the 256 threads of a workgroup.

const THREADS = 256u;
const ROW = 16u;

var<workgroup> sums: array<u32, 256>;
var<workgroup> row_sums: array<u32, 16>;

// Sums of one number of each thread: those of the threads before it, and of all. The caller needs a barrier before the next.
fn sums_before(thread: u32, value: u32) -> vec2u {
  sums[thread] = value;
  workgroupBarrier();
  if (thread % ROW == 0u) {
    var total = 0u;
    for (var i = 0u; i < ROW; i++) {
      total += sums[thread + i];
    }
    row_sums[thread / ROW] = total;
  }
  workgroupBarrier();
  let row = thread / ROW;
  var result = vec2u(0u);
  for (var i = 0u; i < ROW; i++) {
    let total = row_sums[i];
    result += vec2u(select(0u, total, i < row), total);
  }
  for (var i = row * ROW; i < thread; i++) {
    result.x += sums[i];
  }
  return result;
}
