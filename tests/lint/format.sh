#!/usr/bin/env bash
# Says which C files clang-format would change. Exit status 1 if any.
set -u
cd "$(dirname "$0")/../.." || exit 2
status=0
while IFS= read -r -d '' file; do
  if ! clang-format --dry-run -Werror "$file" >/dev/null 2>&1; then
    printf '# %s: run clang-format -i on it\n' "$file"
    status=1
  fi
done < <(git ls-files -z '*.c' '*.h' '*.inc')
exit $status
