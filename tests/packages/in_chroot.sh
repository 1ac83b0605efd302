#!/usr/bin/env bash
# Uses the installed packages as a user would: the daemon, morphoctl, the Python package and the
# library. The state of an earlier run in the same folder must still be there.
set -euo pipefail
state=/var/tmp/morphod-state
morphod --version
as_nobody=(setpriv --reuid=nobody --regid=nogroup --clear-groups)
"${as_nobody[@]}" mkdir -p -m 0700 "$state"
"${as_nobody[@]}" morphod --state-dir="$state" --listen=127.0.0.1:0 \
  --port-file=/var/tmp/addresses >/var/tmp/morphod.log 2>&1 &
daemon=$!
trap 'kill $daemon 2>/dev/null || true' EXIT
for _ in $(seq 600); do [ -s /var/tmp/addresses ] && break; sleep 0.1; done
MORPHOD_SERVER=$(cat /var/tmp/addresses)
export MORPHOD_SERVER
morphoctl eval /usr/share/morphod/designs/voxel.json
python3 - <<'PYTHON'
import morphod
m = morphod.Client()
scored = m.evaluate([[[2, 2, 0]], [[2, 2, 0], [3, 2, 0]]], physics={"n_steps": 100})
print(scored.scores)
assert m.evaluate([scored.ids[0]], physics={"n_steps": 100}).scores[0] == scored.scores[0]
PYTHON
cat >/var/tmp/use.c <<'C'
#include <morpho/morphospace.h>
int main(void)
{
  return MO_DEFAULT_WORKSPACE.nx == 6 ? 0 : 1;
}
C
gcc -o /var/tmp/use /var/tmp/use.c -lmorpho -ljansson -lnettle -lopenblas -lm -lpthread
/var/tmp/use
kill "$daemon"
wait "$daemon"
rm -f /var/tmp/addresses
