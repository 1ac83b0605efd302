/* raster.c: a rasterizer with a depth buffer, and its pictures as PNG.
 *
 * The terrain is a mesh of triangles whose pixels are shaded by their position in the world; a
 * robot's skin is its outer faces, colored by the swelling of their voxels. Shadows come from a
 * second depth buffer, seen from the sun. */
#include "raster.h"

#include "../morphoctl/ctl.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include <zlib.h>

#define SAMPLES     2 /* along each side of a pixel */
#define SHADOW_SIDE 512
#define MESH        96  /* cells of the terrain along each side */
#define FINE_MESH   160 /* of a profile, whose heights may be 0.1 m apart */
#define NEAR_M      0.05f
#define HALF_VIEW   0.3443f /* tangent of half the angle of view, 38 degrees high */
#define TRAIL_M     0.014f
#define SHADOW_M    0.8f  /* side of the shadow map, from its middle to its edge */
#define MIDDLE_M    2.5f  /* of the shadow map, along each axis */
#define SUN_YAW     0.75f /* rotation of the sun, from the direction toward the light */

struct vector {
  float x, y, z;
};

/* A vertex as the camera sees it: position in the picture, depth, and position in the world. */
struct vertex {
  float x, y, w; /* pixels; w: distance along the view */
  struct vector at;
  float u, v; /* on a face, 0 … 1 */
};

struct look {
  struct vector background, ground, line, glow, rest, swollen, shrunk;
};

struct raster {
  uint32_t width, height; /* in samples */
  float *depth;           /* (height, width) 1 / w; 0 = background */
  struct vector *color;   /* (height, width) */
  float *shadow;          /* (SHADOW_SIDE, SHADOW_SIDE) height toward the sun */
  /* For the current picture. */
  const struct look *look;
  struct vector eye, right, up, forward, lamp;
  struct vector sun, sun_right, sun_up, middle; /* for the shadow's view */
  float scale;                                  /* samples per unit of x / w */
  const struct scene_world *world;
};

static const struct look looks[2] = {{.background = {0.078f, 0.09f, 0.106f},
                                      .ground = {0.33f, 0.375f, 0.37f},
                                      .line = {0.1f, 0.13f, 0.14f},
                                      .glow = {1, 0.83f, 0.42f},
                                      .rest = {0.82f, 0.85f, 0.9f},
                                      .swollen = {0.98f, 0.62f, 0.28f},
                                      .shrunk = {0.16f, 0.47f, 0.86f}},
                                     {.background = {0.925f, 0.94f, 0.96f},
                                      .ground = {0.61f, 0.66f, 0.62f},
                                      .line = {0.3f, 0.34f, 0.33f},
                                      .glow = {1, 0.88f, 0.5f},
                                      .rest = {0.9f, 0.92f, 0.95f},
                                      .swollen = {0.94f, 0.5f, 0.12f},
                                      .shrunk = {0.13f, 0.4f, 0.8f}}};

/* ---- vectors ---- */

static struct vector add(struct vector a, struct vector b)
{
  return (struct vector){a.x + b.x, a.y + b.y, a.z + b.z};
}

static struct vector subtract(struct vector a, struct vector b)
{
  return (struct vector){a.x - b.x, a.y - b.y, a.z - b.z};
}

static struct vector times(struct vector a, float f)
{
  return (struct vector){a.x * f, a.y * f, a.z * f};
}

static float dot(struct vector a, struct vector b)
{
  return a.x * b.x + a.y * b.y + a.z * b.z;
}

