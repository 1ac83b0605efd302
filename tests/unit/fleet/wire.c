/* wire.c: messages are decoded exactly as they were encoded, and no other message is accepted. */
#include "messages.h"
#include "rollout/physics.h"
#include "world/environment.h"

#define HEADER 24
#define LEASE  152
#define RESULT 40

static const struct mo_workspace workspaces[] = {{6, 6, 4}, {1, 1, 1}, {5, 3, 2}, {16, 8, 8}};

/* A message in either direction, decoded and re-encoded. */
struct message {
  bool is_leases;
  struct mo_workspace workspace;
  uint8_t *bytes; /* kept until the end of the case */
  size_t size;
};

static struct message leases_of(struct mo_workspace workspace, uint32_t n)
{
  struct message message = {true, workspace, NULL, 0};
  struct mo_wire_leases leases = {.n = n};
  for (uint32_t i = 0; i < n; i++)
    leases.items[i] = lease_of(workspace, i, 1 + 2 * i, 1 + i);
  make_check(mo_wire_put_leases(&leases, workspace, &message.bytes, &message.size), "leases");
  mo_wire_free_leases(&leases);
  check_keep(message.bytes, free);
  return message;
}

static struct message results_of(uint32_t n)
{
  struct message message = {false, MO_DEFAULT_WORKSPACE, NULL, 0};
  struct mo_wire_results results = {.n = n};
  for (uint32_t i = 0; i < n; i++)
    results.items[i] = result_of((struct mo_lease_id){9, i}, 3 * i);
  make_check(mo_wire_put_results(&results, &message.bytes, &message.size), "results");
  mo_wire_free_results(&results);
  check_keep(message.bytes, free);
  return message;
}

/* Decodes `size` bytes of a message, in an allocation of exactly that size. An accepted message
 * must encode to the same bytes; a refused one must be explained. */
static int decode(const struct message *message, size_t size, struct mo_message *why)
{
  struct mo_wire_leases leases;
  struct mo_wire_results results;
  uint8_t *exact = make_zeros(size, 1), *again = NULL;
  size_t again_size = 0;
  memcpy(exact, message->bytes, size);
  *why = (struct mo_message){""};
  int error = message->is_leases ? mo_wire_get_leases(exact, size, message->workspace, &leases, why)
                                 : mo_wire_get_results(exact, size, &results, why);
  if (error == MO_OK) {
    CHECK_OK(message->is_leases
                 ? mo_wire_put_leases(&leases, message->workspace, &again, &again_size)
                 : mo_wire_put_results(&results, &again, &again_size));
    CHECK(again_size == size && memcmp(exact, again, size) == 0);
    message->is_leases ? mo_wire_free_leases(&leases) : mo_wire_free_results(&results);
    free(again);
  } else {
    CHECK(error == MO_ERR_FORMAT || error == MO_ERR_UNSUPPORTED);
    CHECK(why->text[0] != '\0');
  }
  check_drop_from(exact);
  return error;
}

static void round_trip(void)
{
  struct mo_message why;
  for (size_t w = 0; w < COUNT(workspaces); w++) {
    for (uint32_t n = 0; n <= MO_WIRE_LEASES_MAX; n++) {
      const struct message message = leases_of(workspaces[w], n);
      CHECK_OK(decode(&message, message.size, &why));
    }
  }
  for (uint32_t n = 0; n <= MO_WIRE_RESULTS_MAX; n++) {
    const struct message message = results_of(n);
    CHECK_OK(decode(&message, message.size, &why));
  }
  /* Compares the values, not only the bytes. */
  struct mo_wire_leases leases;
  const struct mo_workspace workspace = MO_DEFAULT_WORKSPACE;
  struct mo_wire_lease sent = lease_of(workspace, 3, 7, 4);
  const struct message message = leases_of(workspace, 4);
  REQUIRE_OK(mo_wire_get_leases(message.bytes, message.size, workspace, &leases, &why));
  const struct mo_wire_lease *got = &leases.items[3];
  CHECK(got->id.epoch == 7 && got->id.number == 3 && got->back_end == MO_ON_DEVICE);
  CHECK(mo_sha256_equal(&got->controller, &sent.controller));
  CHECK(got->physics.scheme.n_steps == 103 && got->physics.scheme.impact == MO_IMPACT_BISECTION &&
        got->physics.constants.friction_cap == 0.95 &&
        got->physics.constants.stiffness_n_per_m == 15000.0);
  CHECK(got->n_rows == sent.n_rows && SAME(got->environments, sent.environments, 7));
  CHECK(SAME(got->blocks, sent.blocks, 4));
  got = &leases.items[2];
  CHECK(got->n_parameters == 1000 && got->gradient.adjoint_bound == MO_ADJOINT_BOUND &&
        got->gradient.weight == 1 && got->gradient.restart_weight == MO_RESTART_WEIGHT);
  mo_wire_free_leases(&leases);
  leases = (struct mo_wire_leases){1, {sent}};
  mo_wire_free_leases(&leases);
}

