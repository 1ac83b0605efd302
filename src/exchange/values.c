/* values.c: see values.h. */
#include "exchange/values.h"

#include <math.h>
#include <stdio.h>
#include <string.h>

#include "base/words.h"
#include "store/hash.h"
#include "world/environment.h"
#include "world/task_json.h"

/* ---- values, and members of an object ---- */

void mo_genotype_write(struct mo_text *text, const struct mo_genotype *genotype)
{
  char digits[64 * MO_DEFAULT_WORDS + 1];
  mo_genotype_to_text(genotype->workspace, genotype->words, digits);
  mo_text_add(text, digits);
}

void mo_form_write(struct mo_text *text, const struct mo_genotype *form)
{
  char id[16 * MO_DEFAULT_WORDS + 1];
  mo_genotype_id(form->workspace, form->words, id);
  mo_text_add(text, id);
}

void mo_robot_write(struct mo_text *text, const struct mo_genotype *genotype)
{
  char robot[16 * MO_DEFAULT_WORDS + 3] = "";
  /* Cannot fail: the genotype is not empty. */
  (void)mo_genotype_robot(genotype->workspace, genotype->words, robot);
  mo_text_add(text, robot);
}

void mo_member_genotype(struct mo_text *text, const char *name, const struct mo_genotype *genotype)
{
  mo_text_name(text, name);
  mo_text_bytes(text, "\"", 1);
  mo_genotype_write(text, genotype);
  mo_text_bytes(text, "\"", 1);
}

void mo_member_form(struct mo_text *text, const char *name, const struct mo_genotype *form)
{
  mo_text_name(text, name);
  mo_text_bytes(text, "\"", 1);
  mo_form_write(text, form);
  mo_text_bytes(text, "\"", 1);
}

void mo_member_robot(struct mo_text *text, const struct mo_genotype *genotype)
{
  mo_text_name(text, "robot");
  mo_text_bytes(text, "\"", 1);
  mo_robot_write(text, genotype);
  mo_text_bytes(text, "\"", 1);
}

void mo_member_hash(struct mo_text *text, const char *name, const struct mo_sha256 *hash)
{
  mo_text_member(text, name, MO_SHA256_HEX(hash));
}

void mo_member_numbers(struct mo_text *text, const char *name, const double *numbers, size_t n)
{
  mo_text_open(text, name, "[");
  for (size_t i = 0; i < n; i++) {
    mo_text_next(text);
    mo_text_json_number(text, numbers[i]);
  }
  mo_text_add(text, "]");
}

void mo_member_count_if(struct mo_text *text, const char *name, bool known, uint64_t count)
{
  if (known)
    mo_text_member_count(text, name, count);
  else
    mo_text_member(text, name, NULL);
}

void mo_member_number_if(struct mo_text *text, const char *name, bool known, double number)
{
  mo_text_member_number(text, name, known ? number : (double)NAN);
}

static void read_hash(struct mo_json *json, void *sha256)
{
  struct mo_json_slice slice;
  if (mo_json_string(json, &slice) && mo_sha256_from_hex(slice.bytes, slice.size, sha256) != MO_OK)
    mo_json_fault(json, "must be 64 hexadecimal digits");
}

static void write_hash(struct mo_text *text, const void *value)
{
  const struct mo_sha256 *sha256 = value;
  mo_text_format(text, "\"%s\"", MO_SHA256_HEX(sha256));
}
const struct mo_field_own mo_hash_field = {.read = read_hash, .write = write_hash};

/* ---- tasks ---- */

static void write_value(struct mo_text *text, const struct mo_task *task, double loss)
{
  mo_text_member_number(text, "value", mo_objective_value(task->objective, loss));
  mo_text_member(text, "unit", mo_objective_unit(task->objective));
}

void mo_members_value(struct mo_text *text, const struct mo_task *task, double loss)
{
  if (!mo_task_is_plain(task))
    write_value(text, task, loss);
}

/* ---- measures ---- */

void mo_member_measures(struct mo_text *text, const char *name, uint32_t set)
{
  mo_text_open(text, name, "[");
  for (unsigned m = 0; m < MO_MEASURES; m++)
    if (set >> m & 1) {
      mo_text_next(text);
      mo_text_format(text, "\"%s\"", mo_measure_info[m].name);
    }
  mo_text_add(text, "]");
}

