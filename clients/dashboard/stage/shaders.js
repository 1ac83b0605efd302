/**
 * The shaders of the stage. Tracks are textures of the daemon's own float32 numbers, (frames,
 * masses) of (x, y, z) in meters, read without conversion: a vertex shader interpolates between two
 * frames.
 */

const VERSION = '#version 300 es\nprecision highp float;\nprecision highp int;\n';

/**
 * Position of a mass at the current time: the integer part of `frame` is the earlier frame, and the
 * fraction interpolates.
 */
const TRACK = `
uniform highp sampler2D track;
uniform float frame;
vec3 massAt(uint mass) {
  int earlier = int(frame);
  int last = textureSize(track, 0).y - 1;
  vec3 a = texelFetch(track, ivec2(int(mass), min(earlier, last)), 0).xyz;
  vec3 b = texelFetch(track, ivec2(int(mass), min(earlier + 1, last)), 0).xyz;
  return mix(a, b, fract(frame));
}
`;

/** Height of the terrain: bilinear between heights that are `spacing` apart, the first of them at
 * `origin`, and clamped at the edge. A profile along x has one row. */
const TERRAIN = `
uniform highp sampler2D heights;
uniform float spacing;
uniform vec2 origin;
float heightAt(vec2 at) {
  ivec2 last = textureSize(heights, 0) - 1;
  vec2 cell = clamp((at - origin) / spacing, vec2(0.0), vec2(last));
  ivec2 low = max(min(ivec2(cell), last - 1), 0);
  ivec2 high = min(low + 1, last);
  vec2 f = cell - vec2(low);
  float h00 = texelFetch(heights, low, 0).r;
  float h10 = texelFetch(heights, ivec2(high.x, low.y), 0).r;
  float h01 = texelFetch(heights, ivec2(low.x, high.y), 0).r;
  float h11 = texelFetch(heights, high, 0).r;
  return mix(mix(h00, h10, f.x), mix(h01, h11, f.x), f.y);
}
`;

/** The fraction of sunlight that reaches a point: a map of depths seen from the sun, four
 * samples. */
const SHADOW = `
uniform highp sampler2DShadow shadowMap;
uniform mat4 sunMatrix;
uniform float shadowStrength;
float sunlight(vec3 at) {
  if (shadowStrength == 0.0) return 1.0;
  vec3 p = (sunMatrix * vec4(at, 1.0)).xyz * 0.5 + 0.5;
  if (p.x < 0.0 || p.y < 0.0 || p.x > 1.0 || p.y > 1.0) return 1.0;
  float texel = 1.0 / float(textureSize(shadowMap, 0).x);
  float lit = 0.0;
  for (int i = 0; i < 4; i++) {
    vec2 shift = (vec2(float(i & 1), float(i >> 1)) - 0.5) * 1.4 * texel;
    lit += texture(shadowMap, vec3(p.xy + shift, p.z - 0.0015));
  }
  return mix(1.0, lit * 0.25, shadowStrength);
}
`;

/** Colors that the theme sets; all are linear values of the screen. */
const LOOK = `
uniform vec3 sun;
uniform vec3 eye;
uniform vec3 lightAt;
uniform vec3 background;
uniform vec3 glow;
vec3 lamp(vec3 at, vec3 normal) {
  vec3 to = lightAt - at;
  float d2 = dot(to, to);
  float facing = max(dot(normal, normalize(to)), 0.0) * 0.7 + 0.3;
  return glow * facing * 0.16 / (d2 + 0.12);
}
// Bright values approach white slowly, so that faces near the light keep their shape.
vec3 exposed(vec3 lit) {
  vec3 above = max(lit - 0.8, 0.0);
  return min(lit, 0.8) + 0.2 * (1.0 - exp(-above / 0.4));
}
`;