static void cut_short(void)
{
  struct mo_message why;
  const struct message messages[] = {leases_of(workspaces[0], 3), results_of(4)};
  for (size_t m = 0; m < COUNT(messages); m++) {
    struct message message = messages[m];
    for (size_t size = 0; size < message.size; size++) {
      const uint64_t claimed = size;
      CHECK_INT(decode(&message, size, &why), MO_ERR_FORMAT);
      if (size < HEADER)
        continue; /* the header also states the shorter size */
      memcpy(message.bytes + 16, &claimed, sizeof(claimed));
      CHECK_INT(decode(&message, size, &why), MO_ERR_FORMAT);
    }
  }
}

/* If any bit of any byte is flipped, the message is refused, or it means exactly what its bytes
 * say. */
static void bits_flipped(void)
{
  struct mo_message why;
  const struct message messages[] = {leases_of(workspaces[0], 2), leases_of(workspaces[1], 3),
                                     results_of(3)};
  for (size_t m = 0; m < COUNT(messages); m++) {
    for (size_t bit = 0; bit < messages[m].size * 8; bit++) {
      messages[m].bytes[bit / 8] ^= (uint8_t)(1u << bit % 8);
      int error = decode(&messages[m], messages[m].size, &why);
      if (bit < HEADER * 8)
        CHECK_INT(error, bit / 32 == 2 ? MO_ERR_UNSUPPORTED : MO_ERR_FORMAT);
      messages[m].bytes[bit / 8] ^= (uint8_t)(1u << bit % 8);
    }
  }
}

/* Bytes that a hostile peer writes into a good message: at an offset, a number of this many
 * bytes. */
static const struct hostile {
  bool is_leases;
  size_t at, size;
  uint64_t number;
  const char *says;
} hostiles[] = {
    {true, 0, 1, 'm', "must begin with \"MOFLEETL\""},
    {true, 8, 4, 2, "version 1, got 2"},
    {true, 12, 4, 5, "at most 4 items"},
    {true, 12, 4, UINT32_MAX, "at most 4 items"},
    {true, 12, 4, 0, "trailing data after the last item"},
    {true, 16, 8, UINT64_MAX, "the header gives a size"},
    {true, HEADER + 16, 4, 8, "unknown flags"},
    {true, HEADER + 20, 4, 0, "0 environments"},
    {true, HEADER + 20, 4, MO_WIRE_ENVIRONMENTS_MAX, "extends beyond the message"},
    {true, HEADER + 20, 4, MO_WIRE_ENVIRONMENTS_MAX + 1, "4097 environments"},
    {true, HEADER + 20, 4, UINT32_MAX, "4294967295 environments"},
    {true, HEADER + 24, 4, 0, "0 blocks"},
    {true, HEADER + 24, 4, UINT32_MAX, "4294967295 blocks"},
    {true, HEADER + 28, 4, MO_WIRE_ROWS_MAX + 1, "131073 rows"},
    {true, HEADER + 28, 4, 16, "its blocks have"},
    {true, HEADER + 64, 8, UINT64_C(0x7ff8000000000000), "dt_s"},
    {true, HEADER + 136, 4, 0, "n_steps"},
    {true, HEADER + 140, 4, 2, "unknown flags"},
    {true, HEADER + 144, 4, 53, "bisections"},
    {true, HEADER + 148, 4, 1, "unknown flags"},
    {true, HEADER + LEASE + 8, 8, UINT64_C(0x7ff0000000000000), "environment 0: number 1 must be"},
    {true, HEADER + LEASE + 528, 8, 0, "one connected piece"},
    {true, HEADER + LEASE + 528 + 17, 1, 0x80, "the body must be"},
    {true, HEADER + LEASE + 528 + 18, 1, 0, "1 to 16 environments, got 0"},
    {true, HEADER + LEASE + 528 + 18, 1, 17, "1 to 16 environments, got 17"},
    {true, HEADER + LEASE + 528 + 19, 2, 1, "environment 1 is out of range"},
    {false, 12, 4, 9, "at most 8 items"},
    {false, HEADER + 16, 4, 6, "unknown state 6"},
    {false, HEADER + 16, 4, MO_RESULT_DONE, "state 0 cannot have 0 rows"},
    {false, HEADER + 20, 4, 1, "state 1 cannot have 1 rows"},
    {false, HEADER + 24, 8, UINT64_C(0xbff0000000000000), "times must be"},
    {false, HEADER + 32, 8, UINT64_C(0x7ff8000000000000), "times must be"},
    {false, HEADER + RESULT + 20, 4, MO_WIRE_ROWS_MAX + 1, "cannot have 131073 rows"},
    {false, HEADER + RESULT + 20, 4, MO_WIRE_ROWS_MAX, "extends beyond the message"},
    {false, HEADER + 2 * RESULT, 8, UINT64_C(0x7ff8000000000000), "row 0: loss nan"},
    {false, HEADER + 2 * RESULT, 8, UINT64_C(0x7ff0000000000000), "row 0: loss inf"},
    {false, HEADER + 2 * RESULT, 8, UINT64_C(0xbff0000000000000), "row 0: loss -1"},
    {false, HEADER + 2 * RESULT, 8, UINT64_C(0x8000000000000000), "row 0: loss -0"},
    {false, HEADER + 2 * RESULT + 24, 4, 1, "divergence step 1"},
};

