/* fault_vfs.h: SQLite's default file system with faults on demand, registered as "faults". */
#ifndef MORPHO_TESTS_FAULT_VFS_H
#define MORPHO_TESTS_FAULT_VFS_H

#include <sqlite3.h>
#include <stdatomic.h>

static struct fault_plan {
  atomic_int write_error; /* 0, or the SQLite code that writes return */
  atomic_int sync_error;
  atomic_bool once; /* only the first write fails */
  atomic_long
      writes_left; /* number of writes that succeed before the error; negative = all writes fail */
  atomic_bool no_shared_memory;
} fault_plan;

/* Data stored before the default VFS's file. */
struct fault_file {
  const sqlite3_io_methods *real;
  sqlite3_io_methods methods; /* the default methods, except for those that fail */
};

static inline struct fault_file *fault_beside(sqlite3_file *file)
{
  return (struct fault_file *)((char *)file + sqlite3_vfs_find(NULL)->szOsFile);
}

static inline int fault_write(sqlite3_file *file, const void *from, int n, sqlite3_int64 at)
{
  int error = atomic_load(&fault_plan.write_error);
  if (error != 0 && atomic_fetch_sub(&fault_plan.writes_left, 1) <= 0) {
    if (atomic_load(&fault_plan.once))
      atomic_store(&fault_plan.write_error, 0);
    return error;
  }
  return fault_beside(file)->real->xWrite(file, from, n, at);
}

static inline int fault_sync(sqlite3_file *file, int flags)
{
  int error = atomic_load(&fault_plan.sync_error);
  if (atomic_load(&fault_plan.once))
    atomic_store(&fault_plan.sync_error, 0);
  return error != 0 ? error : fault_beside(file)->real->xSync(file, flags);
}

static inline int fault_open(sqlite3_vfs *vfs, sqlite3_filename name, sqlite3_file *file, int flags,
                             int *out)
{
  struct fault_file *fault = fault_beside(file);
  sqlite3_vfs *real = vfs->pAppData;
  const int result = real->xOpen(real, name, file, flags, out);
  if (file->pMethods == NULL)
    return result;
  fault->real = file->pMethods;
  fault->methods = *file->pMethods;
  fault->methods.iVersion = atomic_load(&fault_plan.no_shared_memory) ? 1 : 2;
  fault->methods.xWrite = fault_write;
  fault->methods.xSync = fault_sync;
  file->pMethods = &fault->methods;
  return result;
}

static inline int fault_vfs_register(void)
{
  static sqlite3_vfs vfs;
  sqlite3_vfs *real = sqlite3_vfs_find(NULL);
  if (vfs.zName != NULL)
    return SQLITE_OK;
  vfs = *real;
  vfs.zName = "faults";
  vfs.pNext = NULL;
  vfs.szOsFile = real->szOsFile + (int)sizeof(struct fault_file);
  vfs.pAppData = real;
  vfs.xOpen = fault_open;
  return sqlite3_vfs_register(&vfs, 0);
}

#endif
