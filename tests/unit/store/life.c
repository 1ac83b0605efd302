/* life.c: what a life is made of: things by their seeds, and what was found wrong with it. */
#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "life.h"

uint64_t life_hash(uint64_t seed, uint64_t place)
{
  uint64_t z = seed * UINT64_C(0x9E3779B97F4A7C15) + place + 1; /* SplitMix64's mixing */
  z = (z ^ (z >> 30)) * UINT64_C(0xBF58476D1CE4E5B9);
  z = (z ^ (z >> 27)) * UINT64_C(0x94D049BB133111EB);
  return z ^ (z >> 31);
}

void *life_memory(size_t size)
{
  void *memory = NULL;
  if (posix_memalign(&memory, 16, size) != 0)
    abort();
  return memory;
}

static size_t fill(uint64_t seed, size_t size, uint8_t **bytes)
{
  *bytes = life_memory(size);
  for (size_t i = 0; i < size; i++)
    (*bytes)[i] = (uint8_t)life_hash(seed, i);
  return size;
}

size_t life_content(uint64_t seed, uint8_t **bytes)
{
  return fill(seed, 1 + life_hash(seed, 1) % 20000, bytes);
}

size_t life_checkpoint(uint64_t seed, uint32_t step, uint8_t **bytes)
{
  const uint64_t own = life_hash(seed, step);
  return fill(own, 1 + own % 30000, bytes);
}

double life_loss(uint64_t seed, uint32_t design, uint32_t environment, int32_t *diverged_step)
{
  const uint64_t own = life_hash(seed, 100 + (uint64_t)design * MO_ENVIRONMENTS_MAX + environment);
  *diverged_step = own % 16 == 0 ? 1 + (int32_t)((own >> 32) % 100) : 0;
  return *diverged_step != 0 ? (double)INFINITY : (double)(own >> 11) * 0x1p-53 - 0.5;
}

struct mo_training_step_row life_step(uint64_t seed, uint32_t step)
{
  const uint64_t own = life_hash(seed, UINT64_C(1000000) + step);
  return (struct mo_training_step_row){.report = {.step = step,
                                                  .mean_loss = (double)(own >> 11) * 0x1p-53,
                                                  .rate = 1e-3,
                                                  .gradient_norm = (double)(own & 0xffff),
                                                  .zeroed = (uint32_t)(own & 7)},
                                       .seconds = 0.25};
}

void life_name(int index, char name[16])
{
  snprintf(name, 16, index == 0 ? "default" : "walker-%d", index);
}

void life_key(char kind, int index, char key[32])
{
  snprintf(key, 32, "%c%d", kind, index);
}

int life_start(struct life *life, uint64_t seed, unsigned lies, struct mo_bits *forms,
               struct mo_bits *genotypes)
{
  *life = (struct life){.disk = disk_new(seed, lies), .forms = forms, .genotypes = genotypes};
  for (int i = 0; i < NAMES; i++)
    life->model.names[i].content = -1;
  return life->disk != NULL ? 0 : -1;
}

int life_open(struct life *life, uint32_t checkpoint_frames, struct mo_message *message)
{
  const struct mo_store_config config = {.path = disk_folder(life->disk),
                                         .vfs = disk_vfs(life->disk),
                                         .files = disk_files(life->disk),
                                         .n_readers = 1,
                                         .checkpoint_frames = checkpoint_frames};
  life->store = NULL;
  return mo_store_open(&config, &life->store, message);
}

void life_found(struct life *life, const char *format, ...)
{
  va_list arguments;
  va_start(arguments, format);
  if (life->findings++ == 0)
    vsnprintf(life->first, sizeof(life->first), format, arguments);
  va_end(arguments);
}

/* A quarter of all contents come with much metadata, so that the log grows long and is copied into
 * the database now and then. */
void put_start(struct put *put, uint64_t seed)
{
  const size_t length = seed % 4 == 0 ? 100000 : 20;
  *put = (struct put){.key = "note", .note = life_memory(length + 1)};
  memset(put->note, 'x', length);
  put->note[length] = '\0';
  put->entry = (struct mo_metadata_entry){.key = put->key, .value = put->note};
  put->controller = (struct mo_controller){.workspace = MO_DEFAULT_WORKSPACE,
                                           .n_parameters = 1,
                                           .metadata = &put->entry,
                                           .n_metadata = 1};
  put->size = life_content(seed, &put->bytes);
}

void put_end(struct put *put)
{
  free(put->note);
  free(put->bytes);
}