static void hostile(void)
{
  struct mo_message why;
  for (size_t h = 0; h < COUNT(hostiles); h++) {
    struct message message = hostiles[h].is_leases ? leases_of(workspaces[0], 1) : results_of(2);
    memcpy(message.bytes + hostiles[h].at, &hostiles[h].number, hostiles[h].size);
    CHECK(decode(&message, message.size, &why) != MO_OK);
    CHECK_SAYS(why, hostiles[h].says);
  }
}

/* A body that is not placed as mo_genotype_place would place it, and a bit beyond the last
 * voxel. */
static void bodies(void)
{
  struct mo_message why;
  struct message message = leases_of(workspaces[2], 1); /* 30 voxels in 4 bytes */
  uint8_t *genotype = message.bytes + HEADER + LEASE + 528;
  memset(genotype, 0, 4);
  genotype[0] = 1;
  CHECK_INT(decode(&message, message.size, &why), MO_ERR_FORMAT);
  CHECK_SAYS(why, "canonical place");
  genotype[3] = 0x40;
  CHECK_INT(decode(&message, message.size, &why), MO_ERR_FORMAT);
  CHECK_SAYS(why, "bits are set beyond voxel 29");
}

/* Gradients with out-of-range numbers. */
static void gradients(void)
{
  for (int fault = 0; fault < 10; fault++) {
    struct mo_wire_leases leases = {1, {lease_of(MO_DEFAULT_WORKSPACE, 2, 3, 4)}};
    struct mo_wire_results results = {1, {result_of((struct mo_lease_id){9, 2}, 6)}};
    struct mo_wire_lease *lease = &leases.items[0];
    struct mo_wire_result *result = &results.items[0];
    struct message message = {fault < 5, MO_DEFAULT_WORKSPACE, NULL, 0};
    struct mo_message why;
    switch (fault) {
    case 0: lease->gradient.weight = 0; break;
    case 1: lease->gradient.weight = NAN; break;
    case 2: lease->gradient.adjoint_bound = -1; break;
    case 3: lease->gradient.restart_weight = 2 * MO_RESTART_WEIGHT_MAX; break;
    case 4: lease->gradient.adjoint_rule = (enum mo_adjoint_rule)2; break;
    case 5: result->d_parameters[4] = INFINITY; break;
    case 6: result->counts.robots++; break;
    case 7: result->counts.clipped_steps = 41; break;
    case 8: result->counts.largest = NAN; break;
    default: result->counts.steps = UINT64_MAX; break;
    }
    make_check(message.is_leases
                   ? mo_wire_put_leases(&leases, message.workspace, &message.bytes, &message.size)
                   : mo_wire_put_results(&results, &message.bytes, &message.size),
               "a message");
    CHECK_INT(decode(&message, message.size, &why), MO_ERR_FORMAT);
    free(message.bytes);
    mo_wire_free_leases(&leases);
    mo_wire_free_results(&results);
  }
}

