/* fixture.h: bases of certificates, and their trials. */
#ifndef MORPHO_TESTS_CERTIFICATE_FIXTURE_H
#define MORPHO_TESTS_CERTIFICATE_FIXTURE_H

#include "../make.h"

#include <morpho/certificate.h>

/* Returns a base in float32 with a named set, or with n worlds of a training run (set NULL). */
static inline struct mo_certificate_base base_of(const char *set, uint32_t n)
{
  struct mo_environment *environments = make_zeros(MO_SET_ENVIRONMENTS_MAX, sizeof(*environments));
  for (int i = 0; set != NULL && mo_set_words[i] != NULL; i++)
    if (strcmp(mo_set_words[i], set) == 0)
      n = mo_environment_set(i, environments);
  for (uint32_t k = 0; set == NULL && k < n; k++)
    mo_environment_training(7, 0, k, &environments[k]);
  return (struct mo_certificate_base){mo_default_physics(), MO_FLOAT32, environments, n, set};
}

/* Returns the base's worlds, to change them. */
static inline struct mo_environment *worlds_of(const struct mo_certificate_base *base)
{
  return (struct mo_environment *)(uintptr_t)base->environments;
}

static inline struct mo_trial *trials_of(const struct mo_certificate_settings *settings,
                                         const struct mo_certificate_base *base, uint32_t *n)
{
  struct mo_trial *trials = NULL;
  make_check(mo_certificate_trials(settings, base, &trials, n), "trials");
  return check_keep(trials, free);
}

static inline struct mo_environment *environments_of(const struct mo_certificate_settings *settings,
                                                     const struct mo_certificate_base *base,
                                                     const struct mo_trial *trial)
{
  struct mo_environment *made = make_zeros(trial->n_environments, sizeof(*made));
  make_check(mo_certificate_environments(settings, base, trial, made), "environments");
  return made;
}

/* Returns the trial of an axis and its level number k; NULL: none. */
static inline const struct mo_trial *find_trial(const struct mo_trial *trials, uint32_t n,
                                                enum mo_axis axis, uint32_t k)
{
  for (uint32_t t = 0; t < n; t++)
    if (trials[t].axis == axis && k-- == 0)
      return &trials[t];
  return NULL;
}

/* The first trial of an axis. */
static inline const struct mo_trial *trial_of(const struct mo_certificate_settings *settings,
                                              const struct mo_certificate_base *base,
                                              enum mo_axis axis)
{
  uint32_t n = 0;
  const struct mo_trial *trials = trials_of(settings, base, &n);
  return find_trial(trials, n, axis, 0);
}

#endif
