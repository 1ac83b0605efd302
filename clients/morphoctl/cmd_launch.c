/* cmd_launch.c: "fleet slurm", "fleet systemd", "fleet kubernetes": prints files that start
 * workers, filled in. The templates come from data/fleet and are part of the program, so nothing
 * needs to be installed. */
#include <ctype.h>
#include <stdlib.h>
#include <string.h>

#include "commands.h"
#include "launch.h"

enum engine { SLURM, SYSTEMD, KUBERNETES };

/* Values for the placeholders of the files. A line with an empty placeholder is omitted. */
static const struct filling {
  const char *place, *option;
  const char *usual[3]; /* by engine */
} fillings[] = {
    {"SERVER", "fleet", {"https://daemon.example:8766", "", "https://daemon.example:8766"}},
    {"TOKEN_FILE",
     "worker-token-file",
     {"$HOME/.morphod-worker-token", "morphod-worker-%i.token", ""}},
    {"PIN", "pin", {"", "", ""}},
    {"WORKERS", "workers", {"4", "", "4"}},
    {"CPUS", "cpus", {"8", "", "8"}},
    {"TIME", "time", {"1-00:00:00", "", ""}},
    {"IDLE", "idle", {"10min", "", ""}},
    {"IMAGE", "image", {"", "", "registry.example/morphod:" MORPHOD_VERSION}},
};
enum { N_FILLINGS = sizeof(fillings) / sizeof(fillings[0]) };

/* A value appears between double quotes in a shell script, a unit or YAML, so it must not end
 * them. */
static bool is_safe(const char *value)
{
  for (const char *c = value; *c != 0; c++)
    if (!isgraph((unsigned char)*c) || strchr("\"'`\\", *c) != NULL)
      return false;
  return true;
}

static const char *value_of(const struct ctl *ctl, const struct filling *filling,
                            enum engine engine)
{
  return option_text(ctl, filling->option, filling->usual[engine]);
}

/* Returns the value for the @PLACEHOLDER@ that begins at a character; NULL if none does. */
static const struct filling *filling_at(const char *text)
{
  for (const struct filling *filling = fillings; filling < fillings + N_FILLINGS; filling++) {
    const size_t n = strlen(filling->place);
    if (text[0] == '@' && strncmp(text + 1, filling->place, n) == 0 && text[n + 1] == '@')
      return filling;
  }
  return NULL;
}

static void print_line(const struct ctl *ctl, enum engine engine, const char *line, size_t length)
{
  const struct filling *filling;
  for (size_t i = 0; i < length; i++)
    if ((filling = filling_at(line + i)) != NULL && *value_of(ctl, filling, engine) == 0)
      return;
  for (size_t i = 0; i < length; i++)
    if ((filling = filling_at(line + i)) != NULL) {
      fputs(value_of(ctl, filling, engine), stdout);
      i += strlen(filling->place) + 1;
    } else {
      putchar(line[i]);
    }
  putchar('\n');
}

void run_fleet_launch(struct ctl *ctl)
{
  static const char *const names[] = {"fleet slurm", "fleet systemd", "fleet kubernetes"};
  enum engine engine = SLURM;
  while (engine < KUBERNETES && strcmp(ctl->command->name, names[engine]) != 0)
    engine++;
  option_number(ctl, "workers", 1, 100000, 0);
  option_number(ctl, "cpus", 1, 1024, 0);
  for (const struct filling *filling = fillings; filling < fillings + N_FILLINGS; filling++)
    if (!is_safe(value_of(ctl, filling, engine)))
      fail(STATUS_USAGE, "--%s must not contain spaces, quotes or backslashes", filling->option);
  const char *text = (const char *)launch_files[engine].bytes;
  for (size_t length; *text != 0; text += length + 1) {
    length = strcspn(text, "\n");
    print_line(ctl, engine, text, length);
  }
}
