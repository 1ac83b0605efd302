/* writer.h: the writer with replaceable system calls, for tests. */
#ifndef MORPHO_ATLAS_WRITER_H
#define MORPHO_ATLAS_WRITER_H

#include <morpho/atlas.h>

#include "base/files.h"

/* Like mo_atlas_writer_create. files: must outlive the writer. */
int mo_atlas_writer_create_with(const struct mo_file_operations *files, const char *path,
                                const struct mo_atlas_source *source,
                                const struct mo_environment *environments, uint32_t n,
                                struct mo_atlas_writer **writer, struct mo_message *message);

#endif