export const TERRAIN_SHADERS = [
  `${VERSION}${TERRAIN}
layout(location = 0) in vec2 corner;
uniform mat4 matrix;
// Of a race: start and direction.
uniform vec4 course;
// Ranges along and across, or 0: the whole map.
uniform vec4 lane;
uniform bool isProfile;
uniform bool isGrid;
out vec3 at;
out vec2 slope;
out vec2 way;
void main() {
  // The mesh is finer in the middle, where robots walk; beyond the map it continues, flat in one
  // axis.
  vec2 p = 2.5 + corner * (0.55 + 0.45 * abs(corner)) * 6.0;
  bool isLane = lane.y > lane.x;
  if (isLane) {
    way = mix(lane.xz, lane.yw, corner * 0.5 + 0.5);
    p = course.xy + way.x * course.zw + way.y * vec2(course.w, -course.z);
  }
  // Edges of a profile or custom grid are sharp where the mesh is finer than its heights.
  vec2 edge = origin + round((p - origin) / spacing) * spacing;
  bool isAligned = !isLane || abs(course.z) > 0.99;
  if (isAligned && (isProfile || isGrid) && abs(edge.x - p.x) < 0.05) p.x = edge.x;
  if (isAligned && isGrid && abs(edge.y - p.y) < 0.05) p.y = edge.y;
  at = vec3(p, heightAt(p));
  // The slope of the bilinear patch, not of the mesh; here, not for each pixel, because most of the
  // time without a graphics processor would go there.
  float e = 0.02;
  slope = vec2(heightAt(p + vec2(e, 0.0)) - heightAt(p - vec2(e, 0.0)),
               heightAt(p + vec2(0.0, e)) - heightAt(p - vec2(0.0, e))) / (2.0 * e);
  gl_Position = matrix * vec4(at, 1.0);
}`,
  `${VERSION}${SHADOW}${LOOK}
in vec3 at;
in vec2 slope;
in vec2 way;
uniform vec4 lane;
// Of a race: distance of its finish, or 0.
uniform float goal;
// Distance of lines across its lanes, or 0.
uniform float marks;
uniform vec3 tint;
// Of the ground that is drawn in full, and half of its sides.
uniform vec2 middle;
uniform vec2 reach;
uniform vec3 ground;
uniform vec3 line;
out vec4 color;
float lines(float value, float width) {
  float w = fwidth(value) * width;
  float d = abs(fract(value - 0.5) - 0.5);
  return (1.0 - smoothstep(w * 0.5, w * 1.5, d)) * clamp(0.35 / max(w, 0.001) - 0.35, 0.0, 1.0);
}
void main() {
  vec3 normal = normalize(vec3(-slope, 1.0));
  float day = max(dot(normal, sun), 0.0);
  vec3 lit = ground * (0.50 + 0.62 * day * mix(0.45, 1.0, sunlight(at)));
  lit += ground * lamp(at, normal) * 2.2;
  vec2 cell = at.xy * 1.4;
  float coarse = max(lines(cell.x, 1.3), lines(cell.y, 1.3));
  float fine = max(lines(cell.x * 7.0, 0.8), lines(cell.y * 7.0, 0.8));
  float contour = lines(at.z * 25.0, 0.9);
  lit = mix(lit, line, coarse * 0.55);
  lit = mix(lit, line, fine * 0.16);
  lit = mix(lit, line, contour * 0.14);
  float ring = length(at.xy - lightAt.xy);
  float halo = smoothstep(0.012, 0.0, abs(ring - 0.12)) * 0.5;
  lit += glow * (halo + 0.35 * exp(-ring * ring * 9.0));
  // Beyond the map the ground fades into the background.
  vec2 beyond = max(abs(at.xy - middle) - (reach - 0.15), 0.0);
  float fade = smoothstep(0.0, 1.3, length(beyond));
  fade = max(fade, smoothstep(7.0, 13.0, distance(at, eye)));
  if (lane.y > lane.x) {
    float soft = fwidth(way.x) + fwidth(way.y);
    lit = mix(lit, lit * (tint + 0.25), 0.15);
    if (marks > 0.0) lit = mix(lit, glow, lines(way.x / marks, 2.0) * 0.6);
    lit = mix(lit, vec3(0.95), 1.0 - smoothstep(0.012, 0.012 + soft, abs(way.x)));
    vec2 square = floor(vec2(way.x - goal, way.y) / 0.1);
    if (goal > 0.0 && (square.x == 0.0 || square.x == -1.0)) {
      lit = mix(lit, vec3(mod(square.x + square.y, 2.0) == 0.0 ? 0.95 : 0.08), 0.8);
    }
    float edge = min(way.y - lane.z, lane.w - way.y);
    lit = mix(lit, tint, 1.0 - smoothstep(0.02, 0.02 + soft, edge));
    fade = 1.0 - smoothstep(0.0, 0.2, min(way.x - lane.x, lane.y - way.x));
  }
  color = vec4(mix(exposed(lit), background, fade), 1.0);
}`,
];

