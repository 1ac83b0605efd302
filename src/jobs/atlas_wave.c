/* atlas_wave.c: see atlas_wave.h. */
#include "jobs/atlas_wave.h"

#include <stdlib.h>

uint64_t mo_atlas_wave_bytes(uint32_t most, uint32_t n_environments, uint32_t n_measures)
{
  const struct mo_atlas_wave *wave = NULL;
  return most *
         (sizeof(*wave->forms) + sizeof(*wave->begins) + sizeof(*wave->left) +
          sizeof(*wave->designs) + sizeof(*wave->bodies) +
          (uint64_t)n_environments * (sizeof(*wave->losses) + n_measures * sizeof(*wave->values)));
}

int mo_atlas_wave_create(struct mo_atlas_wave *wave)
{
  const size_t most = wave->most;
  wave->forms = calloc(most, sizeof(*wave->forms));
  wave->begins = calloc(most + 1, sizeof(*wave->begins));
  wave->left = calloc(most, sizeof(*wave->left));
  wave->designs = calloc(most, sizeof(*wave->designs));
  wave->bodies = calloc(most, sizeof(*wave->bodies));
  wave->losses = calloc(most * wave->n_environments, sizeof(*wave->losses));
  wave->values = calloc(most * wave->n_environments * wave->n_measures + 1, sizeof(*wave->values));
  return wave->forms != NULL && wave->begins != NULL && wave->left != NULL &&
                 wave->designs != NULL && wave->bodies != NULL && wave->losses != NULL &&
                 wave->values != NULL
             ? MO_OK
             : MO_ERR_NO_MEMORY;
}

void mo_atlas_wave_free(struct mo_atlas_wave *wave)
{
  free(wave->forms);
  free(wave->begins);
  free(wave->left);
  free(wave->designs);
  free(wave->bodies);
  free(wave->losses);
  free(wave->values);
}

int mo_atlas_wave_fill(struct mo_atlas_wave *wave, struct mo_atlas_bodies *bodies)
{
  int error = MO_OK;
  wave->n = wave->n_designs = 0;
  while (wave->n_designs + MO_ORIENTATIONS <= wave->most) {
    struct mo_bits designs[MO_ORIENTATIONS];
    uint64_t *form = wave->forms[wave->n].words;
    error = mo_atlas_bodies_next(bodies, form);
    if (error != MO_OK)
      break;
    const uint32_t n = mo_atlas_designs(&wave->scope, form, wave->orientations, designs);
    for (uint32_t k = 0; k < n; k++) {
      wave->designs[wave->n_designs + k] = designs[k];
      wave->bodies[wave->n_designs + k] = wave->n;
    }
    wave->left[wave->n] = (uint8_t)n;
    wave->begins[wave->n++] = wave->n_designs;
    wave->n_designs += n;
  }
  wave->begins[wave->n] = wave->n_designs;
  return error == MO_ERR_EXHAUSTED ? MO_OK : error;
}

void mo_atlas_wave_measured(struct mo_atlas_wave *wave, uint32_t design, uint32_t environment,
                            const double values[MO_MEASURES])
{
  double *to =
      wave->values + ((size_t)design * wave->n_environments + environment) * wave->n_measures;
  for (uint32_t m = 0; m < MO_MEASURES; m++)
    if (wave->measures >> m & 1)
      *to++ = values[m];
}

/* Returns the mean over the environments of the mean over designs of a measure. */
static double mean_of(const struct mo_atlas_wave *wave, uint32_t begin, uint32_t end, uint32_t m)
{
  double all = 0;
  for (uint32_t e = 0; e < wave->n_environments; e++) {
    double sum = 0;
    for (uint32_t k = begin; k < end; k++)
      sum += wave->values[((size_t)k * wave->n_environments + e) * wave->n_measures + m];
    all += sum / (end - begin);
  }
  return all / wave->n_environments;
}

void mo_atlas_wave_mean(const struct mo_atlas_wave *wave, uint32_t i, double *losses,
                        double *measures)
{
  const uint32_t begin = wave->begins[i], end = wave->begins[i + 1];
  for (uint32_t m = 0; m < wave->n_measures; m++)
    measures[m] = mean_of(wave, begin, end, m);
  for (uint32_t e = 0; e < wave->n_environments; e++) {
    double sum = 0;
    for (uint32_t k = begin; k < end; k++)
      sum += wave->losses[(size_t)k * wave->n_environments + e];
    losses[e] = sum / (end - begin);
  }
}

int mo_atlas_count_designs(const struct mo_atlas_scope *scope,
                           enum mo_atlas_orientations orientations, uint64_t first, uint64_t end,
                           uint64_t *n)
{
  struct mo_atlas_bodies *bodies = NULL;
  struct mo_bits form, designs[MO_ORIENTATIONS];
  *n = 0;
  int error = mo_atlas_bodies_create(scope, &bodies);
  if (error == MO_OK)
    error = mo_atlas_bodies_seek(bodies, first);
  for (uint64_t i = first; i < end && error == MO_OK; i++) {
    error = mo_atlas_bodies_next(bodies, form.words);
    if (error == MO_OK)
      *n += mo_atlas_designs(scope, form.words, orientations, designs);
  }
  mo_atlas_bodies_free(bodies);
  return error;
}
