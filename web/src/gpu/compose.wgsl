// The final image: base colours, and the head's correction resized from the scale that the head was trained at.

struct Sizes {
  image: vec2u,
  // Of the correction.
  correction: vec2u,
  // The share of the correction in the last component.
  background: vec4f,
}

@group(0) @binding(0) var<uniform> sizes: Sizes;
@group(0) @binding(1) var<storage, read> splatted: array<vec4f>;
@group(0) @binding(2) var<storage, read> correction: array<vec4f>;
@group(0) @binding(3) var result: texture_storage_2d<rgba8unorm, write>;

// Bilinear, antialiased where the correction shrinks: a triangle as wide as two of the larger pixels.
fn resized(pixel: vec2u) -> vec3f {
  if (all(sizes.image == sizes.correction)) {
    return correction[pixel.y * sizes.image.x + pixel.x].rgb;
  }
  let ratio = vec2f(sizes.correction) / vec2f(sizes.image);
  let reach = max(ratio, vec2f(1.0));
  let centre = ratio * (vec2f(pixel) + 0.5);
  let low = vec2u(max(centre - reach + 0.5, vec2f(0.0)));
  let high = min(vec2u(centre + reach + 0.5), sizes.correction);
  var sum = vec4f(0.0);
  for (var y = low.y; y < high.y; y++) {
    let down = max(1.0 - abs(f32(y) + 0.5 - centre.y) / reach.y, 0.0);
    for (var x = low.x; x < high.x; x++) {
      let weight = down * max(1.0 - abs(f32(x) + 0.5 - centre.x) / reach.x, 0.0);
      sum += weight * vec4f(correction[y * sizes.correction.x + x].rgb, 1.0);
    }
  }
  return sum.rgb / sum.w;
}

@compute @workgroup_size(8, 8)
fn compose(@builtin(global_invocation_id) place: vec3u) {
  let pixel = place.xy;
  if (any(pixel >= sizes.image)) {
    return;
  }
  let seen = splatted[pixel.y * sizes.image.x + pixel.x];
  var color = clamp(seen.rgb + (1.0 - seen.w) * sizes.background.rgb, vec3f(0.0), vec3f(1.0));
  if (sizes.background.w > 0.0) {
    color = clamp(color + sizes.background.w * resized(pixel), vec3f(0.0), vec3f(1.0));
  }
  textureStore(result, pixel, vec4f(color, 1.0));
}
