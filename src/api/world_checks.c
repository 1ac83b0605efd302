/* world_checks.c: whether robots can live and learn in the environments of a request. */
#include <stdio.h>
#include <stdlib.h>

#include "api/requests.h"
#include "base/words.h"
#include "world/factors.h"

/* Checks the worlds of a named set in which learning varies drops or slopes. */
static void check_set(struct mo_json *json, struct mo_parts *parts,
                      const struct mo_factor_ranges *vary)
{
  struct mo_environment *of_set = calloc(MO_SET_ENVIRONMENTS_MAX, sizeof(*of_set));
  struct mo_message message;
  if (of_set == NULL) {
    parts->error = MO_ERR_NO_MEMORY;
    json->stop = true;
    return;
  }
  const uint32_t n =
      mo_environment_set(mo_word_index(mo_set_words, parts->environment_set), of_set);
  for (uint32_t i = 0; i < n; i++)
    if (mo_environment_check_vary(&of_set[i], vary, &message) != MO_OK) {
      mo_json_fault_at(json, 0, "/environments", "learning cannot vary environment %u of %s: %s",
                       (unsigned)i, parts->environment_set, message.text);
      break;
    }
  free(of_set);
}

void mo_parts_check_factors(struct mo_json *json, struct mo_parts *parts,
                            const struct mo_physics *physics, const struct mo_factor_ranges *vary)
{
  const bool varies = vary != NULL && mo_factors_vary(vary);
  if (mo_physics_check(physics, NULL) != MO_OK)
    return; /* reported already, and not caused by factors */
  if (varies && parts->environments == NULL && parts->environment_set != NULL)
    check_set(json, parts, vary);
  for (uint32_t i = 0; parts->environments != NULL && i < parts->n_environments; i++) {
    const struct mo_environment *environment = &parts->environments[i];
    struct mo_message message;
    char pointer[64];
    if (varies && environment->grid != NULL) {
      snprintf(pointer, sizeof(pointer), "/environments/%u/terrain", i);
      mo_json_fault_at(json, 0, pointer,
                       "robots cannot learn on a custom grid in worlds that vary; use another kind "
                       "of terrain, or give varied environments ({\"of\", \"vary\"}) instead");
    } else if ((environment->factors.given != 0 || varies) &&
               mo_physics_check_in(physics, environment, vary, &message) != MO_OK) {
      if (parts->is_varied)
        snprintf(pointer, sizeof(pointer), "/environments/vary");
      else
        snprintf(pointer, sizeof(pointer), "/environments/%u/factors", i);
      mo_json_fault_at(json, 0, pointer, "puts constants out of range%s: %s",
                       varies ? " with the factors that learning draws" : "", message.text);
    } else if (varies && mo_environment_check_vary(environment, vary, &message) != MO_OK) {
      snprintf(pointer, sizeof(pointer), parts->is_varied ? "/environments" : "/environments/%u",
               i);
      mo_json_fault_at(json, 0, pointer, "learning cannot vary it: %s", message.text);
    } else {
      continue;
    }
    if (parts->is_varied)
      return;
  }
}

void mo_parts_check_gradients(struct mo_json *json, const struct mo_parts *parts, const char *hint)
{
  for (uint32_t i = 0; parts->environments != NULL && i < parts->n_environments; i++) {
    struct mo_message message;
    char pointer[64];
    if (mo_task_check_gradient(&parts->environments[i].task, &message) == MO_OK)
      continue;
    if (parts->has_tasks)
      snprintf(pointer, sizeof(pointer), "/tasks/%u/objective", i);
    else
      snprintf(pointer, sizeof(pointer), "/environments/%u/task/objective", i);
    mo_json_fault_at(json, 0, pointer, "%s%s", message.text, hint);
  }
}
