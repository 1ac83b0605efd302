#!/usr/bin/env bash
# Names the C files that clang-format would change. Exit status 1 if there is one.
set -u
cd "$(dirname "$0")/../.." || exit 2
found=$(git ls-files -z '*.c' '*.h' '*.inc' '*.cu' '*.cuh' |
  xargs -0 -P "$(nproc)" -n 50 clang-format --dry-run -Werror 2>&1)
[ -z "$found" ] && exit 0
files=$(grep -oE '^[^: ]+\.(c|h|inc|cuh?):' <<<"$found" | sort -u)
if [ -n "$files" ]; then
  sed 's/^/# /; s/:$/: run clang-format -i on it/' <<<"$files"
else
  printf '%s\n' "$found"
fi
exit 1
