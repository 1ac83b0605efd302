/* worker_command.h: `morphod worker`, which computes for the daemon of another machine. */
#ifndef MORPHO_DAEMON_WORKER_COMMAND_H
#define MORPHO_DAEMON_WORKER_COMMAND_H

/* Returns the exit status. */
int worker_command(int argc, const char *const *argv);

#endif
