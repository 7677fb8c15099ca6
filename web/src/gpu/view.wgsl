struct View {
  // World-to-camera, OpenCV axes: three rows.
  right: vec4f,
  down: vec4f,
  ahead: vec4f,
  // Camera centre, world units.
  origin: vec4f,
  // fx, fy, cx, cy in pixels.
  lens: vec4f,
  // Width and height in pixels; columns and rows of tiles.
  size: vec2u,
  tiles: vec2u,
  count: u32,
  antialiased: u32,
  // Number of pairs of a tile and a primitive that the buffers hold.
  capacity: u32,
  // Most pairs of a view that is drawn.
  most: u32,
}

// A primitive on the screen; its rectangle of tiles is [low, high), x in the low half of a number.
struct Splat {
  centre: vec2f,
  // Inverse of the covariance: xx, xy, and yy below.
  conic: vec2f,
  conic_yy: f32,
  opacity: f32,
  low: u32,
  high: u32,
}

const TILE = 16u;
const MIN_ALPHA = 1.0 / 255.0;