/** The skin: six vertices per face form two triangles from its four corners. (An instance per face
 * would be far slower without a graphics processor.) */
const SKIN_VERTEX = `${VERSION}${TRACK}
layout(location = 0) in uvec4 low;
layout(location = 1) in uvec4 high;
layout(location = 2) in uint side;
uniform mat4 matrix;
const uint CORNERS[24] = uint[24](0u,1u,3u,2u, 4u,6u,7u,5u, 0u,4u,5u,1u, 2u,3u,7u,6u,
                                  0u,2u,6u,4u, 1u,5u,7u,3u);
const int TURN[6] = int[6](0, 1, 2, 0, 2, 3);
uint mass(uint corner) { return corner < 4u ? low[corner] : high[corner - 4u]; }
`;

export const SKIN_SHADERS = [
  `${SKIN_VERTEX}
out vec3 at;
out vec2 uv;
flat out float swelling;
void main() {
  int turn = TURN[gl_VertexID % 6];
  at = massAt(mass(CORNERS[int(side) * 4 + turn]));
  uv = vec2(turn == 1 || turn == 2 ? 1.0 : 0.0, turn >= 2 ? 1.0 : 0.0);
  // Mean strain of the four body diagonals: 0 at rest, above 0 where the voxel is swollen.
  float sum = 0.0;
  for (uint c = 0u; c < 4u; c++) sum += distance(massAt(mass(c)), massAt(mass(7u - c)));
  swelling = sum / (4.0 * 0.17320508) - 1.0;
  gl_Position = matrix * vec4(at, 1.0);
}`,
  `${VERSION}${SHADOW}${LOOK}
in vec3 at;
in vec2 uv;
flat in float swelling;
uniform vec3 swollen;
uniform vec3 shrunk;
uniform vec3 rest;
uniform vec3 tint;
// Share of the robot's own color.
uniform float owned;
uniform float alpha;
out vec4 color;
void main() {
  vec3 normal = normalize(cross(dFdx(at), dFdy(at)));
  vec3 toEye = normalize(eye - at);
  if (dot(normal, toEye) < 0.0) normal = -normal;
  float amount = clamp(swelling * 7.0, -1.0, 1.0);
  vec3 base = mix(rest, amount > 0.0 ? swollen : shrunk, smoothstep(0.0, 1.0, abs(amount)));
  base = mix(base, tint, owned);
  float day = max(dot(normal, sun), 0.0) * sunlight(at + normal * 0.004);
  float sky = 0.5 + 0.5 * normal.z;
  vec3 lit = base * (0.30 + 0.26 * sky + 0.56 * day) + base * lamp(at, normal) * 1.5;
  float rim = pow(1.0 - max(dot(normal, toEye), 0.0), 3.0);
  lit += rim * 0.07;
  vec2 edge = min(uv, 1.0 - uv);
  vec2 w = fwidth(uv);
  float border = 1.0 - smoothstep(0.0, 1.0,
    min(edge.x / max(w.x, 0.012), edge.y / max(w.y, 0.012)) - 0.35);
  lit = mix(lit, mix(lit * 0.42, tint, 0.32), border * 0.85);
  color = vec4(exposed(lit), alpha);
}`,
];

/** The same faces seen from the sun, with only their depth. */
export const DEPTH_SHADERS = [
  `${SKIN_VERTEX}
void main() {
  gl_Position = matrix * vec4(massAt(mass(CORNERS[int(side) * 4 + TURN[gl_VertexID % 6]])), 1.0);
}`,
  `${VERSION}void main() {}`,
];

/** Springs: each is a ribbon that faces the eye, thick and colored where it is strained or
 * actuated. */