/* Gives a result measures, some without a value. */
static void measure(struct mo_wire_result *result)
{
  result->measures = calloc(result->n_rows, sizeof(*result->measures));
  make_check(result->measures != NULL ? MO_OK : MO_ERR_NO_MEMORY, "measures");
  for (uint32_t row = 0; row < result->n_rows; row++)
    for (unsigned m = 0; m < MO_MEASURES; m++)
      result->measures[row][m] = result->diverged_steps[row] > 0 || (row + m) % 7 == 3
                                     ? -(double)NAN
                                     : (row - 2.0 * m) / mo_measure_info[m].steps_in_one;
}

/* Measures keep their bits, and only rounded numbers are accepted. Those without a value all have
 * the same bits. */
static void measures(void)
{
  enum { FIRST = HEADER + RESULT + 6 * 12 + 8 };
  const struct mo_workspace workspace = MO_DEFAULT_WORKSPACE;
  struct mo_wire_leases leases = {1, {lease_of(workspace, 0, 3, 4)}}, got_leases;
  struct mo_wire_results results = {1, {result_of((struct mo_lease_id){9, 0}, 6)}}, got;
  struct message sent = {true, workspace, NULL, 0}, back = {false, workspace, NULL, 0};
  struct mo_wire_result *result = &results.items[0];
  struct mo_message why;
  const double none = NAN;
  measure(result);
  leases.items[0].has_measures = true;
  make_check(mo_wire_put_leases(&leases, workspace, &sent.bytes, &sent.size), "a lease");
  check_keep(sent.bytes, free);
  make_check(mo_wire_put_results(&results, &back.bytes, &back.size), "a result");
  check_keep(back.bytes, free);
  CHECK_INT(back.size, FIRST + 6 * sizeof(*result->measures));
  CHECK_OK(decode(&sent, sent.size, &why));
  CHECK_OK(decode(&back, back.size, &why));
  REQUIRE_OK(mo_wire_get_leases(sent.bytes, sent.size, workspace, &got_leases, &why));
  CHECK(got_leases.items[0].has_measures);
  REQUIRE_OK(mo_wire_get_results(back.bytes, back.size, &got, &why));
  for (uint32_t row = 0; row < 6; row++)
    for (unsigned m = 0; m < MO_MEASURES; m++) {
      const double *a = &got.items[0].measures[row][m], *b = &result->measures[row][m];
      CHECK(memcmp(a, isnan(*b) ? &none : b, sizeof(*a)) == 0);
    }
  mo_wire_free_leases(&got_leases);
  mo_wire_free_results(&got);
  for (size_t size = back.size - 1; size > HEADER + RESULT; size--) {
    const uint64_t claimed = size;
    memcpy(back.bytes + 16, &claimed, sizeof(claimed));
    CHECK_INT(decode(&back, size, &why), MO_ERR_FORMAT);
  }
  const uint64_t whole = back.size;
  memcpy(back.bytes + 16, &whole, sizeof(whole));
  static const struct {
    double value;
    const char *says;
  } wrong[] = {{1e-7, "displacement_m is 1e-07, which is not rounded"},
               {INFINITY, "not rounded"},
               {-(double)NAN, "not rounded"}};
  for (size_t i = 0; i < COUNT(wrong); i++) {
    memcpy(back.bytes + FIRST, &wrong[i].value, sizeof(double));
    CHECK_INT(decode(&back, back.size, &why), MO_ERR_FORMAT);
    CHECK_SAYS(why, wrong[i].says);
  }
  result->measures[4][0] = 1; /* this row diverged */
  CHECK(result->diverged_steps[4] > 0);
  uint8_t *bytes = NULL;
  make_check(mo_wire_put_results(&results, &bytes, &back.size), "a result");
  back.bytes = bytes;
  CHECK_INT(decode(&back, back.size, &why), MO_ERR_FORMAT);
  CHECK_SAYS(why, "diverged has no measures");
  bytes[FIRST - 8] = MO_MEASURES - 1;
  CHECK_INT(decode(&back, back.size, &why), MO_ERR_FORMAT);
  CHECK_SAYS(why, "must have 20 measures for each row, got 19");
  free(bytes);
  sent.bytes[HEADER + 16] |= 1; /* on a device */
  CHECK_OK(decode(&sent, sent.size, &why));
  sent.bytes[HEADER + 16] |= 2; /* a gradient */
  CHECK_INT(decode(&sent, sent.size, &why), MO_ERR_FORMAT);
  CHECK_SAYS(why, "unknown flags");
  mo_wire_free_leases(&leases);
  mo_wire_free_results(&results);
}

