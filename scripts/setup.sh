#!/usr/bin/env bash
# Makes .venv in the repository's root with everything that the project needs. Does only what is
# missing, so that a second call takes a moment. PYTHON=/path/to/python chooses the interpreter.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

venv=.venv
stamp=$venv/.installed
extras=dev,kiss-slam,rerun,joblib,ray,slurm
# The shared libraries that Open3D links to beyond those of any system, and their Debian packages.
libraries="libEGL.so.1=libegl1 libGL.so.1=libgl1 libX11.so.6=libx11-6 libidn2.so.0=libidn2-0
           libstdc++.so.6=libstdc++6 libudev.so.1=libudev1 libusb-1.0.so.0=libusb-1.0-0"

fail() {
    echo "setup: $*" >&2
    exit 1
}

find_python() {
    local candidate
    for candidate in ${PYTHON:-python3 python3.13 python3.12 python3.11}; do
        if "$candidate" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))' 2>/dev/null; then
            echo "$candidate"
            return
        fi
    done
    fail "needs Python 3.11, 3.12 or 3.13; ${PYTHON:-python3} is $("${PYTHON:-python3}" --version 2>&1 || true)." \
        "Install one, for instance with 'apt-get install python3.11 python3.11-venv', or name it: make setup PYTHON=/path/to/python3.12"
}

missing_packages() {
    local python=$1 known entry
    known=$(PATH=$PATH:/sbin:/usr/sbin ldconfig -p 2>/dev/null || true)
    for entry in $libraries; do
        [[ $known == *"${entry%%=*} "* ]] || echo "${entry#*=}"
    done
    if [[ ! -x $venv/bin/python ]] && ! "$python" -c 'import ensurepip, venv' 2>/dev/null; then
        "$python" -c 'import sys; print("python%d.%d-venv" % sys.version_info[:2])'
    fi
}

install_packages() {
    local as_root=()
    command -v apt-get >/dev/null || fail "install what Debian calls: $*"
    if [[ $(id -u) != 0 ]]; then
        sudo -n true 2>/dev/null || fail "some system packages are missing. Run this, then try again:
    sudo apt-get update && sudo apt-get install --yes --no-install-recommends $*"
        as_root=(sudo -n)
    fi
    echo "setup: installing system packages: $*"
    "${as_root[@]}" apt-get update --quiet=2
    "${as_root[@]}" env DEBIAN_FRONTEND=noninteractive \
        apt-get install --yes --no-install-recommends --quiet=2 "$@" >/dev/null
}

main() {
    local python packages wanted
    if "$venv/bin/python" -c '' 2>/dev/null; then
        python=$venv/bin/python
    else
        python=$(find_python)
    fi
    packages=$(missing_packages "$python")
    # shellcheck disable=SC2086 # one word a package
    [[ -z $packages ]] || install_packages $packages
    # A browser is for tests alone, which are skipped without it.
    command -v chromium >/dev/null || (install_packages chromium) ||
        echo "setup: going on without chromium: the tests of reports in a browser will be skipped" >&2
    if [[ $python != "$venv/bin/python" ]]; then
        "$python" -m venv --clear "$venv"
    fi
    wanted="$(cksum <pyproject.toml) $extras $PWD"
    if [[ $(cat "$stamp" 2>/dev/null || true) != "$wanted" ]]; then
        echo "setup: installing Python packages into $venv (about 3.4 GB; a minute or more)"
        "$venv/bin/python" -m pip install --quiet --disable-pip-version-check --editable ".[$extras]"
        echo "$wanted" >"$stamp"
    fi
}

main
