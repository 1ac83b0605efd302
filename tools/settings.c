/* settings.c: prints the tables of settings for what is not linked with them, when it is built.
 *   settings options      the options of morphoctl, in C: clients/morphoctl/table_of_commands.c
 *   settings man FILE     a manual page, in which a line "@training@" or "@campaign@" becomes the
 *                         list of these options
 *   settings list         one line per setting: kind, place in the request, default, bounds */
#include <ctype.h>
#include <stdio.h>
#include <string.h>

#include "base/text.h"
#include "evolution/fields.h"
#include "learning/fields.h"
#include "rollout/physics.h"

#define PLACE_BYTES 128

/* Settings whose option has a different name, or a letter. */
static const struct {
  const char *place, *option, *letter;
} names[] = {
    {"steps", NULL, "'n'"},
    {"batch", NULL, "'b'"},
    {"generations", NULL, "'n'"},
    {"learning.batch", NULL, "'b'"},
    {"mutation.share", "mutation-share", "0"},
    {"mutation.rate", "mutation-rate", "0"},
    {"mutation.growth", "mutation-growth", "0"},
    {"selection.kind", "selection", "0"},
    {"selection.size", "tournament-size", "0"},
    {"selection.weight", "novelty-weight", "0"},
};

/* Settings whose options are written by hand, because of their values. */
static const char *const by_hand[] = {"workspace",     "exclude_pretraining",
                                      "schedule.kind", "learning.schedule.kind",
                                      "vary",          "learning.vary"};

/* The defaults of one kind of job: one settings struct for each preset or mode. */
struct kind {
  const char *name;
  const void *const *settings;
  size_t n;
  const char *otherwise; /* describes differing defaults; NULL: the first, and that of finetuning */
};

struct row {
  const struct mo_field *field;
  size_t offset;
  char place[PLACE_BYTES], option[PLACE_BYTES];
  const char *letter; /* "0" if none */
  char fallback[160], bounds[96];
};

typedef void row_function(const struct kind *kind, const struct row *row);

static void name_option(struct row *row)
{
  const char *dot = strrchr(row->place, '.');
  snprintf(row->option, sizeof(row->option), "%s", dot != NULL ? dot + 1 : row->place);
  row->letter = "0";
  for (size_t i = 0; i < sizeof(names) / sizeof(names[0]); i++)
    if (strcmp(names[i].place, row->place) == 0) {
      row->letter = names[i].letter;
      if (names[i].option != NULL)
        snprintf(row->option, sizeof(row->option), "%s", names[i].option);
    }
  for (char *c = row->option; *c != '\0'; c++)
    if (*c == '_')
      *c = '-';
}

static void value_text(const struct row *row, const void *settings, char text[64])
{
  const char *value = (const char *)settings + row->offset;
  uint32_t count;
  uint64_t seed;
  double number;
  switch (row->field->type) {
  case MO_FIELD_WORD:
    memcpy(&count, value, sizeof(count));
    snprintf(text, 64, "%s", mo_word(row->field->words, count));
    break;
  case MO_FIELD_NUMBER:
    memcpy(&number, value, sizeof(number));
    snprintf(text, 64, "%s", MO_NUMBER(number));
    break;
  case MO_FIELD_SEED:
    memcpy(&seed, value, sizeof(seed));
    snprintf(text, 64, "%llu", (unsigned long long)seed);
    break;
  default: memcpy(&count, value, sizeof(count)); snprintf(text, 64, "%u", count);
  }
}

/* Finds the default: "1400", or a description if it differs; "" if the help says what happens when
 * the setting is not given. */
static void find_fallback(const struct kind *kind, struct row *row)
{
  char first[64], other[64];
  if ((row->field->flags & MO_FIELD_NULL) != 0 && row->field->type != MO_FIELD_WORD)
    return;
  value_text(row, kind->settings[0], first);
  snprintf(row->fallback, sizeof(row->fallback), "%s", first);
  for (size_t i = 1; i < kind->n; i++) {
    value_text(row, kind->settings[i], other);
    if (strcmp(other, first) != 0 && kind->otherwise == NULL)
      snprintf(row->fallback, sizeof(row->fallback), "%s; finetune: %s", first, other);
    else if (strcmp(other, first) != 0)
      snprintf(row->fallback, sizeof(row->fallback), "%s", kind->otherwise);
  }
  if (strstr(row->place, "schedule.") != NULL)
    snprintf(row->fallback, sizeof(row->fallback), "by the kind of schedule");
}

static void find_bounds(struct row *row)
{
  const struct mo_field *field = row->field;
  row->bounds[0] = '\0';
  if (field->type == MO_FIELD_COUNT || field->type == MO_FIELD_NUMBER)
    snprintf(row->bounds, sizeof(row->bounds), "%s %.10g and %s %.10g",
             field->flags & MO_FIELD_ABOVE_MIN ? "above" : "at least", field->min,
             field->flags & MO_FIELD_BELOW_MAX ? "below" : "at most", field->max);
}

static void walk(const struct kind *kind, const struct mo_fields *fields, size_t offset,
                 const char *prefix, row_function *each)
{
  for (size_t i = 0; i < fields->n; i++) {
    const struct mo_field *field = &fields->rows[i];
    struct row row = {.field = field, .offset = offset + field->offset};
    bool hand = false;
    snprintf(row.place, sizeof(row.place), "%s%s%s", prefix,
             *prefix != '\0' && field->name != NULL ? "." : "",
             field->name != NULL ? field->name : "");
    for (size_t k = 0; k < sizeof(by_hand) / sizeof(by_hand[0]); k++)
      hand |= strcmp(by_hand[k], row.place) == 0;
    if (hand || strcmp(row.place, "physics") == 0)
      continue;
    if (field->group != NULL) {
      walk(kind, field->group, row.offset, row.place, each);
      continue;
    }
    name_option(&row);
    find_fallback(kind, &row);
    find_bounds(&row);
    each(kind, &row);
  }
}

