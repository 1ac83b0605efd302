/* job_json.c: see job_json.h. */
#include "api/job_json.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "store/worlds.h"

void mo_member_orientation(struct mo_text *text, enum mo_orientation orientation)
{
  static const char *const words[] = {NULL, "canonical", "best"};
  mo_text_member(text, "orientation", words[orientation]);
}

/* Writes the content of a note as members. note NULL: there is no note. */
static void write_note(struct mo_text *text, const struct mo_design_note *note)
{
  mo_text_member_count(text, "repaired", note != NULL ? note->dropped : 0);
  if (note == NULL || !mo_is_skipped(note)) {
    mo_text_member(text, "fault", NULL);
    return;
  }
  mo_text_open(text, "fault", "{");
  mo_text_member(text, "pointer", note->fault.where);
  mo_text_member(text, "detail", note->fault.detail);
  mo_text_add(text, "}");
}

void mo_member_notes(struct mo_text *text, const char *name, const struct mo_design_note *notes,
                     uint32_t n)
{
  mo_text_open(text, name, "[");
  for (uint32_t i = 0; i < n; i++) {
    mo_text_object(text);
    mo_text_member_count(text, "place", notes[i].place);
    mo_text_member(text, "robot", notes[i].robot[0] != '\0' ? notes[i].robot : NULL);
    mo_member_orientation(text, notes[i].orientation);
    write_note(text, &notes[i]);
    mo_text_add(text, "}");
  }
  mo_text_add(text, "]");
}

int mo_members_design(struct mo_text *text, const struct mo_lattice *lattice,
                      const struct mo_genotype *form, const struct mo_genotype *genotype,
                      const struct mo_design_note *note)
{
  struct mo_design_size size;
  const int error = mo_design_size(lattice, genotype->words, &size);
  const bool known = error == MO_OK && size.voxels > 0;
  if (known) {
    mo_member_form(text, "id", form);
    mo_member_robot(text, genotype);
    mo_member_genotype(text, "genotype", genotype);
  } else {
    mo_text_member(text, "id", NULL);
    mo_text_member(text, "robot", NULL);
    mo_text_member(text, "genotype", NULL);
  }
  mo_member_count_if(text, "voxels", known, size.voxels);
  mo_member_count_if(text, "masses", known, size.masses);
  mo_member_count_if(text, "springs", known, size.springs);
  mo_member_count_if(text, "footprint", known, size.footprint);
  write_note(text, note);
  return error;
}

void mo_member_controller(struct mo_text *text, const char *member, bool known, const char *name,
                          const struct mo_sha256 *sha256)
{
  if (!known) {
    mo_text_member(text, member, NULL);
    return;
  }
  mo_text_open(text, member, "{");
  mo_text_member(text, "name", name[0] != '\0' ? name : NULL);
  mo_member_hash(text, "sha256", sha256);
  mo_text_add(text, "}");
}

void mo_member_environments(struct mo_text *text, const char *set, uint32_t n)
{
  if (set[0] != '\0')
    mo_text_member(text, "environments", set);
  else
    mo_text_format(text, ",\"environments\":{\"count\":%u}", n);
}

int mo_tasks_read(struct mo_store *store, int64_t id, enum mo_job_kind kind, const char *set,
                  struct mo_environment **environments)
{
  uint32_t n = 0;
  bool is_plain = true;
  *environments = NULL;
  if (strcmp(set, mo_set_words[0]) == 0) /* the usual set; its tasks are plain */
    return MO_OK;
  const int error = mo_store_job_environments(store, id, kind, environments, &n);
  for (uint32_t i = 0; error == MO_OK && i < n; i++)
    is_plain = is_plain && mo_task_is_plain(&(*environments)[i].task);
  if (error == MO_OK)
    mo_environments_drop(*environments, n); /* only tasks are needed */
  if (is_plain) {
    free(*environments);
    *environments = NULL;
  }
  return error;
}

/* Returns whether a job is paused because no device is available to compute it. */
static bool lacks_device(const struct mo_job *job)
{
  return job->state == MO_JOB_PAUSED && job->error == MO_ERR_DEVICE;
}

void mo_member_warnings(struct mo_text *text, const struct mo_warning *warnings, uint32_t n)
{
  mo_text_open(text, "warnings", "[");
  for (uint32_t i = 0; i < n; i++) {
    mo_text_object(text);
    mo_text_member(text, "code", warnings[i].code);
    mo_text_member(text, "detail", warnings[i].detail);
    mo_text_add(text, "}");
  }
  mo_text_add(text, "]");
}

enum mo_job_state mo_job_state_shown(const struct mo_job *job, const struct mo_live *live)
{
  bool waits = job->state == MO_JOB_RUNNING && live->phase == MO_PHASE_WAIT;
  return waits ? MO_JOB_PAUSED : job->state;
}

void mo_job_write_head(struct mo_text *text, const struct mo_job *job, const struct mo_live *live)
{
  mo_text_member(text, "state", mo_job_state_name(mo_job_state_shown(job, live)));
  mo_text_member(text, "priority", job->priority == MO_INTERACTIVE ? "interactive" : "batch");
  mo_text_member_number(text, "weight", job->weight);
  mo_text_member(text, "device", job->back_end == MO_ON_DEVICE ? "cuda" : "cpu");
  mo_text_member(text, "label", job->has_label ? job->label : NULL);
  mo_text_member(text, "experiment", job->experiment[0] != '\0' ? job->experiment : NULL);
  mo_text_member(text, "note", job->note[0] != '\0' ? job->note : NULL);
  mo_text_member_time(text, "archived_at", job->archived_us);
  /* The share of a job that has ended can remain for a moment, and still count time. */
  const bool runs = !mo_job_state_is_final(job->state);
  mo_text_member_number(text, "core_seconds",
                        runs ? fmax(job->worker_s, live->worker_s) : job->worker_s);
  mo_text_member_number(text, "device_seconds",
                        runs ? fmax(job->device_s, live->device_s) : job->device_s);
  mo_text_member(text, "submitted_by", job->submitted_by[0] != '\0' ? job->submitted_by : NULL);
  mo_text_member_time(text, "created_at", job->created_us);
  mo_text_member_time(text, "started_at", job->started_us);
  mo_text_member_time(text, "finished_at", job->finished_us);
  mo_text_member_count(text, "attempts", job->attempts);
  if (job->state == MO_JOB_FAILED || lacks_device(job)) {
    mo_text_add(text, ",\"error\":{");
    mo_text_member(text, "detail", job->error_text);
    mo_text_member(text, "code", mo_error_name(job->error));
    mo_text_add(text, "}");
  } else {
    mo_text_member(text, "error", NULL);
  }
  mo_member_warnings(text, job->warnings, job->n_warnings);
  const bool waits = live->reason[0] != '\0' && !mo_job_state_is_final(job->state);
  mo_text_member(text, "reason", waits ? live->reason : lacks_device(job) ? job->error_text : NULL);
}

void mo_links_write(struct mo_text *text, const struct mo_job *job, const char *const *below)
{
  const long long id = (long long)job->id;
  mo_text_format(text, ",\"links\":{\"job\":\"/v1/jobs/%lld\",\"events\":\"/v1/events?job=%lld\"",
                 id, id);
  for (; below[0] != NULL; below += 2)
    mo_text_format(text, ",\"%s\":\"/v1/%ss/%lld/%s\"", below[0], mo_job_kind_name(job->kind), id,
                   below[1]);
  mo_text_add(text, "}");
}