void mo_member_flags(struct mo_text *text, unsigned flags)
{
  static const char *const words[] = {"overstrained", "inverted"};
  mo_text_open(text, "flags", "[");
  for (size_t i = 0; i < sizeof(words) / sizeof(words[0]); i++)
    if (flags >> i & 1) {
      mo_text_next(text);
      mo_text_format(text, "\"%s\"", words[i]);
    }
  mo_text_add(text, "]");
}
_Static_assert(MO_FLAG_OVERSTRAINED == 1 && MO_FLAG_INVERTED == 2, "in the order of the words");

/* values: in the order of the set. */
static void write_measures(struct mo_text *text, uint32_t set, const double *values, unsigned flags)
{
  mo_text_open(text, "measures", "{");
  for (unsigned m = 0; m < MO_MEASURES; m++)
    if (set >> m & 1)
      mo_text_member_number(text, mo_measure_info[m].name, *values++);
  mo_text_add(text, "}");
  mo_member_flags(text, flags);
}

static void write_means(struct mo_text *text, const struct mo_measured *measured, size_t n)
{
  const size_t each = (size_t)__builtin_popcount(measured->set);
  double means[MO_MEASURES] = {0};
  unsigned flags = 0;
  for (size_t k = 0; k < n; k++) {
    flags |= measured->flags[k];
    for (size_t i = 0; i < each; i++)
      means[i] += measured->values[k * each + i];
  }
  for (size_t i = 0; i < each; i++)
    means[i] /= (double)n;
  if (measured->has_means)
    mo_member_flags(text, flags);
  else
    write_measures(text, measured->set, means, flags);
}

/* ---- losses ---- */

void mo_members_losses(struct mo_text *text, const double *losses, size_t n,
                       const struct mo_environment *environments,
                       const struct mo_measured *measured)
{
  static const struct mo_task plain = {.objective = MO_OBJECTIVE_REACH};
  bool is_plain = measured == NULL, is_same = true;
  double sum = 0;
  for (size_t k = 0; environments != NULL && k < n; k++) {
    const struct mo_task *task = &environments[k].task;
    is_plain = is_plain && mo_task_is_plain(task);
    is_same = is_same && strcmp(mo_objective_unit(task->objective),
                                mo_objective_unit(environments[0].task.objective)) == 0;
  }
  if (is_plain) {
    mo_member_numbers(text, "losses", losses, n);
    return;
  }
  mo_text_open(text, "losses", "[");
  for (size_t k = 0; k < n; k++) {
    const struct mo_task *task = environments != NULL ? &environments[k].task : &plain;
    mo_text_object(text);
    mo_text_member_number(text, "loss", losses[k]);
    write_value(text, task, losses[k]);
    if (measured != NULL) {
      const size_t each = (size_t)__builtin_popcount(measured->set);
      write_measures(text, measured->set, &measured->values[k * each], measured->flags[k]);
    }
    mo_text_add(text, "}");
    sum += mo_objective_value(task->objective, losses[k]);
  }
  mo_text_add(text, "]");
  if (is_same) {
    mo_text_member_number(text, "value", sum / (double)n);
    mo_text_member(
        text, "unit",
        mo_objective_unit((environments != NULL ? &environments[0].task : &plain)->objective));
  }
  if (measured != NULL)
    write_means(text, measured, n);
}

void mo_environment_write(struct mo_text *text, const struct mo_environment *environment)
{
  struct mo_sha256 hash;
  mo_environment_hash(environment, &hash);
  mo_text_object(text);
  mo_member_hash(text, "sha256", &hash);
  mo_environment_write_members(text, environment);
  mo_text_add(text, "}");
}

/* ---- designs of campaigns ---- */

void mo_parents_write(struct mo_text *text, const struct mo_descent *descent)
{
  for (int i = 0, n = 0; i < 2; i++)
    if (descent->parents[i] != MO_NO_PARENT)
      mo_text_format(text, n++ > 0 ? ",%u" : "%u", descent->parents[i]);
}