/* Physics has the first version that has all its settings. */
static void later_physics(void)
{
  static const struct {
    double period_s;
    enum mo_integrator integrator;
    unsigned version;
    size_t added; /* to the size of version 1 */
  } given[] = {{0, MO_INTEGRATOR_PAPER, 1, 0},
               {0.016, MO_INTEGRATOR_PAPER, 2, 8},
               {0, MO_INTEGRATOR_SPLIT, 3, 12},
               {0.016, MO_INTEGRATOR_SPLIT, 3, 12}};
  enum { VERSION = HEADER + 17, INTEGRATOR = HEADER + 64 + 10 * 8 + 3 * 4 };
  const struct mo_workspace workspace = MO_DEFAULT_WORKSPACE;
  const size_t size = leases_of(workspace, 1).size;
  for (size_t i = 0; i < COUNT(given); i++) {
    struct mo_wire_leases leases = {1, {lease_of(workspace, 0, 1, 1)}}, got;
    struct message message = {true, workspace, NULL, 0};
    struct mo_physics *physics = &leases.items[0].physics;
    struct mo_message why;
    physics->scheme.control_period_s = given[i].period_s;
    physics->scheme.integrator = given[i].integrator;
    make_check(mo_wire_put_leases(&leases, workspace, &message.bytes, &message.size), "a lease");
    check_keep(message.bytes, free);
    CHECK_INT(message.size, size + given[i].added);
    CHECK_INT(message.bytes[VERSION], given[i].version - 1);
    CHECK_OK(decode(&message, message.size, &why));
    REQUIRE_OK(mo_wire_get_leases(message.bytes, message.size, workspace, &got, &why));
    CHECK(mo_physics_equal(&got.items[0].physics, physics));
    mo_wire_free_leases(&got);
    mo_wire_free_leases(&leases);
    if (given[i].version < 3)
      continue;
    CHECK_INT(message.bytes[INTEGRATOR], MO_INTEGRATOR_SPLIT);
    /* An unknown word, and a version that the settings do not need. */
    for (uint8_t word = 0; word <= 2; word += 2) {
      message.bytes[INTEGRATOR] = word;
      CHECK_INT(decode(&message, message.size, &why), MO_ERR_FORMAT);
      CHECK_SAYS(why, "unknown flags");
    }
  }
}

