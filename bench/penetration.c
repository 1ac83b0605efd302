/* penetration.c: how deep the masses of robots get into their own voxels.
 *
 * Nothing in the model keeps the parts of a body apart: masses touch the terrain, not each other.
 * This measures how often and how far evolution uses that. Each body is simulated with the default
 * physics in the paper's test set; at the start of each control period, every mass that is not a
 * corner of a voxel is looked for in it. A voxel is the trilinear image of the unit cube that its
 * corners span; the depth of a mass is the distance of its local coordinates to the nearest face,
 * as a share of the edge: at most 0.5, also for a mass that went further. Masses within NEAR of a
 * face are ignored: neighbors that share it may touch there. */
#include "bench.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#define NEAR         0.1
#define DEEP         0.3
#define NEWTON_STEPS 8
#define ROBOT_MAX    128 /* characters of a line */
#define BODIES_MAX   100000
#define GROUP        64 /* bodies that are simulated together */

struct bench {
  struct bench_scene scene;
  struct mo_compute *compute;
  struct mo_compute_controller *controller;
  struct mo_physics physics;
  struct mo_body **bodies; /* (n) */
  uint32_t n, stride, frames;
};

struct found {
  double deepest;          /* share of an edge; 0: no mass got into a voxel */
  uint32_t frames, deep;   /* frames of all rollouts with a mass in a voxel, and with one as deep as
                              DEEP */
  uint32_t rollouts, most; /* rollouts with such a frame; masses in voxels in the worst frame */
};

/* ---- one mass and one voxel ---- */

/* The corners of a voxel, in ascending order of lattice masses: x, then y, then z. */
struct voxel {
  double corners[8][3], lo[3], hi[3];
};

static struct voxel voxel_at(const float *masses, const uint32_t corners[8])
{
  struct voxel voxel = {.lo = {INFINITY, INFINITY, INFINITY},
                        .hi = {-INFINITY, -INFINITY, -INFINITY}};
  for (unsigned c = 0; c < 8; c++)
    for (unsigned axis = 0; axis < 3; axis++) {
      const double x = masses[3 * (size_t)corners[c] + axis];
      voxel.corners[c][axis] = x;
      voxel.lo[axis] = fmin(voxel.lo[axis], x);
      voxel.hi[axis] = fmax(voxel.hi[axis], x);
    }
  return voxel;
}

/* Computes the image of local coordinates, and its derivatives by each of them. */
static void map(const struct voxel *voxel, const double local[3], double x[3], double by[3][3])
{
  memset(x, 0, 3 * sizeof(double));
  memset(by, 0, 9 * sizeof(double));
  for (unsigned c = 0; c < 8; c++) {
    const bool high[3] = {(c & 4) != 0, (c & 2) != 0, (c & 1) != 0};
    double w[3];
    for (unsigned i = 0; i < 3; i++)
      w[i] = high[i] ? local[i] : 1 - local[i];
    for (unsigned axis = 0; axis < 3; axis++) {
      const double corner = voxel->corners[c][axis];
      x[axis] += w[0] * w[1] * w[2] * corner;
      by[0][axis] += (high[0] ? 1 : -1) * w[1] * w[2] * corner;
      by[1][axis] += (high[1] ? 1 : -1) * w[0] * w[2] * corner;
      by[2][axis] += (high[2] ? 1 : -1) * w[0] * w[1] * corner;
    }
  }
}

static double determinant(const double a[3], const double b[3], const double c[3])
{
  return a[0] * (b[1] * c[2] - b[2] * c[1]) - a[1] * (b[0] * c[2] - b[2] * c[0]) +
         a[2] * (b[0] * c[1] - b[1] * c[0]);
}

/* Returns how deep a point is in a voxel, as a share of the edge; 0: it is outside, or the voxel is
 * inside out there, or so distorted that the search for local coordinates fails. */
