// The layers of the compensation head (sundae_ns/head/unet.py). Images are [C / 4, H, W] of four channels in
// `number`, which is f16 or f32; sums of a convolution are f32.

struct Layer {
  // Width and height of the output.
  size: vec2u,
  // Where the images begin in their buffers.
  from_offset: u32,
  to_offset: u32,
  // Groups of four channels of the input of a convolution.
  inputs: u32,
}

@group(0) @binding(0) var<uniform> layer: Layer;
@group(0) @binding(1) var<storage, read> image: array<vec4<number>>;
@group(0) @binding(2) var<storage, read_write> result: array<vec4<number>>;
// [outputs / 4, inputs / 4, side * side]; a column for each input channel.
@group(0) @binding(3) var<storage, read> weights: array<mat4x4<number>>;
@group(0) @binding(4) var<storage, read> bias: array<vec4f>;

const SLOPE = 0.1;
// A thread computes this many pixels of a row, in two groups of channels.
const RUN = 4u;
const CHUNK = 4u;

var<workgroup> kernel: array<mat4x4<number>, 72>;

fn store(at: u32, value: vec4f) {
  // In f16, larger activations would become infinite, and NaN in the next layer.
  result[layer.to_offset + at] = vec4<number>(clamp(value, vec4f(-LARGEST), vec4f(LARGEST)));
}

// A pixel of a row of the input, zero outside.
fn pixel_of(row: u32, column: u32) -> vec4<number> {
  if (column >= layer.size.x) {
    return vec4<number>();
  }
  return image[row + column];
}

fn keep(group: u32, y: u32, column: u32, value: vec4f) {
  if (column < layer.size.x) {
    store((group * layer.size.y + y) * layer.size.x + column, max(value, SLOPE * value));
  }
}

@compute @workgroup_size(8, 8)
fn convolve(@builtin(global_invocation_id) place: vec3u, @builtin(local_invocation_index) thread: u32) {
  let width = layer.size.x;
  let height = layer.size.y;
  let left = place.x * RUN;
  let y = place.y;
  let first = place.z * 2u;
  // Written out, because arrays with an index in memory are slow.
  var a0 = bias[first];
  var a1 = a0;
  var a2 = a0;
  var a3 = a0;
  var b0 = bias[first + 1u];
  var b1 = b0;
  var b2 = b0;
  var b3 = b0;
  for (var start = 0u; start < layer.inputs; start += CHUNK) {
    let groups = min(CHUNK, layer.inputs - start);
    workgroupBarrier();
    for (var k = thread; k < 2u * groups * 9u; k += 64u) {
      let g = k / (groups * 9u);
      let rest = k - g * groups * 9u;
      kernel[g * CHUNK * 9u + rest] = weights[((first + g) * layer.inputs + start) * 9u + rest];
    }
    workgroupBarrier();
    for (var k = 0u; k < groups * 3u; k++) {
      let row = y + k % 3u - 1u;
      if (row >= height) {
        continue;
      }
      let at = layer.from_offset + ((start + k / 3u) * height + row) * width;
      let x0 = pixel_of(at, left - 1u);
      let x1 = pixel_of(at, left);
      let x2 = pixel_of(at, left + 1u);
      let x3 = pixel_of(at, left + 2u);
      let x4 = pixel_of(at, left + 3u);
      let x5 = pixel_of(at, left + 4u);
      var w0 = kernel[3u * k];
      var w1 = kernel[3u * k + 1u];
      var w2 = kernel[3u * k + 2u];
      a0 += vec4f(w0 * x0 + w1 * x1 + w2 * x2);
      a1 += vec4f(w0 * x1 + w1 * x2 + w2 * x3);
      a2 += vec4f(w0 * x2 + w1 * x3 + w2 * x4);
      a3 += vec4f(w0 * x3 + w1 * x4 + w2 * x5);
      w0 = kernel[CHUNK * 9u + 3u * k];
      w1 = kernel[CHUNK * 9u + 3u * k + 1u];
      w2 = kernel[CHUNK * 9u + 3u * k + 2u];
      b0 += vec4f(w0 * x0 + w1 * x1 + w2 * x2);
      b1 += vec4f(w0 * x1 + w1 * x2 + w2 * x3);
      b2 += vec4f(w0 * x2 + w1 * x3 + w2 * x4);
      b3 += vec4f(w0 * x3 + w1 * x4 + w2 * x5);
    }
  }
  if (y < height) {
    keep(first, y, left, a0);
    keep(first, y, left + 1u, a1);
    keep(first, y, left + 2u, a2);
    keep(first, y, left + 3u, a3);
    keep(first + 1u, y, left, b0);
    keep(first + 1u, y, left + 1u, b1);
    keep(first + 1u, y, left + 2u, b2);
    keep(first + 1u, y, left + 3u, b3);
  }
}

// A convolution of one pixel without an activation: the last layer.
@compute @workgroup_size(8, 8)
fn project(@builtin(global_invocation_id) place: vec3u) {
  if (any(place.xy >= layer.size)) {
    return;
  }
  let pixels = layer.size.x * layer.size.y;
  let at = place.y * layer.size.x + place.x;
  var sum = bias[place.z];
  for (var i = 0u; i < layer.inputs; i++) {
    sum += vec4f(weights[place.z * layer.inputs + i] * image[layer.from_offset + i * pixels + at]);
  }
  store(place.z * pixels + at, sum);
}

// The mean of four pixels; z is the group of channels.
@compute @workgroup_size(8, 8)
fn pool(@builtin(global_invocation_id) place: vec3u) {
  if (any(place.xy >= layer.size)) {
    return;
  }
  let width = 2u * layer.size.x;
  let corner = layer.from_offset + (place.z * 2u * layer.size.y + 2u * place.y) * width + 2u * place.x;
  let sum = vec4f(image[corner]) + vec4f(image[corner + 1u]) + vec4f(image[corner + width]) + vec4f(image[corner + width + 1u]);
  store((place.z * layer.size.y + place.y) * layer.size.x + place.x, 0.25 * sum);
}

// Twice the size by bilinear interpolation between the centres of pixels.
@compute @workgroup_size(8, 8)
fn upsample(@builtin(global_invocation_id) place: vec3u) {
  if (any(place.xy >= layer.size)) {
    return;
  }
  let size = layer.size / 2u;
  let plane = layer.from_offset + place.z * size.x * size.y;
  let near = place.xy / 2u;
  // An even pixel lies a quarter before the centre of its source, an odd one a quarter behind.
  let even = (place.xy % 2u) == vec2u(0u);
  let far = select(min(near + 1u, size - 1u), max(near, vec2u(1u)) - 1u, even);
  let rows = plane + vec2u(near.y, far.y) * size.x;
  let upper = mix(vec4f(image[rows.x + near.x]), vec4f(image[rows.x + far.x]), 0.25);
  let lower = mix(vec4f(image[rows.y + near.x]), vec4f(image[rows.y + far.x]), 0.25);
  store((place.z * layer.size.y + place.y) * layer.size.x + place.x, mix(upper, lower, 0.25));
}
