/* atlas_file.c: writes an atlas file with invented losses, for tests of programs that read one:
 * `atlas-file PATH VOXELS LEVELS SEED [canonical|images [SIDE [MEASURES]]]`.
 *
 * A loss is one of LEVELS values from 0 to below 1 that depend on the body, the environment and the
 * seed; few levels make many equal scores. In every 41st body a rollout diverged. Environments are
 * those of the paper's test set. SIDE: of a cubic workspace instead of the default one, which is 0.
 * MEASURES: a set as bits; where a rollout diverged, they have no value. */
#include "fixture.h"

static double loss_of(const uint64_t *form, uint32_t environment, uint64_t levels, uint64_t seed)
{
  const uint64_t words[] = {form[0], form[1], form[2], environment, seed};
  const uint64_t drawn = mo_form_hash((const uint8_t *)words, sizeof(words));
  return drawn % 41 == 0 && environment == 0 ? (double)INFINITY
                                             : (double)(drawn % levels) / (double)levels;
}

static int write_all(const char *path, const struct mo_atlas_source *source, uint64_t levels,
                     uint64_t seed, struct mo_message *message)
{
  struct mo_environment environments[MO_PAPER_TEST_COUNT];
  struct mo_atlas_writer *writer = NULL;
  struct mo_atlas_bodies *bodies = NULL;
  double losses[MO_PAPER_TEST_COUNT], measures[MO_MEASURES];
  mo_environment_paper_test(environments);
  int error =
      mo_atlas_writer_create(path, source, environments, MO_PAPER_TEST_COUNT, &writer, message);
  if (error == MO_OK)
    error = mo_atlas_bodies_create(&source->scope, &bodies);
  while (error == MO_OK && mo_atlas_writer_position(writer) < mo_atlas_writer_bodies(writer)) {
    uint64_t form[MO_DEFAULT_WORDS] = {0};
    error = mo_atlas_bodies_next(bodies, form);
    for (uint32_t e = 0; e < MO_PAPER_TEST_COUNT; e++)
      losses[e] = loss_of(form, e, levels, seed);
    for (uint32_t m = 0; m < MO_MEASURES; m++)
      measures[m] = isinf(losses[0]) ? NAN : 10 * loss_of(form, 100 + m, levels, seed) - 4;
    if (error == MO_OK)
      error = mo_atlas_writer_add(writer, form, losses, measures);
  }
  if (error == MO_OK)
    error = mo_atlas_writer_finish(writer, message);
  mo_atlas_bodies_free(bodies);
  mo_atlas_writer_free(writer);
  return error;
}

int main(int argc, char **argv)
{
  struct mo_message message = {""};
  if (argc < 5) {
    fprintf(stderr, "atlas-file PATH VOXELS LEVELS SEED [canonical|images [SIDE [MEASURES]]]\n");
    return 2;
  }
  struct mo_atlas_source source = fixture_source((uint32_t)strtoul(argv[2], NULL, 10));
  source.orientations =
      argc > 5 && strcmp(argv[5], "images") == 0 ? MO_ATLAS_IMAGES : MO_ATLAS_CANONICAL;
  const uint16_t side = argc > 6 ? (uint16_t)strtoul(argv[6], NULL, 10) : 0;
  if (side > 0)
    source.scope.workspace = (struct mo_workspace){side, side, side};
  source.measures = argc > 7 ? (uint32_t)strtoul(argv[7], NULL, 10) : 0;
  const int error = write_all(argv[1], &source, strtoull(argv[3], NULL, 10),
                              strtoull(argv[4], NULL, 10), &message);
  if (error != MO_OK)
    fprintf(stderr, "%s: %s %s\n", argv[1], mo_error_text(error), message.text);
  return error != MO_OK;
}
