/* worlds.c: the environments and physics of scores, by hash, by name, and of a job; and the
 * geometry of a design. The content behind a hash never changes, so clients may cache it. */
#include <stdlib.h>
#include <string.h>

#include "api/job_json.h"
#include "api/jobs.h"
#include "api/requests.h"
#include "api/scene.h"
#include "rollout/physics.h"
#include "store/runner.h"
#include "store/worlds.h"

static bool read_hash(struct mo_request *request, struct mo_sha256 *hash)
{
  const char *digits = request->parameters[0];
  if (mo_sha256_from_hex(digits, strlen(digits), hash) == MO_OK)
    return true;
  mo_reply_problem(request, 404, NULL, "A SHA-256 has 64 hexadecimal digits.");
  return false;
}

static void reply_kept(struct mo_request *request, int error, struct mo_text *text,
                       const char *what)
{
  mo_reply_text(request, error, text, what);
  request->reply.keep = error == MO_OK;
}

void mo_api_get_environment(struct mo_request *request)
{
  struct mo_environment environment;
  struct mo_text text = {0};
  struct mo_sha256 hash;
  if (!read_hash(request, &hash))
    return;
  const int error = mo_store_environment(mo_api_of(request)->store, &hash, &environment);
  if (error == MO_OK)
    mo_environment_write(&text, &environment);
  if (error == MO_OK)
    mo_environments_drop(&environment, 1);
  reply_kept(request, error, &text, "environment");
}

void mo_api_get_physics(struct mo_request *request)
{
  struct mo_text text = {0};
  struct mo_physics physics;
  enum mo_precision precision;
  enum mo_sensor sensor;
  struct mo_sha256 hash;
  if (!read_hash(request, &hash))
    return;
  const int error =
      mo_store_physics(mo_api_of(request)->store, &hash, &physics, &precision, &sensor);
  if (error == MO_OK) {
    mo_text_object(&text);
    mo_member_hash(&text, "sha256", &hash);
    mo_text_member(&text, "precision", precision == MO_FLOAT64 ? "float64" : "float32");
    mo_text_member(&text, "sensor", mo_sensor_name(sensor));
    mo_text_name(&text, "physics");
    mo_fields_write_object(&text, &mo_physics_fields, &physics);
    mo_text_add(&text, "}");
  }
  reply_kept(request, error, &text, "physics");
}

/* Replies with a list of environments, and frees them. */
static void reply_environments(struct mo_request *request, int error,
                               struct mo_environment *environments, uint32_t n, const char *what)
{
  struct mo_text text = {0};
  if (error == MO_OK) {
    mo_text_add(&text, "{\"items\":[");
    for (uint32_t i = 0; i < n; i++)
      mo_environment_write(&text, &environments[i]);
    mo_text_add(&text, "]}");
    mo_environments_free(environments, n);
  }
  mo_reply_text(request, error, &text, what);
}

void mo_api_get_environment_set(struct mo_request *request)
{
  const int suite = mo_word_index(mo_suite_words, request->parameters[0]);
  struct mo_environment *environments = NULL;
  uint32_t n = 0;
  if (suite >= 0) {
    mo_reply_problem(request, 404, NULL,
                     "%s is a suite of %d sets, which GET /v1/environment-sets lists; request the "
                     "environments of one set, such as %s.",
                     mo_suite_words[suite], MO_SUITE_TASKS, mo_suite_set(suite, 2));
    return;
  }
  const int error = mo_store_environment_set(mo_api_of(request)->store, request->parameters[0],
                                             &environments, &n);
  reply_environments(request, error, environments, n, "set of environments");
}

static void write_suites(struct mo_text *text)
{
  mo_text_add(text, ",\"suites\":[");
  for (int i = 0; mo_suite_words[i] != NULL; i++) {
    mo_text_object(text);
    mo_text_member(text, "name", mo_suite_words[i]);
    mo_text_member_count(text, "environments", mo_suite_environments(i));
    mo_text_open(text, "tasks", "[");
    for (uint32_t task = 0; task < MO_SUITE_TASKS; task++) {
      mo_text_object(text);
      mo_text_member(text, "task", mo_suite_task_words[task]);
      mo_text_member(text, "environments", mo_suite_set(i, task));
      mo_text_add(text, "}");
    }
    mo_text_add(text, "]}");
  }
  mo_text_add(text, "]");
}

void mo_api_list_environment_sets(struct mo_request *request)
{
  struct mo_text text = {0};
  int error = MO_OK;
  mo_text_add(&text, "{\"items\":[");
  for (int i = 0; mo_set_words[i] != NULL && error == MO_OK; i++) {
    uint32_t n = 0;
    error = mo_store_environment_set_size(mo_api_of(request)->store, mo_set_words[i], &n);
    mo_text_object(&text);
    mo_text_member(&text, "name", mo_set_words[i]);
    mo_text_member_count(&text, "environments", n);
    mo_text_add(&text, "}");
  }
  mo_text_add(&text, "]");
  write_suites(&text);
  mo_text_add(&text, "}");
  mo_reply_text(request, error, &text, "set of environments");
}

void mo_api_get_job_environments(struct mo_request *request)
{
  const enum mo_job_kind kind = mo_resource_of(request)->kind;
  struct mo_environment *environments = NULL;
  uint32_t n = 0;
  int64_t id;
  if (!mo_path_id(request, 0, &id))
    return;
  const int error =
      mo_store_job_environments(mo_api_of(request)->store, id, kind, &environments, &n);
  reply_environments(request, error, environments, n, mo_job_kind_name(kind));
}

/* Reads the design that a path names into a genotype with its workspace: the notation of a robot,
 * an id, whose body is canonical, or a genotype. Returns false if it has replied. */
static bool read_design(struct mo_request *request, struct mo_genotype *genotype)
{
  const char *digits = request->parameters[0];
  const size_t size = strlen(digits);
  int orientation;
  const struct mo_workspace workspace = genotype->workspace;
  const int error = size == mo_workspace_voxels(workspace)
                        ? mo_genotype_from_text(workspace, digits, size, genotype->words, NULL)
                        : mo_robot_read(digits, size, genotype, &orientation);
  if (error == MO_OK)
    return true;
  mo_reply_problem(request, 404, NULL,
                   "A design is an id of 36 digits, optionally with an orientation (ID@K, K from "
                   "0 to 7; default: @0), or a genotype of 144 digits 0 or 1.");
  return false;
}

void mo_api_get_design_body(struct mo_request *request)
{
  const struct mo_lattice *lattice = mo_api_of(request)->lattice;
  struct mo_genotype genotype = {.workspace = lattice->workspace};
  struct mo_body *body = NULL;
  struct mo_text text = {0};
  if (!read_design(request, &genotype))
    return;
  mo_genotype_place(genotype.workspace, genotype.words);
  int error = mo_body_create(lattice, genotype.words, &body);
  if (error == MO_OK) {
    mo_text_object(&text);
    mo_member_robot(&text, &genotype);
    mo_member_genotype(&text, "genotype", &genotype);
    error = mo_scene_write_body(&text, NULL, lattice, body, &genotype);
    mo_text_add(&text, "}");
  }
  mo_body_free(body);
  reply_kept(request, error, &text, "design");
}
