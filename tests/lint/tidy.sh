#!/usr/bin/env bash
# Runs clang-tidy over the sources that BUILD compiles (default: build), and over faults that it
# must find. Exit status 1 on a finding, or on a fault that was not found. NODES: the states of a
# function that the analyzer visits (default: 10000, a seventh of the processor time of clang's own
# 225000).
# Sources that are compiled several times (kernels) are checked once. One file per call: with
# several, clang-tidy 14 mistakes the va_list of later ones for uninitialized.
set -u
cd "$(dirname "$0")/../.." || exit 2
build=${1:-build}
nodes=${2:-10000}
jobs=$(nproc)
[ -f "$build/compile_commands.json" ] || { echo "# no $build/compile_commands.json"; exit 2; }
options=(--quiet --extra-arg=-Wno-unknown-warning-option --extra-arg=-Wno-unknown-pragmas
  --extra-arg=-Wno-ignored-optimization-argument --extra-arg=-Xclang
  --extra-arg=-analyzer-config --extra-arg=-Xclang "--extra-arg=max-nodes=$nodes")

# Each function of tests/lint/refused.c has one fault; the comment at the end of its line is the
# name of the check.
refused=$(clang-tidy "${options[@]}" tests/lint/refused.c -- 2>/dev/null)
status=0
while IFS=: read -r line text; do
  check=${text##*// }
  grep -qE "refused\.c:$line:.*[[,]$check[],]" <<<"$refused" ||
    { echo "# tests/lint/refused.c:$line: clang-tidy does not find $check"; status=1; }
done < <(grep -n '// ' tests/lint/refused.c)
[ $status -eq 0 ] || exit 1

git ls-files 'src/*.c' 'clients/*.c' |
  xargs -P "$jobs" -n 1 clang-tidy -p "$build" "${options[@]}" 2>/dev/null |
  sed 's/^/# /'
exit "${PIPESTATUS[1]}"