export const SPRING_SHADERS = [
  `${VERSION}${TRACK}
layout(location = 0) in uvec2 ends;
layout(location = 1) in uint diagonal;
uniform mat4 matrix;
uniform vec3 eye;
uniform highp isampler2D actuation;
uniform bool showActuation;
out float across;
out vec3 at;
flat out float amount;
void main() {
  vec3 a = massAt(ends.x);
  vec3 b = massAt(ends.y);
  float restLength = diagonal == 1u ? 0.14142136 : 0.1;
  if (showActuation) {
    ivec2 size = textureSize(actuation, 0);
    int row = min(int(frame + 0.5), size.y - 1);
    amount = float(texelFetch(actuation, ivec2(gl_InstanceID, row), 0).r) / 127.0;
  } else {
    amount = clamp((distance(a, b) / restLength - 1.0) * 5.0, -1.0, 1.0);
  }
  float along = float(gl_VertexID >> 1);
  across = float(gl_VertexID & 1) * 2.0 - 1.0;
  at = mix(a, b, along);
  vec3 side = normalize(cross(b - a, eye - at));
  at += side * across * (0.0018 + 0.0042 * abs(amount));
  gl_Position = matrix * vec4(at, 1.0);
}`,
  `${VERSION}${LOOK}
in float across;
in vec3 at;
flat in float amount;
uniform vec3 swollen;
uniform vec3 shrunk;
uniform vec3 rest;
uniform float alpha;
out vec4 color;
void main() {
  float round = sqrt(max(1.0 - across * across, 0.0));
  vec3 base = mix(rest * 0.86, amount > 0.0 ? swollen : shrunk, smoothstep(0.02, 0.7, abs(amount)));
  color = vec4(exposed(base * (0.42 + 0.62 * round) + base * lamp(at, vec3(0.0, 0.0, 1.0))), alpha);
}`,
];

/** The path of a center of mass over the ground, up to the current frame. */
export const TRAIL_SHADERS = [
  `${VERSION}${TERRAIN}
layout(location = 0) in vec4 point;
uniform mat4 matrix;
uniform float width;
out float when;
out float across;
void main() {
  // point: x, y, frame, side; the direction across is given by the sign and the next normal.
  across = sign(point.w);
  float angle = (abs(point.w) - 1.0);
  vec2 p = point.xy + vec2(cos(angle), sin(angle)) * across * width;
  when = point.z;
  gl_Position = matrix * vec4(p, heightAt(p) + 0.006, 1.0);
}`,
  `${VERSION}
in float when;
in float across;
uniform float frame;
uniform vec3 tint;
out vec4 color;
void main() {
  if (when > frame) discard;
  float soft = 1.0 - smoothstep(0.7, 1.0, abs(across));
  color = vec4(tint, soft * 0.9);
}`,
];

/**
 * A ring under each mass that touches the ground. Without recorded contacts, masses that lie on the
 * ground count.
 */
export const CONTACT_SHADERS = [
  `${VERSION}${TRACK}${TERRAIN}
uniform mat4 matrix;
uniform highp usampler2D contacts;
uniform bool hasContacts;
out vec2 uv;
out float touching;
void main() {
  vec3 mass = massAt(uint(gl_InstanceID));
  float ground = heightAt(mass.xy);
  int row = min(int(frame + 0.5), textureSize(contacts, 0).y - 1);
  touching = hasContacts ? float(texelFetch(contacts, ivec2(gl_InstanceID, row), 0).r)
                         : 1.0 - smoothstep(0.0005, 0.004, mass.z - ground);
  uv = vec2(float(gl_VertexID & 1), float(gl_VertexID >> 1)) * 2.0 - 1.0;
  vec2 p = mass.xy + uv * 0.024;
  gl_Position = matrix * vec4(p, heightAt(p) + 0.005, 1.0);
}`,
  `${VERSION}
in vec2 uv;
in float touching;
uniform vec3 tint;
out vec4 color;
void main() {
  float r = length(uv);
  float ring = smoothstep(0.45, 0.6, r) * (1.0 - smoothstep(0.85, 1.0, r));
  if (ring * touching < 0.02) discard;
  color = vec4(tint, ring * touching);
}`,
];

/** The light: a bright disc with a halo that always faces the eye. */
export const LAMP_SHADERS = [
  `${VERSION}
uniform mat4 matrix;
uniform vec3 lightAt;
uniform vec2 size;
out vec2 uv;
void main() {
  uv = vec2(float(gl_VertexID & 1), float(gl_VertexID >> 1)) * 2.0 - 1.0;
  gl_Position = matrix * vec4(lightAt + vec3(0.0, 0.0, 0.045), 1.0);
  gl_Position.xy += uv * size;
}`,
  `${VERSION}
in vec2 uv;
uniform vec3 glow;
out vec4 color;
void main() {
  float r = length(uv);
  float core = 1.0 - smoothstep(0.17, 0.21, r);
  float halo = pow(max(1.0 - r, 0.0), 3.0) * 0.6;
  color = vec4(mix(glow, vec3(1.0), core), max(core, halo));
}`,
];