static double depth_in(const struct voxel *voxel, const double point[3])
{
  double local[3] = {0.5, 0.5, 0.5}, x[3], by[3][3];
  for (unsigned step = 0; step < NEWTON_STEPS; step++) {
    map(voxel, local, x, by);
    const double size = determinant(by[0], by[1], by[2]);
    const double off[3] = {point[0] - x[0], point[1] - x[1], point[2] - x[2]};
    if (!(size > 0))
      return 0;
    local[0] += determinant(off, by[1], by[2]) / size;
    local[1] += determinant(by[0], off, by[2]) / size;
    local[2] += determinant(by[0], by[1], off) / size;
  }
  map(voxel, local, x, by);
  double depth = 1;
  for (unsigned i = 0; i < 3; i++) {
    depth = fmin(depth, fmin(local[i], 1 - local[i]));
    if (!(fabs(point[i] - x[i]) < 1e-6 * MO_VOXEL_M))
      return 0;
  }
  return depth > 0 ? depth : 0;
}

/* ---- one body ---- */

static bool is_corner(const uint32_t corners[8], uint32_t mass)
{
  for (unsigned c = 0; c < 8; c++)
    if (corners[c] == mass)
      return true;
  return false;
}

/* Looks at one frame. Returns the number of masses in voxels; *deepest grows. */
static uint32_t look_at(const struct mo_body *body, const float *masses, double *deepest)
{
  double *of_mass = bench_zeros(body->n_masses, sizeof(*of_mass));
  uint32_t n = 0;
  for (uint32_t v = 0; v < body->n_voxels; v++) {
    const uint32_t *corners = body->voxel_mass + 8 * (size_t)v;
    const struct voxel voxel = voxel_at(masses, corners);
    for (uint32_t m = 0; m < body->n_masses; m++) {
      const float *at = masses + 3 * (size_t)m;
      const double point[3] = {at[0], at[1], at[2]};
      bool is_near = true;
      for (unsigned axis = 0; axis < 3; axis++)
        is_near = is_near && point[axis] > voxel.lo[axis] && point[axis] < voxel.hi[axis];
      if (is_near && !is_corner(corners, m))
        of_mass[m] = fmax(of_mass[m], depth_in(&voxel, point));
    }
  }
  for (uint32_t m = 0; m < body->n_masses; m++) {
    n += of_mass[m] > NEAR;
    *deepest = fmax(*deepest, of_mass[m]);
  }
  free(of_mass);
  return n;
}

static struct found look(const struct bench *b, const struct mo_body *body,
                         const struct mo_recording *recordings, const struct mo_outcome *outcomes)
{
  struct found found = {0};
  for (uint32_t k = 0; k < MO_PAPER_TEST_COUNT; k++) {
    bool counts = false;
    if (outcomes[k].diverged_step != 0)
      continue;
    for (uint32_t frame = 0; frame < b->frames; frame++) {
      double deepest = 0;
      const uint32_t n =
          look_at(body, recordings[k].mass_m + 3 * (size_t)frame * body->n_masses, &deepest);
      if (n == 0)
        continue;
      found.frames++;
      found.deep += deepest > DEEP;
      found.most = n > found.most ? n : found.most;
      found.deepest = fmax(found.deepest, deepest);
      counts = true;
    }
    found.rollouts += counts;
  }
  return found;
}

/* ---- all bodies ---- */

/* Reads a robot per line; what follows a comma is ignored. */
static void read_bodies(struct bench *b, const char *path)
{
  FILE *file = fopen(path, "r");
  char line[ROBOT_MAX + 2];
  b->bodies = bench_zeros(BODIES_MAX, sizeof(void *));
  if (file == NULL) {
    perror(path);
    exit(1);
  }
  while (fgets(line, sizeof(line), file) != NULL) {
    const size_t length = strcspn(line, "\r\n,");
    uint64_t bits[MO_SMALL_VOXELS / 64];
    int orientation;
    line[length] = '\0';
    bench_check(b->n < BODIES_MAX ? MO_OK : MO_ERR_LIMIT, "too many designs");
    bench_check(mo_genotype_from_robot(MO_DEFAULT_WORKSPACE, line, length, bits, &orientation),
                line);
    bench_check(mo_body_create(b->scene.lattice, bits, &b->bodies[b->n++]), "body");
  }
  fclose(file);
}

