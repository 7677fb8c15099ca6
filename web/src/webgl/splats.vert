#version 300 es
// One quad for each primitive, farthest first; the projection is that of ../gpu/project.wgsl.
precision highp float;
precision highp int;
precision highp sampler2D;

// Four texels for each primitive: centre and opacity, then the columns of a root of its covariance.
uniform sampler2D geometry;
// The SH coefficients or logits of all primitives, four numbers in a texel.
uniform sampler2D coefficients;
uniform mat4 view;
uniform vec3 origin;
uniform vec4 lens;
uniform vec2 size;
uniform bool antialiased;

in uint id;
in vec2 corner;

out vec2 offset;
flat out vec3 conic;
flat out vec4 color;

const float NEAR = 0.01;
const float BLUR = 0.3;
const float FOV_MARGIN = 0.15;
const float MIN_ALPHA = 1.0 / 255.0;
const int BASES = (DEGREE + 1) * (DEGREE + 1);

vec4 texel(sampler2D table, int index) {
  int width = textureSize(table, 0).x;
  return texelFetch(table, ivec2(index % width, index / width), 0);
}

float number(int index) {
  return texel(coefficients, index >> 2)[index & 3];
}

vec3 coefficient(int k) {
  int at = (int(id) * BASES + k) * 3;
  return vec3(number(at), number(at + 1), number(at + 2));
}

vec3 color_of(vec3 direction) {
  if (LOGITS) {
    return 1.0 / (1.0 + exp(-coefficient(0)));
  }
  float x = direction.x, y = direction.y, z = direction.z;
  vec3 sum = 0.28209479177387814 * coefficient(0);
  if (DEGREE >= 1) {
    sum += 0.4886025119029199 * (-y * coefficient(1) + z * coefficient(2) - x * coefficient(3));
  }
  float xx = x * x, yy = y * y, zz = z * z;
  if (DEGREE >= 2) {
    sum += 1.0925484305920792 * (x * y * coefficient(4) - y * z * coefficient(5) - x * z * coefficient(7));
    sum += 0.31539156525252005 * (3.0 * zz - 1.0) * coefficient(6);
    sum += 0.5462742152960396 * (xx - yy) * coefficient(8);
  }
  if (DEGREE >= 3) {
    sum += -0.5900435899266435 * y * (3.0 * xx - yy) * coefficient(9) + 2.890611442640554 * x * y * z * coefficient(10);
    sum += -0.4570457994644658 * (5.0 * zz - 1.0) * (y * coefficient(11) + x * coefficient(13));
    sum += 0.3731763325901154 * z * (5.0 * zz - 3.0) * coefficient(12);
    sum += 1.445305721320277 * z * (xx - yy) * coefficient(14) - 0.5900435899266435 * x * (xx - 3.0 * yy) * coefficient(15);
  }
  return max(sum + 0.5, 0.0);
}

void main() {
  // Outside of the clip volume, unless it is set below.
  gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
  vec4 place = texel(geometry, 4 * int(id));
  vec3 camera = (view * vec4(place.xyz, 1.0)).xyz;
  float z = camera.z;
  if (z < NEAR) {
    return;
  }
  vec2 focal = lens.xy;
  vec2 principal = lens.zw;
  vec2 centre = focal * camera.xy / z + principal;
  mat3 columns = mat3(texel(geometry, 4 * int(id) + 1).xyz, texel(geometry, 4 * int(id) + 2).xyz, texel(geometry, 4 * int(id) + 3).xyz);
  mat3 rows = transpose(mat3(view) * columns);
  vec2 margin = FOV_MARGIN * size / focal;
  vec2 slope = clamp(camera.xy / z, -principal / focal - margin, (size - principal) / focal + margin);
  vec3 row_x = focal.x / z * (rows[0] - slope.x * rows[2]);
  vec3 row_y = focal.y / z * (rows[1] - slope.y * rows[2]);
  vec3 across = cross(row_x, row_y);
  float sharp_det = dot(across, across);
  float xx = dot(row_x, row_x) + BLUR, yy = dot(row_y, row_y) + BLUR, xy = dot(row_x, row_y);
  float det = sharp_det + BLUR * (xx + yy) - BLUR * BLUR;
  float opacity = place.w * (antialiased ? sqrt(max(sharp_det / det, 0.0)) : 1.0);
  if (opacity < MIN_ALPHA) {
    return;
  }
  // The box of the ellipse where the alpha reaches 1/255, at most three sigma.
  float reach = min(sqrt(2.0 * log(opacity / MIN_ALPHA)), 3.4);
  offset = corner * reach * sqrt(vec2(xx, yy));
  conic = vec3(yy, -xy, xx) / det;
  color = vec4(color_of(normalize(place.xyz - origin)), opacity);
  vec2 clip = 2.0 * (centre + offset) / size - 1.0;
  gl_Position = vec4(clip.x, -clip.y, 0.0, 1.0);
}
