// Projects the primitives and evaluates their colours; the twin of sundae_ns/rasterize/reference.py.

struct Primitive {
  mean: vec3f,
  opacity: f32,
  // Columns of a root of the covariance: the rotation times the scales.
  root: mat3x3f,
}

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> primitives: array<Primitive>;
// [N, (DEGREE + 1)^2, 3]: coefficients, or one logit of a colour each.
@group(0) @binding(2) var<storage, read> coefficients: array<f32>;
@group(0) @binding(3) var<storage, read_write> splats: array<Splat>;
@group(0) @binding(4) var<storage, read_write> colors: array<vec4f>;
@group(0) @binding(5) var<storage, read_write> depths: array<u32>;
@group(0) @binding(6) var<storage, read_write> ids: array<u32>;

const NEAR = 0.01;
const FAR = 1e10;
const BLUR = 0.3;
const FOV_MARGIN = 0.15;
const MAX_RADIUS = 1e9;
// Slack on exponents, so that rounding never drops a primitive that is blended.
const ROUNDING = 1e-3;
const CULLED = 0xffffffffu;

const BASES = (DEGREE + 1) * (DEGREE + 1);

fn coefficient(i: u32, k: i32) -> vec3f {
  let at = (i * u32(BASES) + u32(k)) * 3u;
  return vec3f(coefficients[at], coefficients[at + 1u], coefficients[at + 2u]);
}

// Real spherical harmonics as polynomials of the unit direction (Sloan, JCGT 2013), with the signs of 3DGS.
fn color_of(i: u32, offset: vec3f) -> vec3f {
  if (LOGITS) {
    return 1.0 / (1.0 + exp(-coefficient(i, 0)));
  }
  let d = offset / max(length(offset), 1e-12);
  let x = d.x;
  let y = d.y;
  let z = d.z;
  var sum = 0.28209479177387814 * coefficient(i, 0);
  if (DEGREE >= 1) {
    let c = 0.4886025119029199;
    sum += c * (-y * coefficient(i, 1) + z * coefficient(i, 2) - x * coefficient(i, 3));
  }
  let xx = x * x;
  let yy = y * y;
  let zz = z * z;
  let xy = x * y;
  let cos2 = xx - yy;
  if (DEGREE >= 2) {
    let c1 = 1.0925484305920792;
    let c0 = 0.31539156525252005;
    sum += c1 * xy * coefficient(i, 4) - c1 * y * z * coefficient(i, 5) + c0 * (3.0 * zz - 1.0) * coefficient(i, 6);
    sum += -c1 * x * z * coefficient(i, 7) + 0.5 * c1 * cos2 * coefficient(i, 8);
  }
  let cos3 = x * (xx - 3.0 * yy);
  let sin3 = y * (3.0 * xx - yy);
  if (DEGREE >= 3) {
    let c3 = 0.5900435899266435;
    let c2 = 1.445305721320277;
    let c1 = 0.4570457994644658;
    let c0 = 0.3731763325901154;
    let inner = 5.0 * zz - 1.0;
    sum += -c3 * sin3 * coefficient(i, 9) + 2.0 * c2 * xy * z * coefficient(i, 10) - c1 * y * inner * coefficient(i, 11);
    sum += c0 * z * (5.0 * zz - 3.0) * coefficient(i, 12) - c1 * x * inner * coefficient(i, 13);
    sum += c2 * z * cos2 * coefficient(i, 14) - c3 * cos3 * coefficient(i, 15);
  }
  if (DEGREE >= 4) {
    let c4 = 0.6258357354491761;
    let c3 = 1.7701307697799304;
    let c2 = 0.47308734787878004;
    let c1 = 0.6690465435572892;
    let c0 = 0.10578554691520431;
    let inner2 = 7.0 * zz - 1.0;
    let inner1 = z * (7.0 * zz - 3.0);
    sum += 4.0 * c4 * xy * cos2 * coefficient(i, 16) - c3 * z * sin3 * coefficient(i, 17);
    sum += 2.0 * c2 * xy * inner2 * coefficient(i, 18) - c1 * y * inner1 * coefficient(i, 19);
    sum += c0 * (zz * (35.0 * zz - 30.0) + 3.0) * coefficient(i, 20) - c1 * x * inner1 * coefficient(i, 21);
    sum += c2 * cos2 * inner2 * coefficient(i, 22) - c3 * z * cos3 * coefficient(i, 23);
    sum += c4 * (x * cos3 - y * sin3) * coefficient(i, 24);
  }
  return max(sum + 0.5, vec3f(0.0));
}

