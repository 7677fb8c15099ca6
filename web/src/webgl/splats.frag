#version 300 es
precision highp float;

in vec2 offset;
flat in vec3 conic;
flat in vec4 color;

out vec4 result;

void main() {
  float exponent = 0.5 * (conic.x * offset.x * offset.x + conic.z * offset.y * offset.y) + conic.y * offset.x * offset.y;
  float alpha = min(0.999, color.a * exp(-exponent));
  if (alpha < 1.0 / 255.0) {
    discard;
  }
  result = vec4(alpha * color.rgb, alpha);
}
