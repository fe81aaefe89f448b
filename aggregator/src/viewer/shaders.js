// The shaders of the viewer. The projection is that of shared/engine/src/cpu/geometry.rs and project.rs (EWA splatting of
// 3DGS), with the constants of shared/engine/src/layout/constants.rs; a test compares pictures of both.

/* exported SPLAT_VERTEX, SPLAT_FRAGMENT, SCREEN_VERTEX, SCREEN_FRAGMENT, NEAR, LINEARISATION_MARGIN */

/** Splats at this depth or less are not drawn. */
const NEAR = 0.2;
/** A splat is linearised at most this share of the picture's size beyond its edge. */
const LINEARISATION_MARGIN = 0.15;

/** Projects one splat: an instance is a rectangle around all pixels with an alpha of at least 1/255. */
const SPLAT_VERTEX = `#version 300 es
precision highp float;
precision highp int;
precision highp usampler2D;
const float LOW_PASS_PX2 = 0.3;
const float ALPHA_MIN = 1.0 / 255.0;
const float LOG2_E = 1.4426950408889634;
const float COLOR_SCALE = 0.15;
const float C0 = 0.28209479177387814;
uniform usampler2D u_geometry, u_harmonics;
uniform mat3 u_rotation;
uniform vec3 u_translation, u_eye;
uniform vec2 u_focal_px, u_center_px, u_size_px, u_slope_min, u_slope_max;
uniform int u_degree;
uniform sampler2D u_paint;
uniform bool u_is_painted;
layout(location = 0) in uint a_splat;
flat out vec2 v_mean_px;
flat out vec3 v_falloff;
flat out float v_log2_opacity;
flat out vec3 v_rgb;
flat out vec4 v_plane;

float signed_byte(uint words[12], int index) {
  return (float((words[index >> 2] >> (8 * (index & 3))) & 255u) - 128.0) / 128.0;
}

// The signs are those of SPZ's axes.
vec3 harmonics(uint splat, vec3 dir) {
  uint words[12];
  int texels = u_degree == 3 ? 3 : u_degree;
  ivec2 at = ivec2(int(splat % ${SPLATS_PER_ROW}u) * texels, int(splat / ${SPLATS_PER_ROW}u));
  for (int k = 0; k < texels; k++) {
    uvec4 texel = texelFetch(u_harmonics, at + ivec2(k, 0), 0);
    for (int c = 0; c < 4; c++) words[4 * k + c] = texel[c];
  }
  float x = dir.x, y = dir.y, z = dir.z, xx = x * x, yy = y * y, zz = z * z;
  float basis[16];
  basis[1] = 0.48860252 * y;
  basis[2] = -0.48860252 * z;
  basis[3] = -0.48860252 * x;
  basis[4] = -1.0925485 * x * y;
  basis[5] = -1.0925485 * y * z;
  basis[6] = 0.31539157 * (2.0 * zz - xx - yy);
  basis[7] = 1.0925485 * x * z;
  basis[8] = 0.5462742 * (xx - yy);
  basis[9] = 0.5900436 * y * (3.0 * xx - yy);
  basis[10] = 2.8906114 * x * y * z;
  basis[11] = 0.4570458 * y * (4.0 * zz - xx - yy);
  basis[12] = -0.37317634 * z * (2.0 * zz - 3.0 * (xx + yy));
  basis[13] = -0.4570458 * x * (4.0 * zz - xx - yy);
  basis[14] = -1.4453057 * z * (xx - yy);
  basis[15] = -0.5900436 * x * (xx - 3.0 * yy);
  vec3 sum = vec3(0.0);
  int count = (u_degree + 1) * (u_degree + 1);
  for (int k = 1; k < count; k++) {
    int b = 3 * (k - 1);
    sum += basis[k] * vec3(signed_byte(words, b), signed_byte(words, b + 1), signed_byte(words, b + 2));
  }
  return sum;
}

mat3 rotation(vec4 q) {
  float x = q.x, y = q.y, z = q.z, w = q.w;
  return mat3(
    1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
    2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
    2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));
}

void main() {
  gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
  ivec2 at = ivec2(int(a_splat % ${SPLATS_PER_ROW}u) * ${GEOMETRY_TEXELS}, int(a_splat / ${SPLATS_PER_ROW}u));
  uvec4 geometry = texelFetch(u_geometry, at, 0), rest = texelFetch(u_geometry, at + ivec2(1, 0), 0);
  vec3 mean = uintBitsToFloat(geometry.xyz);
  vec3 t = u_rotation * mean + u_translation;
  if (!(t.z > ${NEAR})) return;
  vec4 bytes = vec4(geometry.w & 255u, (geometry.w >> 8) & 255u, (geometry.w >> 16) & 255u, geometry.w >> 24);
  vec3 scale = exp(bytes.xyz / 16.0 - 10.0), variance = scale * scale;
  float log2_opacity = log2(clamp(bytes.w / 255.0, 1.0 / 255.0, 254.0 / 255.0));
  float falloff_max = log2_opacity - log2(ALPHA_MIN);
  if (!(falloff_max > 0.0)) return;

  mat3 u = u_rotation * rotation(normalize(vec4(unpackSnorm2x16(rest.x), unpackSnorm2x16(rest.y))));
  vec3 rows[3] = vec3[3](
    vec3(u[0].x, u[1].x, u[2].x), vec3(u[0].y, u[1].y, u[2].y), vec3(u[0].z, u[1].z, u[2].z));
  vec2 slope = clamp(t.xy / t.z, u_slope_min, u_slope_max);
  vec3 b0 = u_focal_px.x / t.z * (rows[0] - slope.x * rows[2]);
  vec3 b1 = u_focal_px.y / t.z * (rows[1] - slope.y * rows[2]);
  vec3 bare = vec3(dot(b0 * variance, b0), dot(b0 * variance, b1), dot(b1 * variance, b1));
  vec3 s = cross(b0 * scale, b1 * scale);
  float det = dot(s, s) + LOW_PASS_PX2 * (bare.x + bare.z + LOW_PASS_PX2);
  vec3 cov = bare + vec3(LOW_PASS_PX2, 0.0, LOW_PASS_PX2);
  vec2 mean_px = u_focal_px * t.xy / t.z + u_center_px;
  vec2 extent = sqrt(2.0 / LOG2_E * falloff_max * cov.xz) + 0.01;

  vec3 color = (vec3(rest.z & 255u, (rest.z >> 8) & 255u, (rest.z >> 16) & 255u) / 255.0 - 0.5) / COLOR_SCALE;
  v_rgb = 0.5 + C0 * color;
  if (u_degree > 0) v_rgb += harmonics(a_splat, normalize(mean - u_eye));
  v_rgb = max(v_rgb, 0.0);
  if (u_is_painted) v_rgb = texelFetch(u_paint, ivec2(int(a_splat % ${SPLATS_PER_ROW}u), int(a_splat / ${SPLATS_PER_ROW}u)), 0).rgb;
  v_mean_px = mean_px;
  v_falloff = vec3(cov.z, -2.0 * cov.y, cov.x) / det * (0.5 * LOG2_E);
  v_log2_opacity = log2_opacity;
  vec3 normal = scale.x < scale.y && scale.x < scale.z ? u[0] : scale.y < scale.z ? u[1] : u[2];
  float facing = dot(normal, t);
  v_plane = vec4(facing >= 0.0 ? -normal : normal, abs(facing));

  vec2 corner = vec2(gl_VertexID & 1, gl_VertexID >> 1) * 2.0 - 1.0;
  vec2 clip = (mean_px + corner * extent) / u_size_px * 2.0 - 1.0;
  gl_Position = vec4(clip.x, -clip.y, 0.0, 1.0);
}`;

