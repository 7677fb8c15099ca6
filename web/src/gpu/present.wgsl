// The image on the canvas, scaled to its size.

@group(0) @binding(0) var image: texture_2d<f32>;
@group(0) @binding(1) var smooth_sampler: sampler;

struct Corner {
  @builtin(position) position: vec4f,
  @location(0) place: vec2f,
}

@vertex
fn corner(@builtin(vertex_index) index: u32) -> Corner {
  // One triangle that covers the canvas.
  let place = vec2f(f32(index & 1u), f32(index >> 1u)) * 2.0;
  return Corner(vec4f(place.x * 2.0 - 1.0, 1.0 - place.y * 2.0, 0.0, 1.0), place);
}

@fragment
fn shade(@location(0) place: vec2f) -> @location(0) vec4f {
  return textureSample(image, smooth_sampler, place);
}