void mo_member_parents(struct mo_text *text, const struct mo_descent *descent)
{
  mo_text_add(text, ",\"parents\":[");
  mo_parents_write(text, descent);
  mo_text_add(text, "]");
}

void mo_campaign_json_life(struct mo_text *text, const struct mo_campaign_design *row)
{
  mo_member_parents(text, &row->descent);
  mo_text_member(text, "operator", mo_campaign_operator(row));
  mo_text_member_count(text, "born", row->born);
  mo_member_count_if(text, "died", row->died >= 0, (uint64_t)row->died);
  mo_text_member_number(text, "score", row->score);
  mo_text_member_bool(text, "lower_bound", row->is_cut);
}

void mo_member_held_out(struct mo_text *text, const struct mo_re_evaluated *held_out)
{
  if (held_out->worlds == 0) {
    mo_text_member(text, "held_out", NULL);
    return;
  }
  const struct mo_interval interval = mo_held_out_interval(held_out);
  mo_text_open(text, "held_out", "{");
  mo_text_member_count(text, "generation", held_out->generation);
  mo_text_member_count(text, "worlds", held_out->worlds);
  mo_text_member_number(text, "mean", held_out->mean);
  mo_text_member_number(text, "standard_error", held_out->standard_error);
  mo_text_member_number(text, "low", interval.lo);
  mo_text_member_number(text, "high", interval.hi);
  mo_text_member_count(text, "diverged", held_out->diverged);
  mo_text_add(text, "}");
}

void mo_member_certificate(struct mo_text *text, const struct mo_certified *certified)
{
  if (certified->id == 0) {
    mo_text_member(text, "certificate", NULL);
    return;
  }
  mo_text_open(text, "certificate", "{");
  mo_text_member_id(text, "id", certified->id);
  mo_text_member(text, "class",
                 certified->verdict >= 0 ? mo_word(mo_verdict_words, (unsigned)certified->verdict)
                                         : NULL);
  mo_text_add(text, "}");
}

void mo_campaign_json_design(struct mo_text *text, const struct mo_campaign_design *row,
                             const struct mo_study_words *words)
{
  mo_text_member_count(text, "number", row->number);
  mo_member_form(text, "id", &row->form);
  if (words != NULL)
    mo_member_robot(text, &row->genotype);
  mo_member_genotype(text, "genotype", &row->genotype);
  mo_campaign_json_life(text, row);
  mo_text_format(text, ",\"voxels\":%u,\"footprint\":%u,\"masses\":%u,\"springs\":%u",
                 row->size.voxels, row->size.footprint, row->size.masses, row->size.springs);
  if (words == NULL)
    return;
  mo_member_held_out(text, &row->held_out);
  mo_member_certificate(text, &row->certified);
  if (words->n_measures == 0)
    return;
  mo_text_open(text, "measures", "{");
  for (uint32_t m = 0; m < words->n_measures; m++)
    mo_text_member_number(text, words->measures[m], m < row->n_measures ? row->measures[m] : NAN);
  mo_text_add(text, "}");
}

/* ---- recordings ---- */

void mo_recording_header(struct mo_text *text, enum mo_channel channel, const char *leading,
                         const struct mo_trajectory_sides *sides)
{
  static const char *const types[MO_CHANNELS] = {"<f8", "<f4", "|i1", "|u1"};
  const uint32_t numbers = mo_channel_numbers(channel, sides->masses, sides->springs);
  char header[MO_NPY_HEADER + 1], last[48];
  if (channel == MO_RECORD_MASSES)
    snprintf(last, sizeof(last), "%u, 3", sides->masses);
  else
    snprintf(last, sizeof(last), "%u", numbers);
  memcpy(header, "\x93NUMPY\x01\x00", 8);
  header[8] = (char)(MO_NPY_HEADER - 10);
  header[9] = 0;
  const int n = snprintf(header + 10, sizeof(header) - 10,
                         "{'descr': '%s', 'fortran_order': False, 'shape': (%s%u, %s), }",
                         types[__builtin_ctz(channel)], leading, sides->frames, last);
  memset(header + 10 + n, ' ', MO_NPY_HEADER - 10 - (size_t)n);
  header[MO_NPY_HEADER - 1] = '\n';
  mo_text_bytes(text, header, MO_NPY_HEADER);
}
