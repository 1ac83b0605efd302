/* answers.c: writes an atlas with invented losses, and prints what the library answers about some
 * of its bodies, for tests of other readers: `atlas-answers PATH VOXELS LEVELS [CONTROLLER
 * [PHYSICS]]`. Controller and physics are SHA-256 in hexadecimal digits. */
#include "fixture.h"

#include <inttypes.h>
#include <stdlib.h>

#define EVERY 7 /* coprime to the numbers of bodies that tests use */

static void print_body(const struct mo_atlas *atlas, const struct mo_atlas_index *index,
                       const struct mo_atlas_basins *basins, uint64_t position)
{
  struct mo_atlas_neighbor neighbors[MO_ATLAS_NEIGHBORS_MAX];
  uint64_t form[MO_DEFAULT_WORDS] = {0};
  float losses[MO_ATLAS_ENVIRONMENTS_MAX];
  const uint32_t n_voxels = mo_atlas_form(atlas, position, form);
  const uint32_t n = mo_atlas_neighbors(atlas, position,
                                        MO_ATLAS_ADD | MO_ATLAS_REMOVE | MO_ATLAS_MOVE, neighbors);
  const struct mo_atlas_rank all = mo_atlas_rank_of(index, position, false);
  const struct mo_atlas_rank own = mo_atlas_rank_of(index, position, true);
  const uint64_t optimum = mo_atlas_optimum_of(basins, position);
  const char *const steps[] = {[1] = "add", [2] = "remove", [4] = "move"};
  mo_atlas_losses(atlas, position, losses);
  printf("{\"position\": %" PRIu64 ", \"voxels\": %" PRIu32 ", \"genotype\": \"", position,
         n_voxels);
  for (uint32_t v = 0; v < 144; v++)
    putchar(form[v / 64] >> v % 64 & 1 ? '1' : '0');
  printf("\", \"score\": %.9g, \"loss\": %.9g, \"rank\": %" PRIu64 ", \"rank_of_size\": %" PRIu64
         ", \"percentile\": %.17g, \"neighbors\": %" PRIu32,
         (double)mo_atlas_score(atlas, position), (double)losses[1], all.better + 1, own.better + 1,
         all.percentile, n);
  if (n > 0)
    printf(", \"best\": %" PRIu64 ", \"step\": \"%s\"", neighbors[0].position,
           steps[neighbors[0].step]);
  printf(", \"optimum\": %" PRIu64 ", \"basin\": %" PRIu64 "}", optimum,
         mo_atlas_basin_of(basins, optimum));
}

static int print_all(const struct mo_atlas *atlas)
{
  struct mo_atlas_index *index = NULL;
  struct mo_atlas_basins *basins = NULL;
  int error = mo_atlas_index_create(atlas, &index);
  if (error == MO_OK)
    error = mo_atlas_basins_create(atlas, index, NULL, &basins);
  if (error == MO_OK) {
    const uint64_t n = mo_atlas_bodies_of(atlas);
    printf("{\"bodies\": %" PRIu64 ", \"optima\": %" PRIu64 ", \"items\": [", n,
           mo_atlas_optima(basins));
    for (uint64_t i = 0; i < n; i += EVERY) {
      fputs(i > 0 ? ",\n" : "", stdout);
      print_body(atlas, index, basins, i);
    }
    puts("]}");
  }
  mo_atlas_basins_free(basins);
  mo_atlas_index_free(index);
  return error;
}

static int read_hash(const char *text, uint8_t hash[32])
{
  if (strlen(text) != 64)
    return MO_ERR_FORMAT;
  for (int i = 0; i < 32; i++) {
    const char digits[] = {text[2 * i], text[2 * i + 1], '\0'};
    hash[i] = (uint8_t)strtoul(digits, NULL, 16);
  }
  return MO_OK;
}

int main(int n, char **words)
{
  struct mo_environment environments[MO_PAPER_TEST_COUNT];
  struct mo_message message = {""};
  struct mo_atlas *atlas = NULL;
  if (n < 4 || n > 6)
    return 2;
  struct mo_atlas_source source = fixture_source((uint32_t)strtoul(words[2], NULL, 10));
  mo_environment_paper_test(environments);
  environments[1].task.guide = (struct mo_guide){.kind = MO_GUIDE_AHEAD, .distance_m = 1.5};
  environments[1].task.objective = MO_OBJECTIVE_TRAVEL;
  environments[1].light_xy_m[0] = environments[1].light_xy_m[1] = 0;
  environments[2].task = environments[1].task;
  environments[2].light_xy_m[0] = environments[2].light_xy_m[1] = 0;
  environments[2].factors = mo_factors_ones();
  environments[2].factors.mass = 1.25;
  int error = n > 4 ? read_hash(words[4], source.controller_sha256) : MO_OK;
  if (error == MO_OK && n > 5)
    error = read_hash(words[5], source.physics_sha256);
  if (error == MO_OK)
    error = fixture_write(&mo_system_files, words[1], &source, environments, 3,
                          strtoull(words[3], NULL, 10), &message);
  if (error == MO_OK)
    error = mo_atlas_open(words[1], &atlas, &message);
  if (error == MO_OK)
    error = print_all(atlas);
  if (error != MO_OK)
    fprintf(stderr, "%s: %s\n", mo_error_text(error), message.text);
  mo_atlas_close(atlas);
  return error != MO_OK;
}