fn tile_box(centre: vec2f, reach: vec2f) -> vec4f {
  let low = floor((centre - reach) / f32(TILE));
  let high = ceil((centre + reach) / f32(TILE));
  let limit = vec2f(view.tiles);
  return vec4f(clamp(low, vec2f(0.0), limit), clamp(high, vec2f(0.0), limit));
}

@compute @workgroup_size(256)
fn project(@builtin(global_invocation_id) thread: vec3u, @builtin(num_workgroups) groups: vec3u) {
  let i = thread.x + thread.y * groups.x * 256u;
  if (i >= view.count) {
    return;
  }
  ids[i] = i;
  depths[i] = CULLED;
  splats[i].low = 0u;
  splats[i].high = 0u;
  let primitive = primitives[i];
  let mean = vec4f(primitive.mean, 1.0);
  let camera = vec3f(dot(view.right, mean), dot(view.down, mean), dot(view.ahead, mean));
  let z = camera.z;
  if (!(z >= NEAR && z <= FAR)) {
    return;
  }
  let focal = view.lens.xy;
  let principal = view.lens.zw;
  let size = vec2f(view.size);
  let centre = focal * camera.xy / z + principal;

  // The screen rows of the root map the unit sphere to the footprint; the slope is clamped to the image and a margin.
  let root = transpose(mat3x3f(view.right.xyz, view.down.xyz, view.ahead.xyz)) * primitive.root;
  let rows = transpose(root);
  let margin = FOV_MARGIN * size / focal;
  let slope = clamp(camera.xy / z, -principal / focal - margin, (size - principal) / focal + margin);
  let row_x = focal.x / z * (rows[0] - slope.x * rows[2]);
  let row_y = focal.y / z * (rows[1] - slope.y * rows[2]);
  let across = cross(row_x, row_y);
  let sharp_det = dot(across, across);
  let sharp_xx = dot(row_x, row_x);
  let sharp_yy = dot(row_y, row_y);
  let xy = dot(row_x, row_y);
  let det = sharp_det + BLUR * (sharp_xx + sharp_yy) + BLUR * BLUR;
  let xx = sharp_xx + BLUR;
  let yy = sharp_yy + BLUR;

  let spread = sqrt(max(0.25 * (xx - yy) * (xx - yy) + xy * xy, 0.01));
  let radius = min(ceil(3.0 * sqrt(0.5 * (xx + yy) + spread)), MAX_RADIUS);
  if (!(all(centre + radius > vec2f(0.0)) && all(centre - radius < size))) {
    return;
  }
  var opacity = primitive.opacity;
  if (view.antialiased != 0u) {
    opacity *= sqrt(max(sharp_det / det, 0.0));
  }
  if (!(opacity >= MIN_ALPHA)) {
    return;
  }
  // Tiles of the three-sigma square, as in gsplat, where the alpha also reaches 1/255.
  let reach = sqrt(2.0 * (log(opacity / MIN_ALPHA) + ROUNDING) * vec2f(xx, yy));
  let square = tile_box(centre, vec2f(radius));
  let box = tile_box(centre, reach);
  let low = vec2u(max(square.xy, box.xy));
  let high = min(vec2u(min(square.zw, box.zw)), view.tiles);
  if (any(low >= high)) {
    return;
  }
  splats[i] = Splat(centre, vec2f(yy, -xy) / det, xx / det, opacity, low.x | (low.y << 16u), high.x | (high.y << 16u));
  colors[i] = vec4f(color_of(i, primitive.mean - view.origin.xyz), 1.0);
  // The bits of positive floats have the order of the floats.
  depths[i] = bitcast<u32>(z);
}
