#!/usr/bin/env bash
# Runs clang-tidy over the sources that BUILD compiles (default: build). Exit status 1 on a finding.
# Sources that are compiled several times (kernels) are checked once. One file per call: with
# several, clang-tidy 14 takes the va_list of later ones for uninitialized.
set -u
cd "$(dirname "$0")/../.." || exit 2
build=${1:-build}
jobs=$(nproc)
[ -f "$build/compile_commands.json" ] || { echo "# no $build/compile_commands.json"; exit 2; }
git ls-files 'src/*.c' 'clients/*.c' |
  xargs -P "$jobs" -n 1 clang-tidy --quiet -p "$build" --extra-arg=-Wno-unknown-warning-option \
    --extra-arg=-Wno-unknown-pragmas --extra-arg=-Wno-ignored-optimization-argument 2>/dev/null |
  sed 's/^/# /'
exit "${PIPESTATUS[1]}"
