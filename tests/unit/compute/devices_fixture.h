/* Back ends with any number of devices, from a module that computes on the processor
 * (tests/device/fake.c), and functions that compute with them. */
#ifndef MORPHO_TEST_DEVICES_FIXTURE_H
#define MORPHO_TEST_DEVICES_FIXTURE_H

#include "fixture.h"

#if defined(__SANITIZE_ADDRESS__) || defined(__SANITIZE_THREAD__) /* slow there */
enum { ROBOT_STEPS = 1 };
#else
enum { ROBOT_STEPS = 4 };
#endif
enum { DESIGNS = 40, ENVIRONMENTS = 10, STEPS = 30, ROBOTS = 2100 };

static struct mo_environment environments[ENVIRONMENTS];
static uint64_t genotypes[DESIGNS][MO_DEFAULT_WORDS];
static struct mo_body *bodies[DESIGNS];
static struct mo_robot robots[ROBOTS];

static void make_robots_of_designs(void)
{
  struct mo_body_stream *stream = make_body_stream(MO_DEFAULT_WORKSPACE, 3);
  make_scene();
  for (uint32_t i = 0; i < ENVIRONMENTS; i++)
    mo_environment_training(3, 0, i, environments + i);
  for (uint32_t d = 0; d < DESIGNS; d++) {
    make_check(mo_body_stream_next(stream, genotypes[d], NULL), "a body");
    bodies[d] = make_body(lattice, genotypes[d]);
  }
  for (uint32_t i = 0; i < ROBOTS; i++)
    robots[i] = (struct mo_robot){bodies[i % DESIGNS], environments + i % ENVIRONMENTS};
}

/* Resets the devices: no faults. */
static void reset(void)
{
  static const char *const names[] = {"DEVICES", "ROWS", "SHARDS", "SPRINGS", "DELAY_MS", "LOSE",
                                      "SHUT",    "FULL", "ABI",    "HASTE",   "MEET",     "OLDER"};
  for (size_t i = 0; i < COUNT(names); i++) {
    char name[64];
    snprintf(name, sizeof(name), "MORPHO_FAKE_%s", names[i]);
    unsetenv(name);
  }
}

static void set(const char *name, const char *value)
{
  setenv(name, value, 1);
}

/* ---- one back end with several devices ---- */

static atomic_int n_lost;

static void note_loss(void *context, const struct mo_device_status *status)
{
  (void)context;
  CHECK_INT(status->state, MO_DEVICE_LOST);
  CHECK(strlen(status->error) > 0);
  atomic_fetch_add(&n_lost, 1);
}

static struct mo_compute *open_devices(const char *n)
{
  const struct mo_devices_config devices = {.module = FAKE_DEVICE, .lost = note_loss};
  struct mo_compute *compute = make_compute(2);
  struct mo_message message = {.text = ""};
  atomic_store(&n_lost, 0);
  if (n != NULL) {
    set("MORPHO_FAKE_DEVICES", n);
    CHECK_INT(mo_compute_add_devices(compute, &devices, &message), MO_OK);
    CHECK_TEXT(message.text, "");
    CHECK_INT(mo_compute_devices(compute), atoi(n));
    CHECK_INT(mo_compute_devices_working(compute), atoi(n));
  }
  return compute;
}

#endif
