# setup.sh: sourced by the scripts beside it. Finds the repository, installs packages, builds.
#
#   install_packages SECTION…   installs missing packages of these sections of tools/packages (as
#                               root, or with sudo)
#   fetch_promtool              puts Prometheus's checker, build/promtool, in its place once; tests
#                               that find none are skipped
#   configure_in FOLDER [ARG…]  configures FOLDER once with the given meson arguments; the module
#                               for GPUs has code for all, but for tools/test without a GPU
#   build_in FOLDER [ARG…]      the same, then builds it, or $targets of it

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
    mv "$part/usr/bin/promtool" build/promtool || echo "there is none: its tests are skipped"
  rm -rf "$part"
}

# Meson must run on Debian's own Python, whatever else is first in PATH.
export PATH="/usr/sbin:/usr/bin:/sbin:/bin:$PATH"

configure_in() {
  local folder=$1 output; shift
  if [ ! -f "$folder/build.ninja" ]; then
    output=$(meson setup "$folder" "-Dgpu_code=${gpu_code:-all}" "$@" 2>&1) ||
      { printf '%s\n' "$output"; fail "meson could not configure $folder"; }
  elif [ "${gpu_code:-all}" = all ] && meson introspect "$folder" --buildoptions |
      grep -q '"name": "gpu_code", "value": "check"'; then # left by tools/test
    meson configure "$folder" -Dgpu_code=all || fail "meson could not configure $folder"
  fi
}

build_in() {
  local folder=$1
  configure_in "$@"
  ninja -C "$folder" --quiet ${targets:-} || fail "the build in $folder failed"
}
