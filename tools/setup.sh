# setup.sh: sourced by the other scripts in this folder. Finds the repository, installs packages,
# builds.
#
#   install_packages SECTION…   installs missing packages of these sections of tools/packages (as
#                               root, or with sudo)
#   fetch_promtool              puts Prometheus's checker, build/promtool, in its place once; tests
#                               that need it are skipped without it
#   configure_in FOLDER [ARG…]  configures FOLDER once with the given meson arguments. $gpu_code
#                               (all, check) selects the GPUs that the GPU module has code for; on a
#                               machine with a GPU it is all
#   build_in FOLDER [ARG…]      the same, then builds it, or only $targets
#   build_shown FOLDER [ARG…]   the same, shows progress, and first estimates how long it takes

set -euo pipefail
repository=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
cd "$repository"

say() { printf '\n== %s\n' "$*"; }
fail() { printf '%s: %s\n' "${0##*/}" "$*" >&2; exit 1; }

as_root() {
  if [ "$(id -u)" -eq 0 ]; then "$@"
  elif command -v sudo >/dev/null 2>&1; then sudo "$@"
  else fail "root rights are needed for: $* (run as root, or install sudo)"
  fi
}

install_packages() {
  local section="" line status missing=() wanted=" $* "
  while read -r line; do
    case "$line" in
      ''|'#'*) ;;
      '['*']') section=${line#[}; section=${section%]} ;;
      *) if [[ $wanted == *" $section "* ]]; then
           status=$(dpkg-query -W -f '${db:Status-Status}' "$line" 2>/dev/null || true)
           [ "$status" = installed ] || missing+=("$line")
         fi ;;
    esac
  done < tools/packages
  [ ${#missing[@]} -eq 0 ] && return 0
  command -v apt-get >/dev/null 2>&1 ||
    fail "these Debian packages are missing, and there is no apt-get: ${missing[*]}"
  say "installing ${#missing[@]} packages: ${missing[*]}"
  # An old package list can name files that the mirror no longer has: refresh it first. If that
  # fails, use the old list.
  as_root env DEBIAN_FRONTEND=noninteractive apt-get update -qq || true
  as_root env DEBIAN_FRONTEND=noninteractive \
    apt-get install -y -qq --no-install-recommends "${missing[@]}" >/dev/null ||
    fail "apt-get could not install: ${missing[*]}"
}

# The package is not installed, because that would start a server.
fetch_promtool() {
  local part=build/promtool.part
  if command -v promtool >/dev/null || [ -x build/promtool ]; then return 0; fi
  say "fetching promtool"
  rm -rf "$part"
  mkdir -p "$part"
  (cd "$part" && { apt-get download -qq prometheus ||
    { as_root apt-get update -qq && apt-get download -qq prometheus; }; } &&
    dpkg-deb --fsys-tarfile prometheus_*.deb | tar -x ./usr/bin/promtool) 2>/dev/null &&
    mv "$part/usr/bin/promtool" build/promtool || echo "promtool is missing: its tests are skipped"
  rm -rf "$part"
}

# Meson must run on Debian's own Python, whatever else is first in PATH.
export PATH="/usr/sbin:/usr/bin:/sbin:/bin:$PATH"

has_gpu() { [ -e /dev/nvidiactl ]; }
gpu_code="" # set by the scripts, not by the environment
if has_gpu; then gpu_code=all; fi

configure_in() {
  local folder=$1 output; shift
  if [ ! -f "$folder/build.ninja" ]; then
    output=$(meson setup "$folder" ${gpu_code:+"-Dgpu_code=$gpu_code"} "$@" 2>&1) ||
      { printf '%s\n' "$output"; fail "meson could not configure $folder"; }
  elif [ -n "$gpu_code" ] && ! meson introspect "$folder" --buildoptions |
      grep -q "\"name\": \"gpu_code\", \"value\": \"$gpu_code\""; then
    meson configure "$folder" "-Dgpu_code=$gpu_code" || fail "meson could not configure $folder"
  fi
}

build_in() {
  local folder=$1
  configure_in "$@"
  ninja -C "$folder" --quiet ${targets:-} || fail "the build in $folder failed"
}

# Processor time per C file: 116 s for 326 files, without ccache, on slow cores.
compile_ms=360

# Reads ninja's output: prints its progress every 15 s, and errors and warnings at once.
build_progress() {
  local line next=$((SECONDS + 15))
  while IFS= read -r line; do
    case $line in
      '['*/*']'*)
        [ $SECONDS -lt $next ] && continue
        next=$((SECONDS + 15)) line=${line%%]*}
        echo "  ${line#[} steps are done" ;;
      'ninja: Entering directory'*|'ninja: no work to do.') ;;
      *) printf '%s\n' "$line" ;;
    esac
  done
}

# On a terminal ninja shows its own progress.
build_shown() {
  local folder=$1 output build steps files cuda seconds
  configure_in "$@"
  output=$(ninja -C "$folder" --quiet build.ninja) ||
    { printf '%s\n' "$output"; fail "meson could not reconfigure $folder"; }
  build=(ninja -C "$folder" ${targets:-})
  steps=$("${build[@]}" -n --verbose) || fail "ninja cannot build ${targets:-} in $folder"
  files=$(grep -c ' -c .*\.c$' <<<"$steps" || true)
  cuda=$(grep -c ' -c .*\.cu ' <<<"$steps" || true)
  seconds=$((files * compile_ms / 1000 / $(nproc) + 1))
  [ "$files" -eq 0 ] ||
    echo "Compiling $files files: about $seconds s on this machine, less with ccache."
  [ "$cuda" -eq 0 ] || echo "Compiling $cuda files for GPUs: several minutes more."
  if [ -t 1 ]; then "${build[@]}"
  else NINJA_STATUS='[%f/%t] ' "${build[@]}" | build_progress
  fi || fail "the build in $folder failed"
}
