#!/usr/bin/env bash
# Names the C files that clang-format would change. Exit status 1 if there is one, or if it would
# not keep tables in comments (CommentPragmas in .clang-format) and break other text.
set -u
cd "$(dirname "$0")/../.." || exit 2
words=$(printf '%0.sword ' {1..30})end
text="/* $words */"
table="/* A table:
 *   name     $words
 *            $words
 *   other    value
 * | name | $words |
 * | other | value | */"
format() { clang-format --assume-filename=a.c <<<"$1"; }
[ "$(format "$table")" = "$table" ] || { echo "# clang-format breaks tables in comments"; exit 1; }
[ "$(format "$text")" != "$text" ] || { echo "# clang-format keeps any comment"; exit 1; }
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
