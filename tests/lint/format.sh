#!/usr/bin/env bash
# Lists the C files that clang-format would change. The exit status is 1 if there are any, or if
# clang-format would reflow tables in comments (see CommentPragmas in .clang-format) or leave other
# text alone.
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
[ "$(format "$text")" != "$text" ] || { echo "# clang-format does not reflow comments"; exit 1; }
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
