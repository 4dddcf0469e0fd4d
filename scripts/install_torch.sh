#!/bin/sh
# Installs torch with the interpreter that is named, after the packages that it needs: scripts/install_torch.sh PYTHON
#
# The CPU build is taken by its digest where the index has it. Elsewhere (other platforms, an index without that build)
# the plain build is taken, which may bring gigabytes of CUDA libraries and is the one thing that is not locked.
set -eu
here=$(dirname "$0")
locked=$(mktemp)
trap 'rm -f "$locked"' EXIT
"$1" "$here/requirements.py" torch >"$locked"
if ! "$1" -m pip install --quiet --no-deps --require-hashes --requirement "$locked" 2>/dev/null; then
    version=$(sed -n 's/^torch==\([0-9.]*\).*/\1/p' "$locked")
    echo "torch $version: no CPU build with the locked digest; installing the plain build, unlocked"
    "$1" -m pip install --quiet "torch==$version"
fi
