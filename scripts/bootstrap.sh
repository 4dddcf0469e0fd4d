#!/usr/bin/env bash
# Builds .venv with the dependencies of requirements.lock, by digest, and both distributions, editable.
#
#   scripts/bootstrap.sh          what the service, the command line and the build of the guide need
#   scripts/bootstrap.sh --dev    also what the tests and the linters need, Chromium among it
#   scripts/bootstrap.sh --bench  also the peers that the benchmarks measure beside us
#
# Needs Python 3.11 with pip; python3-venv is not assumed. Does nothing when .venv is up to date: a stamp in it
# holds the hash of everything that decides its contents. PYTHON=/path/to/python3.11 chooses the interpreter.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

VENV=.venv
export PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_NO_INPUT=1

say() { printf 'bootstrap: %s\n' "$*"; }
fail() { printf 'bootstrap: %s\n' "$*" >&2; exit 1; }

is_python311() {
    "$1" -c 'import sys; sys.exit(sys.version_info[:2] != (3, 11))' >/dev/null 2>&1
}

find_python() {
    local candidate
    for candidate in ${PYTHON:+"$PYTHON"} python3.11 python3 python /usr/bin/python3.11 /usr/local/bin/python3.11; do
        if is_python311 "$candidate"; then
            command -v "$candidate"
            return
        fi
    done
    fail "no Python 3.11 found (Debian 12: apt-get install python3 python3-pip); PYTHON=... names another place"
}

make_venv() {
    local python
    python=$(find_python)
    say "making $VENV with $python"
    rm -rf "$VENV"
    if "$python" -c 'import ensurepip, venv' >/dev/null 2>&1; then
        "$python" -m venv "$VENV"
        return
    fi
    # Debian keeps ensurepip in a package of its own; virtualenv brings the wheels that it would install.
    "$python" -m pip --version >/dev/null 2>&1 \
        || fail "$python has neither ensurepip nor pip (Debian: apt-get install python3-venv or python3-pip)"
    say "$python has no ensurepip: using virtualenv from .bootstrap"
    mkdir -p .bootstrap
    "$python" scripts/requirements.py bootstrap >.bootstrap/requirements.txt
    "$python" -m pip install --quiet --upgrade --target .bootstrap --no-deps --require-hashes \
        --requirement .bootstrap/requirements.txt
    PYTHONPATH=.bootstrap "$python" -m virtualenv --quiet --no-download "$VENV"
}

install_chromium() {
    local name
    for name in chromium chromium-browser google-chrome; do
        command -v "$name" >/dev/null && return
    done
    if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
        say "installing Chromium"
        apt-get update -qq
        DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends chromium >/dev/null
    else
        say "no Chromium: the browser tests will be skipped (Debian: apt-get install chromium)"
    fi
}

EXTRAS=api,sim,train,video,tables,guide
case "${1:-}" in
    "") ;;
    --dev) EXTRAS=$EXTRAS,dev ;;
    --bench) EXTRAS=$EXTRAS,dev,bench ;;
    *) fail "unknown option $1" ;;
esac
STAMP=$VENV/.bootstrap-stamp
WANTED=$(cat pyproject.toml setup.py clients/python/pyproject.toml requirements.lock scripts/*.sh scripts/requirements.py | sha256sum | cut -c1-64)

[ "${1:-}" = --dev ] && install_chromium
present=
if [ -f "$STAMP" ] && is_python311 "$VENV/bin/python"; then
    read -r stamped present <"$STAMP"
    case "$present" in
        "$EXTRAS" | "$EXTRAS",*) [ "$stamped" = "$WANTED" ] && exit 0 ;;
        *) present= ;;
    esac
fi
EXTRAS=${present:-$EXTRAS}
is_python311 "$VENV/bin/python" && "$VENV/bin/python" -m pip --version >/dev/null 2>&1 || make_venv
rm -f "$STAMP"
PIP=("$VENV/bin/python" -m pip install --quiet --no-deps --prefer-binary)
LOCKED=$(mktemp)
trap 'rm -f "$LOCKED"' EXIT
say "installing what PhysWorld [$EXTRAS] needs, by digest"
"$VENV/bin/python" scripts/requirements.py ${EXTRAS//,/ } >"$LOCKED"
"${PIP[@]}" --require-hashes --requirement "$LOCKED"
say "installing torch"
scripts/install_torch.sh "$VENV/bin/python"
say "installing PhysWorld and its client"
"${PIP[@]}" --no-build-isolation --editable . --editable clients/python
"$VENV/bin/python" scripts/package_links.py
printf '%s %s\n' "$WANTED" "$EXTRAS" >"$STAMP"
say "done: $VENV"
