/* store_command.h: `morphod store …`: maintenance of a state folder while no service uses it. */
#ifndef MORPHO_DAEMON_STORE_COMMAND_H
#define MORPHO_DAEMON_STORE_COMMAND_H

/* argv[1] is "store". Returns the exit status. */
int store_command(int argc, const char *const *argv);

#endif