/** Blends one splat. With GEOMETRY, it writes normals and distances of planes instead of colours. */
const SPLAT_FRAGMENT = (geometry) => `#version 300 es
precision highp float;
const float ALPHA_MIN = 1.0 / 255.0;
const float ALPHA_MAX = 0.99;
uniform vec2 u_size_px;
flat in vec2 v_mean_px;
flat in vec3 v_falloff;
flat in float v_log2_opacity;
flat in vec3 v_rgb;
flat in vec4 v_plane;
layout(location = 0) out vec4 o_first;
${geometry ? 'layout(location = 1) out vec4 o_second;' : ''}
void main() {
  vec2 d = v_mean_px - vec2(gl_FragCoord.x, u_size_px.y - gl_FragCoord.y);
  float falloff = v_falloff.x * d.x * d.x + v_falloff.y * d.x * d.y + v_falloff.z * d.y * d.y;
  float alpha = exp2(v_log2_opacity - falloff);
  if (!(alpha >= ALPHA_MIN)) discard;
  alpha = min(alpha, ALPHA_MAX);
  ${geometry
    ? 'o_first = vec4(v_plane.xyz * alpha, alpha); o_second = vec4(v_plane.w * alpha, 0.0, 0.0, alpha);'
    : 'o_first = vec4(v_rgb * alpha, alpha);'}
}`;

/** Covers the screen with one triangle. */
const SCREEN_VERTEX = `#version 300 es
void main() {
  gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0.0, 1.0);
}`;

/** Turns what was blended into the picture on the screen, over a black background. */
const SCREEN_FRAGMENT = `#version 300 es
precision highp float;
const float SURFACE_ALPHA = 0.5;
const float GRAZING = 0.01;
uniform sampler2D u_first, u_second;
uniform vec2 u_focal_px, u_center_px, u_size_px, u_range;
uniform int u_layer;
out vec4 o_color;
void main() {
  vec4 first = texelFetch(u_first, ivec2(gl_FragCoord.xy), 0);
  vec3 color = first.rgb;
  if (u_layer == 2) {
    float length = max(length(first.xyz), 1e-6);
    color = first.a < SURFACE_ALPHA ? vec3(0.0) : first.xyz / length * vec3(0.5, -0.5, -0.5) + 0.5;
  } else if (u_layer == 1) {
    vec2 at = vec2(gl_FragCoord.x, u_size_px.y - gl_FragCoord.y);
    float facing = -dot(first.xyz, vec3((at - u_center_px) / u_focal_px, 1.0));
    float depth = texelFetch(u_second, ivec2(gl_FragCoord.xy), 0).r / facing;
    float t = clamp((u_range.y - depth) / max(u_range.y - u_range.x, 1e-6), 0.0, 1.0);
    vec3 low = mix(vec3(0.06, 0.03, 0.25), vec3(0.72, 0.21, 0.47), smoothstep(0.0, 0.5, t));
    color = mix(low, vec3(0.98, 0.95, 0.60), smoothstep(0.45, 1.0, t));
    if (first.a < SURFACE_ALPHA || facing < GRAZING * first.a) color = vec3(0.0);
  }
  o_color = vec4(clamp(color, 0.0, 1.0), 1.0);
}`;
