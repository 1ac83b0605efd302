/* learning_json.c: see learning_json.h. */
#include "api/learning_json.h"

#include <math.h>
#include <string.h>

#include "api/job_json.h"

void mo_reference_write(struct mo_text *text, const char *name, const struct mo_sha256 *sha256)
{
  mo_text_add(text, "{\"name\":");
  if (name[0] != '\0')
    mo_text_json_string(text, name, strlen(name));
  else
    mo_text_add(text, "null");
  mo_text_add(text, ",\"sha256\":");
  mo_hash_write(text, sha256);
  mo_text_add(text, "}");
}

void mo_report_json(struct mo_text *text, const struct mo_training_report *report, double seconds)
{
  mo_text_member_number(text, "mean_loss", report->mean_loss);
  mo_text_member_number(text, "rate", report->rate);
  mo_text_member_number(text, "gradient_norm", report->gradient_norm);
  mo_text_member_number(text, "clipped_share", report->clipped_share);
  mo_text_member_number(text, "clipped_robots_share", report->clipped_robots_share);
  mo_text_member_count(text, "diverged", report->diverged);
  mo_text_member_count(text, "zeroed", report->zeroed);
  mo_text_member_bool(text, "skipped", report->skipped);
  mo_text_member_count(text, "bounded", report->bounded);
  mo_text_member_number(text, "seconds", seconds);
}

void mo_csv_number(struct mo_text *text, double value)
{
  mo_text_bytes(text, ",", 1);
  if (isfinite(value))
    mo_text_json_number(text, value);
}

void mo_report_csv(struct mo_text *text, const struct mo_training_report *report, double seconds)
{
  mo_csv_number(text, report->mean_loss);
  mo_csv_number(text, report->rate);
  mo_csv_number(text, report->gradient_norm);
  mo_csv_number(text, report->clipped_share);
  mo_csv_number(text, report->clipped_robots_share);
  mo_text_format(text, ",%u,%u,%d,%u", report->diverged, report->zeroed, report->skipped,
                 report->bounded);
  mo_csv_number(text, seconds);
}