/* ---- forms of output ---- */

static void print_help(const struct row *row)
{
  const bool bounded = row->bounds[0] != '\0', falls = row->fallback[0] != '\0';
  printf("%c%s", toupper(row->field->help[0]), row->field->help + 1);
  if (bounded || falls)
    printf(" (%s%s%s%s)", row->bounds, bounded && falls ? "; " : "", falls ? "default: " : "",
           row->fallback);
}

/* Returns the name of the value in the help, and how morphoctl reads it. */
static const char *reader(const struct mo_field *field)
{
  return field->type == MO_FIELD_NUMBER                                  ? "REAL"
         : field->type == MO_FIELD_COUNT || field->type == MO_FIELD_SEED ? "WHOLE"
                                                                         : "WORD";
}

static void print_value(const struct mo_field *field, const char *between)
{
  if (field->type != MO_FIELD_WORD)
    printf("%s", field->type == MO_FIELD_NUMBER ? "X" : "N");
  for (int i = 0; field->type == MO_FIELD_WORD && field->words[i] != NULL; i++)
    printf("%s%s", i > 0 ? between : "", field->words[i]);
}

static void print_option(const struct kind *kind, const struct row *row)
{
  (void)kind;
  printf("  {\"%s\", %s, \"", row->option, row->letter);
  print_value(row->field, "|");
  printf("\", \"");
  print_help(row);
  printf(".\", \"%s\", FIELD_%s}, \\\n", row->place, reader(row->field));
}

static void print_manual(const struct kind *kind, const struct row *row)
{
  (void)kind;
  printf(".It Fl ");
  if (*row->letter != '0')
    printf("%c , Fl ", row->letter[1]);
  printf("-%s %s ", row->option, row->field->type == MO_FIELD_WORD ? "Li" : "Ar");
  print_value(row->field, " | ");
  printf("\n");
  print_help(row);
  printf(".\n");
}

static void print_row(const struct kind *kind, const struct row *row)
{
  printf("%s\t%s\t%s\t%s\n", kind->name, row->place, row->fallback, row->bounds);
}

static void walk_kind(const char *name, row_function *each)
{
  const struct mo_training_settings pretrain = mo_training_defaults(MO_TRAINING_PRETRAIN),
                                    finetune = mo_training_defaults(MO_TRAINING_FINETUNE);
  const void *trainings[] = {&pretrain, &finetune}, *campaigns[9], *learning[6];
  struct mo_campaign_settings settings[9];
  for (int i = 0; i < 9; i++) {
    settings[i] = mo_campaign_preset((enum mo_campaign_mode)(i / 3), (enum mo_preset)(i % 3));
    campaigns[i] = &settings[i];
    if (i >= 3)
      learning[i - 3] = &settings[i];
  }
  const struct kind training = {name, trainings, 2, NULL};
  const struct kind campaign = {name, campaigns, 9, "by preset and mode"};
  const struct kind learns = {name, learning, 6, "by mode"};
  if (strcmp(name, "training") == 0) {
    walk(&training, &mo_training_fields, 0, "", each);
  } else {
    walk(&campaign, &mo_campaign_fields, 0, "", each);
    walk(&learns, &mo_campaign_learning_fields, 0, "learning", each);
  }
}

static void print_options(void)
{
  static const char *const kinds[] = {"training", "campaign"};
  printf("/* Made by tools/settings.c from the tables of settings. */\n");
  for (int k = 0; k < 2; k++) {
    printf("#define %s_OPTIONS \\\n", k == 0 ? "TRAINING" : "CAMPAIGN");
    walk_kind(kinds[k], print_option);
    printf("\n");
  }
  printf("#define PHYSICS_FIELDS \\\n");
  for (size_t i = 0; i < mo_physics_fields.n; i++) {
    const struct mo_field *field = &mo_physics_fields.rows[i];
    printf("  {\"%s\", FIELD_%s}, \\\n", field->name, reader(field));
  }
  printf("\n");
}

static int fill_manual(const char *path)
{
  char line[1024];
  FILE *file = fopen(path, "r");
  if (file == NULL) {
    perror(path);
    return 1;
  }
  while (fgets(line, sizeof(line), file) != NULL) {
    if (strcmp(line, "@training@\n") == 0)
      walk_kind("training", print_manual);
    else if (strcmp(line, "@campaign@\n") == 0)
      walk_kind("campaign", print_manual);
    else
      fputs(line, stdout);
  }
  fclose(file);
  return 0;
}

int main(int argc, char **argv)
{
  if (argc == 2 && strcmp(argv[1], "options") == 0) {
    print_options();
  } else if (argc == 2 && strcmp(argv[1], "list") == 0) {
    walk_kind("training", print_row);
    walk_kind("campaign", print_row);
  } else if (argc == 3 && strcmp(argv[1], "man") == 0) {
    return fill_manual(argv[2]);
  } else {
    fprintf(stderr, "usage: settings options | list | man FILE\n");
    return 2;
  }
  return fflush(stdout) != 0;
}