static struct vector cross(struct vector a, struct vector b)
{
  return (struct vector){a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

static struct vector normal(struct vector a)
{
  const float length = sqrtf(dot(a, a));
  return length > 0 ? times(a, 1 / length) : a;
}

static struct vector mix(struct vector a, struct vector b, float share)
{
  return add(times(a, 1 - share), times(b, share));
}

static float clamp(float x, float low, float high)
{
  return x < low ? low : x > high ? high : x;
}

static float smooth(float from, float to, float x)
{
  const float t = clamp((x - from) / (to - from), 0, 1);
  return t * t * (3 - 2 * t);
}

/* ---- the world ---- */

/* The same of a profile. */
static float profile_at(const struct scene_world *world, float x, float slope[2])
{
  const uint32_t last = world->n_profile - 1;
  const float per_m = 1 / (float)world->spacing_m, c = clamp(x * per_m, 0, (float)last);
  const uint32_t i = c >= (float)last ? last - 1 : (uint32_t)c;
  const float *h = world->heights_m + i;
  if (slope != NULL) {
    slope[0] = x < 0 || x * per_m > (float)last ? 0 : per_m * (h[1] - h[0]);
    slope[1] = 0;
  }
  return h[0] + (c - (float)i) * (h[1] - h[0]);
}

/* Of a grid: heights along each axis, how many there are per meter, and where the first is. */
struct lattice {
  int sides[2];
  float per_m, from_m[2];
};

static struct lattice lattice_of(const struct scene_world *world)
{
  if (world->columns == 0)
    return (struct lattice){{8, 8}, 1.4f, {0, 0}};
  const float half = (float)world->spacing_m / 2;
  return (struct lattice){
      {(int)world->columns, (int)world->rows},
      1 / (float)world->spacing_m,
      {2.5f - half * (float)(world->columns - 1), 2.5f - half * (float)(world->rows - 1)}};
}

/* Returns the height of the terrain, bilinear and clamped as in the simulation, and its slope. */
static float height_at(const struct scene_world *world, float x, float y, float slope[2])
{
  if (world->n_profile != 0)
    return profile_at(world, x, slope);
  const struct lattice l = lattice_of(world);
  const int columns = l.sides[0], last[2] = {columns - 1, l.sides[1] - 1};
  const float cx = clamp((x - l.from_m[0]) * l.per_m, 0, (float)last[0]),
              cy = clamp((y - l.from_m[1]) * l.per_m, 0, (float)last[1]);
  const int i = cx >= (float)last[0] ? last[0] - 1 : (int)cx,
            j = cy >= (float)last[1] ? last[1] - 1 : (int)cy;
  const float fx = cx - (float)i, fy = cy - (float)j, *h = world->heights_m + j * columns + i,
              *far = h + columns;
  if (slope != NULL) {
    slope[0] = l.per_m * ((1 - fy) * (h[1] - h[0]) + fy * (far[1] - far[0]));
    slope[1] = l.per_m * ((1 - fx) * (far[0] - h[0]) + fx * (far[1] - h[1]));
  }
  return (1 - fy) * ((1 - fx) * h[0] + fx * h[1]) + fy * ((1 - fx) * far[0] + fx * far[1]);
}

/* Returns the length along an axis of the ground that is drawn in full. */
static float reach_of(const struct scene_world *world, int axis)
{
  const uint32_t n = axis == 0 && world->n_profile != 0 ? world->n_profile
                     : axis == 0                        ? world->columns
                                                        : world->rows;
  return n == 0 ? 5 : clamp((float)world->spacing_m * (float)(n - 1), 5, 8);
}

/* Returns the position of a mass at a time, between two frames. */
static struct vector mass_at(const struct scene_rollout *rollout, uint32_t n_masses, uint32_t mass,
                             double frame)
{
  const double last = rollout->n_frames - 1.0, f = frame < last ? frame : last;
  const uint32_t a = (uint32_t)f, b = a + 1 < rollout->n_frames ? a + 1 : a;
  const float *p = rollout->masses_m + ((size_t)a * n_masses + mass) * 3;
  const float *q = rollout->masses_m + ((size_t)b * n_masses + mass) * 3;
  const float share = (float)(f - (double)a);
  return mix((struct vector){p[0], p[1], p[2]}, (struct vector){q[0], q[1], q[2]}, share);
}

void raster_center(const struct scene *scene, uint32_t rollout, double time_s, double center_m[3])
{
  const struct scene_rollout *r = &scene->rollouts[rollout];
  const uint32_t n = scene->bodies[r->body].n_masses;
  memset(center_m, 0, 3 * sizeof(*center_m));
  for (uint32_t mass = 0; mass < n; mass++) {
    const struct vector at = mass_at(r, n, mass, time_s / scene->frame_s);
    const float axes[3] = {at.x, at.y, at.z};
    for (int axis = 0; axis < 3; axis++)
      center_m[axis] += (double)axes[axis] / n;
  }
}

/* ---- shading ---- */

static struct vector lamp_light(const struct raster *raster, struct vector at, struct vector facing)
{
  const struct vector to = subtract(raster->lamp, at);
  const float d2 = dot(to, to), share = clamp(dot(facing, normal(to)), 0, 1) * 0.7f + 0.3f;
  return times(raster->look->glow, share * 0.16f / (d2 + 0.12f));
}

/* Returns the position of a point on the shadow map; z: its height toward the sun. */
static struct vector on_shadow(const struct raster *raster, struct vector at)
{
  const struct vector from = subtract(at, raster->middle);
  return (struct vector){(dot(from, raster->sun_right) / SHADOW_M + 1) * SHADOW_SIDE / 2,
                         (dot(from, raster->sun_up) / SHADOW_M + 1) * SHADOW_SIDE / 2,
                         dot(from, raster->sun)};
}

/* Returns how much sunlight reaches a point, from 0.38 in the shadow to 1. */
static float sunlight(const struct raster *raster, struct vector at)
{
  const struct vector p = on_shadow(raster, at);
  if (!(p.x >= 1 && p.y >= 1 && p.x < SHADOW_SIDE - 1 && p.y < SHADOW_SIDE - 1))
    return 1;
  float lit = 0;
  for (int i = 0; i < 4; i++) {
    const int row = (int)(p.y + (float)(i >> 1) - 0.5f),
              column = (int)(p.x + (float)(i & 1) - 0.5f);
    lit += p.z + 0.008f >= raster->shadow[row * SHADOW_SIDE + column] ? 0.25f : 0;
  }
  return 0.38f + 0.62f * lit;
}

/* Returns the strength of a line at each whole number; `width` in units of the value. */
static float line_at(float value, float width)
{
  const float d = fabsf(value - roundf(value));
  return (1 - smooth(width * 0.5f, width * 1.5f, d)) * clamp(0.35f / width - 0.35f, 0, 1);
}

/* Brings bright values toward white slowly, so that faces near the light keep their shape. */
static float exposed(float lit)
{
  return lit <= 0.8f ? lit : 0.8f + 0.2f * (1 - expf((0.8f - lit) / 0.4f));
}

static struct vector expose(struct vector lit)
{
  return (struct vector){exposed(lit.x), exposed(lit.y), exposed(lit.z)};
}

static struct vector multiply(struct vector a, struct vector b)
{
  return (struct vector){a.x * b.x, a.y * b.y, a.z * b.z};
}

static struct vector shade_ground(const struct raster *raster, struct vector at, float w)
{
  const struct look *look = raster->look;
  float slope[2];
  const float height = height_at(raster->world, at.x, at.y, slope);
  const struct vector up = normal((struct vector){-slope[0], -slope[1], 1});
  const float day = clamp(dot(up, raster->sun), 0, 1);
  struct vector lit =
      times(look->ground, 0.5f + 0.62f * day * (0.2f + 0.8f * sunlight(raster, at)));
  lit = add(lit, times(multiply(look->ground, lamp_light(raster, at, up)), 2.2f));
  /* The width of a pixel on the ground grows with the distance, and at low viewing angles. */
  const struct vector to_eye = normal(subtract(raster->eye, at));
  const float pixel = w * SAMPLES / raster->scale / clamp(dot(to_eye, up), 0.15f, 1);
  const float coarse =
      fmaxf(line_at(at.x * 1.4f, pixel * 1.4f * 1.3f), line_at(at.y * 1.4f, pixel * 1.4f * 1.3f));
  const float fine =
      fmaxf(line_at(at.x * 9.8f, pixel * 9.8f * 0.8f), line_at(at.y * 9.8f, pixel * 9.8f * 0.8f));
  const float steep = sqrtf(slope[0] * slope[0] + slope[1] * slope[1]) + 0.02f;
  lit = mix(lit, look->line, coarse * 0.55f);
  lit = mix(lit, look->line, fine * 0.16f);
  lit = mix(lit, look->line, line_at(height * 25, pixel * 25 * steep) * 0.14f);
  const float dx = at.x - raster->lamp.x, dy = at.y - raster->lamp.y, r2 = dx * dx + dy * dy;
  lit = add(lit, times(look->glow,
                       0.35f * expf(-9 * r2) + 0.5f * smooth(0.012f, 0, fabsf(sqrtf(r2) - 0.12f))));
  const float half_x = reach_of(raster->world, 0) / 2, half_y = reach_of(raster->world, 1) / 2,
              middle = raster->world->n_profile != 0 ? half_x : 2.5f,
              bx = fmaxf(fabsf(at.x - middle) - (half_x - 0.15f), 0),
              by = fmaxf(fabsf(at.y - 2.5f) - (half_y - 0.15f), 0);
  const float fade = fmaxf(smooth(0, 1.3f, sqrtf(bx * bx + by * by)), smooth(7, 13, w));
  return mix(expose(lit), look->background, fade);
}

static struct vector shade_skin(const struct raster *raster, const struct vertex *at,
                                struct vector facing, float swelling, float uv_per_sample)
{
  const struct look *look = raster->look;
  const float amount = clamp(swelling * 7, -1, 1);
  const struct vector base =
      mix(look->rest, amount > 0 ? look->swollen : look->shrunk, smooth(0, 1, fabsf(amount)));
  const struct vector above = add(at->at, times(facing, 0.004f));
  const float day = clamp(dot(facing, raster->sun), 0, 1) * sunlight(raster, above);
  struct vector lit = times(base, 0.3f + 0.26f * (0.5f + 0.5f * facing.z) + 0.56f * day);
  lit = add(lit, times(multiply(base, lamp_light(raster, at->at, facing)), 1.5f));
  const float edge = fminf(fminf(at->u, 1 - at->u), fminf(at->v, 1 - at->v));
  const float width = fmaxf(uv_per_sample * SAMPLES, 0.012f);
  lit = expose(lit);
  return mix(lit, times(lit, 0.38f), (1 - smooth(0, 1, edge / width - 0.35f)) * 0.85f);
}

/* ---- triangles ---- */

static bool see(const struct raster *raster, struct vector at, struct vertex *vertex)
{
  const struct vector from = subtract(at, raster->eye);
  vertex->w = dot(from, raster->forward);
  vertex->at = at;
  if (vertex->w < NEAR_M)
    return false;
  vertex->x = (float)raster->width / 2 + dot(from, raster->right) / vertex->w * raster->scale;
  vertex->y = (float)raster->height / 2 - dot(from, raster->up) / vertex->w * raster->scale;
  return true;
}

/* The two triangles of four corners. */
static const int turns[2][3] = {{0, 1, 2}, {0, 2, 3}};

/* Draws a triangle. swelling: of a face; NULL for the ground. */
static void fill(struct raster *raster, const struct vertex corners[4], const int turn[3],
                 const float *swelling)
{
  const struct vertex *const v[3] = {&corners[turn[0]], &corners[turn[1]], &corners[turn[2]]};
  struct vector facing = normal(cross(subtract(v[1]->at, v[0]->at), subtract(v[2]->at, v[0]->at)));
  if (dot(facing, subtract(raster->eye, v[0]->at)) < 0)
    facing = times(facing, -1);
  const float area =
      (v[1]->x - v[0]->x) * (v[2]->y - v[0]->y) - (v[2]->x - v[0]->x) * (v[1]->y - v[0]->y);
  if (fabsf(area) < 1e-6f)
    return;
  const float left = fminf(fminf(v[0]->x, v[1]->x), v[2]->x),
              right = fmaxf(fmaxf(v[0]->x, v[1]->x), v[2]->x),
              top = fminf(fminf(v[0]->y, v[1]->y), v[2]->y),
              bottom = fmaxf(fmaxf(v[0]->y, v[1]->y), v[2]->y);
  if (right < 0 || bottom < 0 || left >= (float)raster->width || top >= (float)raster->height)
    return;
  const int x0 = (int)fmaxf(left, 0), x1 = (int)fminf(right, (float)raster->width - 1);
  const int y0 = (int)fmaxf(top, 0), y1 = (int)fminf(bottom, (float)raster->height - 1);
  const float uv_per_sample = 1 / sqrtf(fabsf(area));
  for (int y = y0; y <= y1; y++)
    for (int x = x0; x <= x1; x++) {
      const float px = (float)x + 0.5f, py = (float)y + 0.5f;
      const float a = ((v[1]->x - px) * (v[2]->y - py) - (v[2]->x - px) * (v[1]->y - py)) / area;
      const float b = ((v[2]->x - px) * (v[0]->y - py) - (v[0]->x - px) * (v[2]->y - py)) / area;
      const float c = 1 - a - b;
      if (a < 0 || b < 0 || c < 0)
        continue;
      /* Values that are linear in the world are linear here after a division by w. */
      const float qa = a / v[0]->w, qb = b / v[1]->w, qc = c / v[2]->w, q = qa + qb + qc;
      const size_t i = (size_t)y * raster->width + (size_t)x;
      if (q <= raster->depth[i])
        continue;
      raster->depth[i] = q;
      const struct vertex at = {
          .w = 1 / q,
          .at =
              times(add(add(times(v[0]->at, qa), times(v[1]->at, qb)), times(v[2]->at, qc)), 1 / q),
          .u = (v[0]->u * qa + v[1]->u * qb + v[2]->u * qc) / q,
          .v = (v[0]->v * qa + v[1]->v * qb + v[2]->v * qc) / q};
      raster->color[i] = swelling != NULL
                             ? shade_skin(raster, &at, facing, *swelling, uv_per_sample)
                             : shade_ground(raster, at.at, at.w);
    }
}

/* Moves a coordinate of the mesh onto a height of a profile or custom grid that is less than a cell
 * away, so that its edges are sharp. */
static float on_height(const struct scene_world *world, int axis, float at)
{
  if (world->columns == 0 && (world->n_profile == 0 || axis == 1))
    return at;
  const float from = world->columns != 0 ? lattice_of(world).from_m[axis] : 0;
  const float spacing = (float)world->spacing_m;
  const float height = from + roundf((at - from) / spacing) * spacing;
  return fabsf(height - at) < 0.05f ? height : at;
}

static void draw_ground(struct raster *raster)
{
  const bool is_fine = raster->world->n_profile != 0 || raster->world->columns != 0;
  const int mesh = is_fine ? FINE_MESH : MESH;
  for (int j = 0; j < mesh; j++)
    for (int i = 0; i < mesh; i++) {
      struct vertex corners[4];
      bool seen = true;
      for (int k = 0; k < 4; k++) {
        /* Finer in the middle, where robots walk. */
        const float cx = 2 * (float)(i + (k == 1 || k == 2)) / (float)mesh - 1,
                    cy = 2 * (float)(j + (k >> 1)) / (float)mesh - 1;
        const float x = on_height(raster->world, 0, 2.5f + cx * (0.55f + 0.45f * fabsf(cx)) * 6),
                    y = on_height(raster->world, 1, 2.5f + cy * (0.55f + 0.45f * fabsf(cy)) * 6);
        const float z = height_at(raster->world, x, y, NULL);
        seen &= see(raster, (struct vector){x, y, z}, &corners[k]);
      }
      for (int t = 0; seen && t < 2; t++)
        fill(raster, corners, turns[t], NULL);
    }
}

/* Records the highest point toward the sun under each triangle of a face. */
static void cast(struct raster *raster, const struct vector corners[3])
{
  struct vector p[3];
  for (int k = 0; k < 3; k++)
    p[k] = on_shadow(raster, corners[k]);
  const float area = (p[1].x - p[0].x) * (p[2].y - p[0].y) - (p[2].x - p[0].x) * (p[1].y - p[0].y);
  if (fabsf(area) < 1e-6f)
    return;
  const int x0 = (int)clamp(fminf(fminf(p[0].x, p[1].x), p[2].x), 0, SHADOW_SIDE - 1),
            x1 = (int)clamp(fmaxf(fmaxf(p[0].x, p[1].x), p[2].x), 0, SHADOW_SIDE - 1),
            y0 = (int)clamp(fminf(fminf(p[0].y, p[1].y), p[2].y), 0, SHADOW_SIDE - 1),
            y1 = (int)clamp(fmaxf(fmaxf(p[0].y, p[1].y), p[2].y), 0, SHADOW_SIDE - 1);
  for (int py = y0; py <= y1; py++)
    for (int px = x0; px <= x1; px++) {
      const float fx = (float)px + 0.5f, fy = (float)py + 0.5f;
      const float a = ((p[1].x - fx) * (p[2].y - fy) - (p[2].x - fx) * (p[1].y - fy)) / area;
      const float b = ((p[2].x - fx) * (p[0].y - fy) - (p[0].x - fx) * (p[2].y - fy)) / area;
      const float height = a * p[0].z + b * p[1].z + (1 - a - b) * p[2].z;
      float *cell = &raster->shadow[py * SHADOW_SIDE + px];
      if (a >= 0 && b >= 0 && a + b <= 1 && height > *cell)
        *cell = height;
    }
}

static void draw_skin(struct raster *raster, const struct scene_body *body,
                      const struct vector *masses)
{
  static const float u[4] = {0, 1, 1, 0}, v[4] = {0, 0, 1, 1};
  for (uint32_t f = 0; f < body->n_faces; f++) {
    const uint16_t *face = body->faces + (size_t)f * 5;
    const uint16_t *voxel = body->voxels + (size_t)face[4] * 8;
    float length = 0;
    for (int k = 0; k < 4; k++) {
      const struct vector d = subtract(masses[voxel[k]], masses[voxel[7 - k]]);
      length += sqrtf(dot(d, d));
    }
    const float swelling = length / (4 * 0.17320508f) - 1;
    struct vertex corners[4];
    bool seen = true;
    for (int k = 0; k < 4; k++) {
      seen &= see(raster, masses[face[k]], &corners[k]);
      corners[k].u = u[k];
      corners[k].v = v[k];
    }
    for (int t = 0; seen && t < 2; t++)
      fill(raster, corners, turns[t], &swelling);
  }
}

/* Blends a color into the samples around a point of the world, in a disc of the given radius in
 * meters. */
static void blend_disc(struct raster *raster, struct vector at, float radius_m, struct vector color,
                       float strength, bool soft)
{
  struct vertex v;
  if (!see(raster, at, &v))
    return;
  const float radius = radius_m / v.w * raster->scale;
  const int x0 = (int)fmaxf(v.x - radius, 0), y0 = (int)fmaxf(v.y - radius, 0);
  const int x1 = (int)fminf(v.x + radius, (float)raster->width - 1),
            y1 = (int)fminf(v.y + radius, (float)raster->height - 1);
  for (int y = y0; y <= y1; y++)
    for (int x = x0; x <= x1; x++) {
      const float dx = (float)x + 0.5f - v.x, dy = (float)y + 0.5f - v.y;
      const float r = sqrtf(dx * dx + dy * dy) / radius;
      const size_t i = (size_t)y * raster->width + (size_t)x;
      if (r >= 1 || raster->depth[i] > 1.02f / v.w)
        continue;
      const float share = strength * (soft ? (1 - r) * (1 - r) * (1 - r) : 1);
      raster->color[i] = add(raster->color[i], times(subtract(color, raster->color[i]), share));
    }
}

/* The path of the center of mass so far, as dots so dense that they form a line. */
static void draw_trail(struct raster *raster, const struct scene *scene, uint32_t rollout,
                       double time_s)
{
  const struct vector orange = {0.94f, 0.63f, 0.19f};
  double before[3] = {0, 0, 0}, at[3];
  for (uint32_t frame = 0; frame * scene->frame_s <= time_s; frame++) {
    raster_center(scene, rollout, frame * scene->frame_s, at);
    const double dx = at[0] - before[0], dy = at[1] - before[1];
    const int n = frame > 0 ? 1 + (int)(sqrt(dx * dx + dy * dy) / 0.004) : 1;
    for (int k = 1; k <= n; k++) {
      const float share = frame > 0 ? (float)k / (float)n : 1;
      struct vector dot_at = {(float)before[0] + (float)dx * share,
                              (float)before[1] + (float)dy * share, 0};
      dot_at.z = height_at(raster->world, dot_at.x, dot_at.y, NULL) + 0.006f;
      blend_disc(raster, dot_at, TRAIL_M, orange, 0.9f, false);
    }
    memcpy(before, at, sizeof(before));
  }
}

/* ---- pictures ---- */

struct raster *raster_create(uint32_t width, uint32_t height)
{
  struct raster *raster = keep(calloc(1, sizeof(*raster)));
  raster->width = width * SAMPLES;
  raster->height = height * SAMPLES;
  const size_t n = (size_t)raster->width * raster->height;
  raster->depth = need(malloc(n * sizeof(float)));
  raster->color = need(malloc(n * sizeof(*raster->color)));
  raster->shadow = need(malloc((size_t)SHADOW_SIDE * SHADOW_SIDE * sizeof(float)));
  return raster;
}

static void begin(struct raster *raster, const struct raster_camera *camera)
{
  const size_t n = (size_t)raster->width * raster->height;
  const float level = cosf((float)camera->pitch) * (float)camera->distance_m;
  const float to_light = atan2f(raster->lamp.x - MIDDLE_M, raster->lamp.y - MIDDLE_M);
  const float yaw = to_light + (float)camera->yaw, sun_yaw = to_light + SUN_YAW;
  const struct vector target = {(float)camera->target_m[0], (float)camera->target_m[1],
                                (float)camera->target_m[2]};
  raster->eye = (struct vector){target.x - sinf(yaw) * level, target.y - cosf(yaw) * level,
                                target.z + sinf((float)camera->pitch) * (float)camera->distance_m};
  raster->forward = normal(subtract(target, raster->eye));
  raster->right = normal(cross(raster->forward, (struct vector){0, 0, 1}));
  raster->up = cross(raster->right, raster->forward);
  raster->scale = (float)raster->height / 2 / HALF_VIEW;
  raster->middle = target;
  /* Behind a viewer who looks toward the light, so that the visible sides are lit. */
  raster->sun = normal((struct vector){-0.7f * sinf(sun_yaw), -0.7f * cosf(sun_yaw), 1});
  raster->sun_right = normal(cross(raster->sun, (struct vector){0, 0, 1}));
  raster->sun_up = cross(raster->sun, raster->sun_right);
  memset(raster->depth, 0, n * sizeof(float));
  for (size_t i = 0; i < n; i++)
    raster->color[i] = raster->look->background;
  for (size_t i = 0; i < (size_t)SHADOW_SIDE * SHADOW_SIDE; i++)
    raster->shadow[i] = -1e9f;
}

static void write_pixel(struct vector color, uint8_t rgb[3])
{
  rgb[0] = (uint8_t)(clamp(color.x, 0, 1) * 255 + 0.5f);
  rgb[1] = (uint8_t)(clamp(color.y, 0, 1) * 255 + 0.5f);
  rgb[2] = (uint8_t)(clamp(color.z, 0, 1) * 255 + 0.5f);
}

/* Averages the samples of each pixel. */
static void resolve(const struct raster *raster, uint8_t *rgb)
{
  const uint32_t width = raster->width / SAMPLES, height = raster->height / SAMPLES;
  for (uint32_t y = 0; y < height; y++)
    for (uint32_t x = 0; x < width; x++) {
      struct vector sum = {0, 0, 0};
      for (uint32_t k = 0; k < SAMPLES * SAMPLES; k++) {
        const size_t row = (size_t)y * SAMPLES + k / SAMPLES;
        const size_t column = (size_t)x * SAMPLES + k % SAMPLES;
        sum = add(sum, raster->color[row * raster->width + column]);
      }
      write_pixel(times(sum, 1.0f / (SAMPLES * SAMPLES)), rgb + ((size_t)y * width + x) * 3);
    }
}

void raster_background(bool light, uint8_t rgb[3])
{
  write_pixel(looks[light].background, rgb);
}

void raster_draw(struct raster *raster, const struct scene *scene, uint32_t rollout, double time_s,
                 const struct raster_camera *camera, bool light, uint8_t *rgb)
{
  const struct scene_rollout *r = &scene->rollouts[rollout];
  const struct scene_body *body = &scene->bodies[r->body];
  const struct scene_world *world = &scene->worlds[r->world];
  const double end_s = (r->n_frames - 1) * scene->frame_s, t = time_s < end_s ? time_s : end_s;
  struct vector *masses = need(malloc((body->n_masses + (size_t)1) * sizeof(*masses)));
  raster->look = &looks[light];
  raster->world = world;
  const float *light_m =
      r->lights_m == NULL ? NULL : r->lights_m + 3 * (size_t)(t / scene->frame_s);
  const float x = light_m != NULL ? light_m[0] : (float)world->light_xy_m[0],
              y = light_m != NULL ? light_m[1] : (float)world->light_xy_m[1];
  raster->lamp = (struct vector){x, y, height_at(world, x, y, NULL) + 0.1f};
  begin(raster, camera);
  for (uint32_t i = 0; i < body->n_masses; i++)
    masses[i] = mass_at(r, body->n_masses, i, t / scene->frame_s);
  for (uint32_t f = 0; f < body->n_faces; f++) {
    const uint16_t *face = body->faces + (size_t)f * 5;
    for (int k = 0; k < 2; k++)
      cast(raster, (struct vector[3]){masses[face[turns[k][0]]], masses[face[turns[k][1]]],
                                      masses[face[turns[k][2]]]});
  }
  draw_ground(raster);
  draw_trail(raster, scene, rollout, t);
  draw_skin(raster, body, masses);
  blend_disc(raster, raster->lamp, 0.2f, raster->look->glow, 0.7f, true);
  blend_disc(raster, raster->lamp, 0.035f, (struct vector){1, 1, 1}, 1, false);
  free(masses);
  resolve(raster, rgb);
}

/* ---- PNG ---- */

static void put_u32(unsigned char *at, uint32_t value)
{
  for (int i = 0; i < 4; i++)
    at[i] = (unsigned char)(value >> (24 - 8 * i));
}

/* Appends a chunk: its length, its name, `n` bytes and their checksum. */
static size_t put_chunk(unsigned char *at, const char *name, const unsigned char *bytes, size_t n)
{
  put_u32(at, (uint32_t)n);
  memcpy(at + 4, name, 4);
  if (n > 0)
    memmove(at + 8, bytes, n);
  put_u32(at + 8 + n, (uint32_t)crc32(crc32(0, at + 4, 4), at + 8, (uInt)n));
  return n + 12;
}

/* Subtracts from each byte the one above it, because smooth pictures then compress well. */
static unsigned char *filter(const uint8_t *rgb, uint32_t width, uint32_t height)
{
  const size_t row = (size_t)width * 3;
  unsigned char *lines = need(malloc((row + 1) * height));
  for (uint32_t y = 0; y < height; y++) {
    unsigned char *line = lines + (row + 1) * y;
    line[0] = 2; /* the filter "up" */
    for (size_t i = 0; i < row; i++)
      line[1 + i] = (unsigned char)(rgb[row * y + i] - (y > 0 ? rgb[row * (y - 1) + i] : 0));
  }
  return lines;
}

unsigned char *png_encode(const uint8_t *rgb, uint32_t width, uint32_t height, size_t *size)
{
  static const unsigned char signature[8] = {0x89, 'P', 'N', 'G', '\r', '\n', 0x1A, '\n'};
  const uLong raw = ((uLong)width * 3 + 1) * height;
  uLongf packed = compressBound(raw);
  unsigned char *lines = filter(rgb, width, height);
  unsigned char *pixels = need(malloc(packed));
  unsigned char *file = need(malloc(packed + 80));
  unsigned char header[13] = {[8] = 8, [9] = 2}; /* 8 bits per color, RGB */
  size_t n = sizeof(signature);
  put_u32(header, width);
  put_u32(header + 4, height);
  need(compress2(pixels, &packed, lines, raw, 6) == Z_OK ? pixels : NULL);
  memcpy(file, signature, n);
  n += put_chunk(file + n, "IHDR", header, sizeof(header));
  n += put_chunk(file + n, "IDAT", pixels, packed);
  n += put_chunk(file + n, "IEND", NULL, 0);
  free(lines);
  free(pixels);
  *size = n;
  return file;
}