static void simulate(const struct bench *b, uint32_t first, uint32_t n, struct found *found)
{
  static struct mo_recording recordings[GROUP][MO_PAPER_TEST_COUNT];
  struct mo_block *blocks = bench_zeros(n, sizeof(*blocks));
  for (uint32_t i = 0; i < n; i++) {
    const struct mo_body *body = b->bodies[first + i];
    blocks[i] = (struct mo_block){.body = body,
                                  .controller = b->controller,
                                  .n_environments = MO_PAPER_TEST_COUNT,
                                  .physics = b->physics,
                                  .precision = MO_FLOAT32,
                                  .recordings = recordings[i]};
    for (uint32_t k = 0; k < MO_PAPER_TEST_COUNT; k++) {
      blocks[i].environments[k] = b->scene.list[k];
      bench_check(mo_recording_create(&recordings[i][k], MO_RECORD_MASSES, b->stride, b->frames,
                                      body->n_masses, body->n_springs),
                  "recordings");
    }
  }
  bench_check(mo_compute_run(b->compute, blocks, n), "rollouts");
  for (uint32_t i = 0; i < n; i++) {
    found[first + i] = look(b, b->bodies[first + i], recordings[i], blocks[i].outcomes);
    for (uint32_t k = 0; k < MO_PAPER_TEST_COUNT; k++)
      mo_recording_free(&recordings[i][k]);
  }
  free(blocks);
}

static void report(const struct bench *b, const struct found *found)
{
  const double all = (double)b->frames * MO_PAPER_TEST_COUNT;
  double *depths = bench_zeros(b->n, sizeof(*depths)), share = 0, deep_share = 0;
  uint32_t any = 0, deep = 0;
  printf("body,voxels,masses,deepest,rollouts,share,deep_share,most_masses\n");
  for (uint32_t i = 0; i < b->n; i++) {
    const struct found *f = &found[i];
    printf("%u,%u,%u,%.3f,%u,%.4f,%.4f,%u\n", i, b->bodies[i]->n_voxels, b->bodies[i]->n_masses,
           f->deepest, f->rollouts, f->frames / all, f->deep / all, f->most);
    any += f->frames > 0;
    deep += f->deep > 0;
    share += f->frames / all / b->n;
    deep_share += f->deep / all / b->n;
    depths[i] = f->deepest;
  }
  fprintf(stderr,
          "%u bodies, %u environments each: a mass deeper than %.1f of an edge in a voxel of its "
          "own body: %u bodies (%.1f %%), %.2f %% of the time; deeper than %.1f: %u bodies "
          "(%.1f %%), %.2f %% of the time; deepest per body: median %.2f, 90 %% %.2f\n",
          b->n, (unsigned)MO_PAPER_TEST_COUNT, NEAR, any, 100.0 * any / b->n, 100 * share, DEEP,
          deep, 100.0 * deep / b->n, 100 * deep_share, bench_median(depths, b->n),
          bench_quantile(depths, b->n, 0.9));
}

int bench_penetration(const struct bench_options *options)
{
  struct bench b = {.physics = mo_default_physics()};
  const uint32_t n = options->bodies > 0 ? options->bodies : options->quick ? 20 : 200;
  bench_scene_create(&b.scene, options, options->designs == NULL ? n : 1);
  b.bodies = options->designs == NULL ? b.scene.bodies : NULL;
  b.n = options->designs == NULL ? n : 0;
  if (options->designs != NULL)
    read_bodies(&b, options->designs);
  b.physics.scheme.control_period_s = MO_DEFAULT_CONTROL_PERIOD_S;
  b.stride = mo_control_steps(&b.physics.scheme);
  b.frames = mo_recording_frames(&b.physics, b.stride);
  b.compute = bench_compute(options->workers, options->isa);
  bench_check(mo_compute_controller_create(b.compute, b.scene.controller, &b.controller),
              "controller");
  struct found *found = bench_zeros(b.n, sizeof(*found));
  for (uint32_t first = 0; first < b.n; first += GROUP)
    simulate(&b, first, b.n - first < GROUP ? b.n - first : GROUP, found);
  report(&b, found);
  return 0;
}
