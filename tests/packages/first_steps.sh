#!/usr/bin/env bash
# The first minutes of a researcher on a bare Debian 12: the daemon from its package, the Python
# package in a separate environment, and the first notebook. All of it must take at most three
# minutes. Exit status 77: the Python package index cannot be reached.
set -euo pipefail
cd /root
[ ! -f certificates.pem ] || export PIP_CERT=/root/certificates.pem # those that the machine trusts
begin=$(date +%s)
apt-get install -y -qq ./morphod_*.deb python3-venv >/dev/null
python3 -m venv v
v/bin/pip install -q "$(echo morphod-*.whl)[jupyter]" matplotlib nbconvert ipykernel || {
  v/bin/pip download -q --no-deps --dest /tmp/one httpx && exit 1
  exit 77
}
installed=$(date +%s)
v/bin/jupyter nbconvert --log-level=WARN --to notebook --execute --output done.ipynb ./*.ipynb
end=$(date +%s)
echo "installed in $((installed - begin)) s, the notebook took $((end - installed)) s"
[ $((end - begin)) -le 180 ]
rm -rf v
