#!/usr/bin/env bash
# Says which C files clang-format would change. Exit status 1 if any.
set -u
cd "$(dirname "$0")/../.." || exit 2
found=$(git ls-files -z '*.c' '*.h' '*.inc' | xargs -0 -P "$(nproc)" -n 50 clang-format --dry-run -Werror 2>&1)
[ -z "$found" ] && exit 0
grep -oE '^[^: ]+\.(c|h|inc):' <<<"$found" | sort -u | sed 's/^/# /; s/:$/: run clang-format -i on it/'
grep -qE '^[^: ]+\.(c|h|inc):' <<<"$found" || printf '%s\n' "$found"
exit 1
