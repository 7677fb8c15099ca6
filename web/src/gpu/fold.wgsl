// Between the splatted image and the network: blocks of FOLD x FOLD pixels become channels and come back.

struct Sizes {
  // The splatted image.
  image: vec2u,
  // The folded image, padded to the stride of the network.
  folded: vec2u,
  background: vec4f,
}

@group(0) @binding(0) var<uniform> sizes: Sizes;
// [groups, H, W]: colour and accumulation, then features.
@group(0) @binding(1) var<storage, read> splatted: array<vec4f>;
@group(0) @binding(2) var<storage, read_write> folded: array<vec4<number>>;
@group(0) @binding(3) var<storage, read> corrections: array<vec4<number>>;
@group(0) @binding(4) var<storage, read_write> corrected: array<vec4f>;

// One channel of the network's image at a pixel; zero outside, as convolutions pad.
fn channel(c: u32, pixel: vec2u) -> f32 {
  if (c >= CHANNELS || any(pixel >= sizes.image)) {
    return 0.0;
  }
  let seen = c + FIRST_CHANNEL;
  return splatted[(seen / 4u * sizes.image.y + pixel.y) * sizes.image.x + pixel.x][seen % 4u];
}

@compute @workgroup_size(8, 8)
fn fold(@builtin(global_invocation_id) place: vec3u) {
  if (any(place.xy >= sizes.folded)) {
    return;
  }
  var value = vec4f(0.0);
  for (var lane = 0u; lane < 4u; lane++) {
    let n = 4u * place.z + lane;
    let within = n % (FOLD * FOLD);
    value[lane] = channel(n / (FOLD * FOLD), place.xy * FOLD + vec2u(within % FOLD, within / FOLD));
  }
  folded[(place.z * sizes.folded.y + place.y) * sizes.folded.x + place.x] = vec4<number>(value);
}

// The difference between the compensated image and the base colours, at each pixel.
@compute @workgroup_size(8, 8)
fn unfold(@builtin(global_invocation_id) place: vec3u) {
  let pixel = place.xy;
  if (any(pixel >= sizes.image)) {
    return;
  }
  let at = pixel.y * sizes.image.x + pixel.x;
  let seen = splatted[at];
  let block = pixel / FOLD;
  let within = pixel % FOLD;
  var out = vec3f(0.0);
  for (var c = 0u; c < 3u; c++) {
    let n = c * FOLD * FOLD + within.y * FOLD + within.x;
    out[c] = f32(corrections[(n / 4u * sizes.folded.y + block.y) * sizes.folded.x + block.x][n % 4u]);
  }
  let background = (1.0 - seen.w) * sizes.background.rgb;
  let base = clamp(seen.rgb + background, vec3f(0.0), vec3f(1.0));
  var image = seen.w * out + background;
  if (RESIDUAL) {
    image = base + seen.w * out;
  }
  corrected[at] = vec4f(clamp(image, vec3f(0.0), vec3f(1.0)) - base, 0.0);
}
