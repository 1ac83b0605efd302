/* fault_vfs.h: SQLite's default file system with faults on demand.
 *
 * Registered as "faults": every file is the real one, with its methods replaced by ones that first
 * ask whether to fail. */
#ifndef MORPHO_TESTS_FAULT_VFS_H
#define MORPHO_TESTS_FAULT_VFS_H

#include <sqlite3.h>
#include <stdatomic.h>
#include <string.h>

static struct fault_plan {
  atomic_int write_error; /* 0 or the SQLite code that writes give */
  atomic_int sync_error;
  atomic_bool once;        /* the first error is the last */
  atomic_long writes_left; /* so many writes succeed before the error; negative: all fail */
  atomic_long writes;      /* seen */
  atomic_bool no_shared_memory;
} fault_plan;

struct fault_file {
  sqlite3_file base;
  sqlite3_io_methods methods;
  sqlite3_file *real;
};

static inline sqlite3_file *fault_real(sqlite3_file *file)
{
  return ((struct fault_file *)file)->real;
}

#define FAULT_PASS(name, parameters, arguments)                                                    \
  static inline int fault_##name parameters                                                        \
  {                                                                                                \
    sqlite3_file *real = fault_real(file);                                                         \
    return real->pMethods->name arguments;                                                         \
  }

static inline int fault_xClose(sqlite3_file *file)
{
  return fault_real(file)->pMethods->xClose(fault_real(file));
}
FAULT_PASS(xRead, (sqlite3_file * file, void *to, int n, sqlite3_int64 at), (real, to, n, at))
FAULT_PASS(xTruncate, (sqlite3_file * file, sqlite3_int64 size), (real, size))
FAULT_PASS(xFileSize, (sqlite3_file * file, sqlite3_int64 *size), (real, size))
FAULT_PASS(xLock, (sqlite3_file * file, int kind), (real, kind))
FAULT_PASS(xUnlock, (sqlite3_file * file, int kind), (real, kind))
FAULT_PASS(xCheckReservedLock, (sqlite3_file * file, int *result), (real, result))
FAULT_PASS(xFileControl, (sqlite3_file * file, int op, void *argument), (real, op, argument))
FAULT_PASS(xSectorSize, (sqlite3_file * file), (real))
FAULT_PASS(xDeviceCharacteristics, (sqlite3_file * file), (real))
FAULT_PASS(xShmMap, (sqlite3_file * file, int page, int size, int extend, void volatile **to),
           (real, page, size, extend, to))
FAULT_PASS(xShmLock, (sqlite3_file * file, int offset, int n, int flags), (real, offset, n, flags))
FAULT_PASS(xShmUnmap, (sqlite3_file * file, int remove), (real, remove))

static inline void fault_xShmBarrier(sqlite3_file *file)
{
  fault_real(file)->pMethods->xShmBarrier(fault_real(file));
}

static inline int fault_xWrite(sqlite3_file *file, const void *from, int n, sqlite3_int64 at)
{
  int error = atomic_load(&fault_plan.write_error);
  atomic_fetch_add(&fault_plan.writes, 1);
  if (error != 0 && atomic_fetch_sub(&fault_plan.writes_left, 1) <= 0) {
    if (atomic_load(&fault_plan.once))
      atomic_store(&fault_plan.write_error, 0);
    return error;
  }
  return fault_real(file)->pMethods->xWrite(fault_real(file), from, n, at);
}

static inline int fault_xSync(sqlite3_file *file, int flags)
{
  int error = atomic_load(&fault_plan.sync_error);
  if (atomic_load(&fault_plan.once))
    atomic_store(&fault_plan.sync_error, 0);
  return error != 0 ? error : fault_real(file)->pMethods->xSync(fault_real(file), flags);
}

static inline int fault_open(sqlite3_vfs *vfs, sqlite3_filename name, sqlite3_file *file, int flags,
                             int *out)
{
  struct fault_file *fault = (struct fault_file *)file;
  sqlite3_vfs *real = vfs->pAppData;
  int result;
  fault->real = (sqlite3_file *)(fault + 1);
  memset(fault->real, 0, (size_t)real->szOsFile);
  result = real->xOpen(real, name, fault->real, flags, out);
  file->pMethods = NULL;
  if (fault->real->pMethods == NULL)
    return result;
  fault->methods = (sqlite3_io_methods){2,
                                        fault_xClose,
                                        fault_xRead,
                                        fault_xWrite,
                                        fault_xTruncate,
                                        fault_xSync,
                                        fault_xFileSize,
                                        fault_xLock,
                                        fault_xUnlock,
                                        fault_xCheckReservedLock,
                                        fault_xFileControl,
                                        fault_xSectorSize,
                                        fault_xDeviceCharacteristics,
                                        fault_xShmMap,
                                        fault_xShmLock,
                                        fault_xShmBarrier,
                                        fault_xShmUnmap,
                                        NULL,
                                        NULL};
  if (atomic_load(&fault_plan.no_shared_memory))
    fault->methods.iVersion = 1;
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
  vfs.szOsFile = (int)sizeof(struct fault_file) + real->szOsFile;
  vfs.pAppData = real;
  vfs.xOpen = fault_open;
  return sqlite3_vfs_register(&vfs, 0);
}

#endif
