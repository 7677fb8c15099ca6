// Blends the list of each tile from front to back: colours, accumulation and features in one pass.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> splats: array<Splat>;
@group(0) @binding(2) var<storage, read> colors: array<vec4f>;
@group(0) @binding(3) var<storage, read> features: array<vec4f>;
@group(0) @binding(4) var<storage, read> ids: array<u32>;
@group(0) @binding(5) var<storage, read> ranges: array<vec2u>;
// [1 + FEATURE_GROUPS, H, W] of four channels: colour and accumulation, then features.
@group(0) @binding(6) var<storage, read_write> image: array<vec4f>;

const MAX_ALPHA = 0.999;
const MIN_TRANSMITTANCE = 1e-4;
const THREADS = 256u;

var<workgroup> places: array<vec4f, 256>;
var<workgroup> shapes: array<vec2f, 256>;
var<workgroup> owners: array<u32, 256>;
var<workgroup> open_pixels: atomic<u32>;
var<workgroup> any_open: u32;

@compute @workgroup_size(16, 16)
fn blend(@builtin(workgroup_id) tile: vec3u, @builtin(global_invocation_id) pixel: vec3u,
         @builtin(local_invocation_index) thread: u32) {
  let range = ranges[tile.y * view.tiles.x + tile.x];
  let here = vec2f(pixel.xy) + 0.5;
  let inside = all(pixel.xy < view.size);
  var done = !inside;
  var transmittance = 1.0;
  var color = vec4f(0.0);
  var blended: array<vec4f, max(FEATURE_GROUPS, 1)>;
  for (var start = range.x; start < range.y; start += THREADS) {
    if (thread == 0u) {
      atomicStore(&open_pixels, 0u);
    }
    workgroupBarrier();
    if (!done) {
      atomicStore(&open_pixels, 1u);
    }
    if (start + thread < range.y) {
      let id = ids[start + thread];
      let splat = splats[id];
      places[thread] = vec4f(splat.centre, splat.conic);
      shapes[thread] = vec2f(splat.conic_yy, splat.opacity);
      owners[thread] = id;
    }
    workgroupBarrier();
    if (thread == 0u) {
      any_open = atomicLoad(&open_pixels);
    }
    if (workgroupUniformLoad(&any_open) == 0u) {
      break;
    }
    let count = min(range.y - start, THREADS);
    for (var k = 0u; k < count && !done; k++) {
      let place = places[k];
      let shape = shapes[k];
      let offset = here - place.xy;
      let exponent = 0.5 * (place.z * offset.x * offset.x + shape.x * offset.y * offset.y) + place.w * offset.x * offset.y;
      let alpha = min(MAX_ALPHA, shape.y * exp(-exponent));
      if (exponent < 0.0 || !(alpha >= MIN_ALPHA)) {
        continue;
      }
      let behind = transmittance * (1.0 - alpha);
      if (behind <= MIN_TRANSMITTANCE) {
        done = true;
        break;
      }
      let weight = alpha * transmittance;
      let id = owners[k];
      color += weight * colors[id];
      for (var g = 0u; g < FEATURE_GROUPS; g++) {
        blended[g] += weight * features[id * FEATURE_GROUPS + g];
      }
      transmittance = behind;
    }
    workgroupBarrier();
  }
  if (inside) {
    let pixels = view.size.x * view.size.y;
    let at = pixel.y * view.size.x + pixel.x;
    image[at] = color;
    for (var g = 0u; g < FEATURE_GROUPS; g++) {
      image[(g + 1u) * pixels + at] = blended[g];
    }
  }
}
