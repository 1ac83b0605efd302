/* slurm.c: see slurm.h. Newer versions say it in the environment; others are asked. */
#include "daemon/slurm.h"

#include <fcntl.h>
#include <spawn.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>

/* Reads what squeue writes: local time as 2026-11-24T09:30:00. 0: something else, such as NONE. */
static int64_t read_time(const char *text)
{
  struct tm time = {.tm_isdst = -1};
  const char *end = strptime(text, "%Y-%m-%dT%H:%M:%S", &time);
  if (end == NULL || (*end != '\0' && *end != '\n'))
    return 0;
  const time_t seconds = mktime(&time);
  return seconds > 0 ? seconds : 0;
}

/* Runs a program and reads the first line of its output. false: it failed. */
static bool ask(const char *const *command, char *line, size_t capacity)
{
  int ends[2], status = -1;
  posix_spawn_file_actions_t actions;
  pid_t child;
  if (pipe2(ends, O_CLOEXEC) != 0)
    return false;
  posix_spawn_file_actions_init(&actions);
  posix_spawn_file_actions_adddup2(&actions, ends[1], STDOUT_FILENO);
  posix_spawn_file_actions_addopen(&actions, STDERR_FILENO, "/dev/null", O_WRONLY, 0);
  const int error =
      posix_spawnp(&child, command[0], &actions, NULL, (char *const *)command, environ);
  posix_spawn_file_actions_destroy(&actions);
  close(ends[1]);
  FILE *file = fdopen(ends[0], "r");
  const bool got = error == 0 && file != NULL && fgets(line, (int)capacity, file) != NULL;
  if (file != NULL)
    fclose(file);
  else
    close(ends[0]);
  return (error != 0 || waitpid(child, &status, 0) == child) && got && status == 0;
}

int64_t slurm_job_end_s(void)
{
  const char *end = getenv("SLURM_JOB_END_TIME"), *job = getenv("SLURM_JOB_ID");
  char line[64];
  if (end != NULL && *end != '\0' && strspn(end, "0123456789") == strlen(end))
    return strtoll(end, NULL, 10);
  if (job == NULL || *job == '\0')
    return 0;
  const char *const command[] = {"squeue", "-h", "-j", job, "-o", "%e", NULL};
  return ask(command, line, sizeof(line)) ? read_time(line) : 0;
}
