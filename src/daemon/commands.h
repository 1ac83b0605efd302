/* commands.h: the commands of morphod other than the service. Each receives the whole command line,
 * in which argv[1] is the name of the command, and returns the exit status. */
#ifndef MORPHO_DAEMON_COMMANDS_H
#define MORPHO_DAEMON_COMMANDS_H

/* Runs `morphod store …`: maintenance of a state folder while no service uses it. */
int store_command(int argc, const char *const *argv);
/* Runs `morphod worker`, which computes for a daemon on another machine. */
int worker_command(int argc, const char *const *argv);

#endif