/* A message that does not fit the format is not sent. */
static void too_large(void)
{
  const struct mo_workspace workspace = MO_DEFAULT_WORKSPACE;
  struct mo_wire_leases leases = {1, {lease_of(workspace, 1, 3, 2)}};
  struct mo_wire_results results = {1, {result_of((struct mo_lease_id){1, 1}, 2)}};
  struct mo_message why;
  uint8_t *bytes = NULL;
  size_t size = 0;
  CHECK_INT(mo_wire_put_leases(&leases, (struct mo_workspace){41, 5, 5}, &bytes, &size),
            MO_ERR_LIMIT);
  CHECK_INT(mo_wire_get_leases(bytes, 0, (struct mo_workspace){41, 5, 5},
                               &(struct mo_wire_leases){0}, &why),
            MO_ERR_LIMIT);
  CHECK_SAYS(why, "at most 1024 voxels");
  leases.items[0].n_rows++;
  CHECK_INT(mo_wire_put_leases(&leases, workspace, &bytes, &size), MO_ERR_LIMIT);
  leases.items[0].n_rows--;
  leases.items[0].n_environments = MO_WIRE_ENVIRONMENTS_MAX + 1;
  CHECK_INT(mo_wire_put_leases(&leases, workspace, &bytes, &size), MO_ERR_LIMIT);
  leases.items[0].n_environments = 3;
  leases.items[0].n_parameters = 1; /* for blocks with more than one environment */
  CHECK_INT(mo_wire_put_leases(&leases, workspace, &bytes, &size), MO_ERR_LIMIT);
  leases.items[0].n_parameters = 0;
  leases.items[0].blocks[1].n_environments = 0;
  CHECK_INT(mo_wire_put_leases(&leases, workspace, &bytes, &size), MO_ERR_LIMIT);
  results.items[0].n_parameters = MO_WIRE_PARAMETERS_MAX + 1;
  CHECK_INT(mo_wire_put_results(&results, &bytes, &size), MO_ERR_LIMIT);
  results.items[0].n_parameters = 0;
  results.items[0].n_rows = MO_WIRE_ROWS_MAX + 1;
  CHECK_INT(mo_wire_put_results(&results, &bytes, &size), MO_ERR_LIMIT);
  results.items[0].n_rows = 0;
  CHECK_INT(mo_wire_put_results(&results, &bytes, &size), MO_ERR_LIMIT);
  CHECK(bytes == NULL);
  mo_wire_free_leases(&leases);
  mo_wire_free_results(&results);
}

/* Environments with grids of other sizes, among others: the same after a round trip, cut anywhere,
 * and with sizes that do not fit. */
static void grids(void)
{
  const struct mo_workspace workspace = MO_DEFAULT_WORKSPACE;
  struct message message = {true, workspace, NULL, 0};
  struct mo_wire_leases sent = {.n = 1, .items = {lease_of(workspace, 0, 3, 2)}}, got;
  struct mo_message why;
  for (uint32_t e = 0; e < 3; e += 2) {
    struct mo_environment *environment = &sent.items[0].environments[e];
    memset(environment->terrain_heights_m, 0, sizeof(environment->terrain_heights_m));
    environment->grid = make_grid(3 + 20 * e, 2 + 5 * e, 0.2, e, 0.1);
    environment->drop_m = 0.25 * e;
    mo_terrain_grid_hold(environment->grid);
  }
  REQUIRE_OK(mo_wire_put_leases(&sent, workspace, &message.bytes, &message.size));
  check_keep(message.bytes, free);
  REQUIRE_OK(mo_wire_get_leases(message.bytes, message.size, workspace, &got, &why));
  for (uint32_t e = 0; e < 3; e++) {
    struct mo_sha256 hashes[2];
    mo_environment_digest(&sent.items[0].environments[e], &hashes[0]);
    mo_environment_digest(&got.items[0].environments[e], &hashes[1]);
    CHECK(mo_sha256_equal(&hashes[0], &hashes[1]));
    CHECK((got.items[0].environments[e].grid != NULL) == (e != 1));
  }
  mo_wire_free_leases(&got);
  mo_wire_free_leases(&sent);
  CHECK_OK(decode(&message, message.size, &why));
  for (size_t size = 0; size < message.size; size += 1 + size / 9)
    CHECK_INT(decode(&message, size, &why), MO_ERR_FORMAT);
  uint8_t *columns = NULL; /* of the first grid: 3 and 2, 0.2 m */
  const uint32_t sides[2] = {3, 2};
  for (size_t at = 0; at + 16 < message.size && columns == NULL; at++)
    if (memcmp(message.bytes + at, sides, sizeof(sides)) == 0)
      columns = message.bytes + at;
  REQUIRE(columns != NULL);
  for (uint32_t n = 0; n < 256; n++)
    if (n != 3) {
      columns[0] = (uint8_t)n;
      CHECK_INT(decode(&message, message.size, &why), MO_ERR_FORMAT);
    }
}

static const struct check_case cases[] = {
    {"round trip", round_trip},
    {"grids of other sizes", grids},
    {"cut short", cut_short},
    {"any bit flipped", bits_flipped},
    {"hostile numbers", hostile},
    {"bodies", bodies},
    {"gradients", gradients},
    {"sends measures with their bits", measures},
    {"versions of physics", later_physics},
    {"too large to send", too_large},
};
CHECK_MAIN(cases)
