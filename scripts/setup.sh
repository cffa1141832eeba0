#!/bin/sh
# Everything `make` needs: a virtual environment in .venv with the pinned packages and this one, and a libLLVM.
# `setup.sh docs` adds what the manual is made with.
# Run again after success it returns at once; run again after an interruption it finishes the work.
# Needs Python >= 3.10 and a POSIX shell. PYTHON=... chooses the Python.
set -eu

cd "$(dirname "$0")/.."
root=$(pwd -P)
venv_python=.venv/bin/python
stamp=.venv/setup-complete
docs_stamp=.venv/setup-docs-complete
installing=.venv/setup-installing
pins=requirements/lock.txt

say() { printf '%s\n' "setup: $*"; }
fail() {
    printf '%s\n' "setup: $*" >&2
    exit 1
}
has() { command -v "$1" >/dev/null 2>&1; }

# ---- what a stamp stands for: these inputs, set up at this place

inputs() {
    printf '%s\n' "$root"
    cksum pyproject.toml "$pins" scripts/setup.sh
}

is_complete() { # stamp
    [ -x "$venv_python" ] && [ -f "$1" ] && [ "$(inputs)" = "$(cat "$1")" ]
}

complete() { # stamp
    inputs >"$1.new"
    mv "$1.new" "$1"
    say "ready"
}

# ---- system packages: only as root, or where sudo asks for no password

may_be_root() { [ "$(id -u)" = 0 ] || { has sudo && sudo -n true 2>/dev/null; }; }

as_root() {
    if [ "$(id -u)" = 0 ]; then "$@"; else sudo -n "$@"; fi
}

apt_install() {
    as_root env DEBIAN_FRONTEND=noninteractive apt-get install -y --no-install-recommends "$1" </dev/null
}

# ---- Python

is_python_310() { "$1" -c 'import sys; sys.exit(sys.version_info < (3, 10))' >/dev/null 2>&1; }

find_python() {
    if [ -n "${PYTHON:-}" ]; then
        is_python_310 "$PYTHON" || fail "PYTHON=$PYTHON is no Python 3.10 or newer; name another one."
        printf '%s\n' "$PYTHON"
        return
    fi
    for candidate in python3.13 python3.12 python3.11 python3.10 python3 python; do
        if is_python_310 "$candidate"; then
            printf '%s\n' "$candidate"
            return
        fi
    done
    fail "found no Python 3.10 or newer; install one from your system's packages or python.org, then run make again."
}

can_make_venv() { "$1" -c 'import venv, ensurepip' >/dev/null 2>&1; }

# Debian and Ubuntu package these modules apart from Python.
install_venv_module() { # python
    has apt-get || fail "$1 lacks the modules venv and ensurepip; install a complete Python, then run make again."
    package=python$("$1" -c 'import sys; print("%d.%d" % sys.version_info[:2])')-venv
    if may_be_root; then
        say "installing $package, because $1 lacks the module venv"
        apt_install "$package" || { as_root apt-get update && apt_install "$package"; } || true
    fi
    can_make_venv "$1" || fail "$1 cannot make virtual environments: run 'sudo apt-get install $package', then run make again."
}

# Unusable: one that was moved (its commands carry the path of the place it was made at) or half filled (pip takes a
# package whose installation was cut off for an installed one).
is_venv_usable() {
    is_python_310 "$venv_python" && [ ! -e "$installing" ] && grep -qF "$root/.venv" .venv/bin/activate &&
        "$venv_python" -m pip --version >/dev/null 2>&1
}

make_venv() {
    python=$(find_python)
    can_make_venv "$python" || install_venv_module "$python"
    say "making .venv with $("$python" --version)"
    "$python" -m venv --clear .venv
}

pip_install() { "$venv_python" -m pip install --disable-pip-version-check -q -c "$pins" "$@"; }

install_packages() { # extra
    : >"$installing"
    # Built without isolation, so that the build too takes the pinned packages and fetches nothing else.
    pip_install hatchling editables && pip_install --no-build-isolation -e ".[$1]" ||
        fail "pip could not install the packages (see above); check the network and the disk, then run make again."
    rm "$installing"
}

# ---- libLLVM, which the CPU back end of Dr.Jit loads: Dr.Jit itself says whether it can

llvm_works() {
    status=0
    "$venv_python" scripts/probe_llvm.py || status=$?
    case $status in
    0) return 0 ;;
    3) return 1 ;;
    *) fail "Dr.Jit cannot be imported (see above); remove the folder .venv and run make again." ;;
    esac
}

newest_apt_llvm() {
    apt-cache search --names-only '^libllvm[0-9]+(t64)?$' 2>/dev/null |
        sed -n 's/^libllvm\([0-9]*\)\(t64\)\{0,1\} .*/\1 libllvm\1\2/p' | sort -n | tail -n 1 | awk '$1 >= 15 { print $2 }'
}

llvm_by_apt() {
    has apt-get && may_be_root || return 1
    say "installing libLLVM with apt-get"
    package=$(newest_apt_llvm)
    if [ -z "$package" ] || ! apt_install "$package"; then
        as_root apt-get update || return 1
        package=$(newest_apt_llvm)
        [ -n "$package" ] && apt_install "$package"
    fi
}

llvm_by_dnf() {
    has dnf && may_be_root || return 1
    say "installing libLLVM with dnf"
    as_root dnf install -y llvm-libs </dev/null
}

llvm_by_brew() {
    has brew || return 1
    say "installing libLLVM with brew"
    brew install llvm </dev/null
}

llvm_by_conda() {
    for conda in conda mamba micromamba; do
        has "$conda" || continue
        say "installing libLLVM with $conda, into .venv/llvm"
        "$conda" create -y -q -p .venv/llvm --override-channels -c conda-forge libllvm19 </dev/null && return
    done
    return 1
}

llvm_advice() {
    if has apt-get; then
        package=$(newest_apt_llvm)
        echo "run 'sudo apt-get install ${package:-libllvm15}'"
    elif has dnf; then
        echo "run 'sudo dnf install llvm-libs'"
    elif [ "$(uname -s)" = Darwin ]; then
        echo "install Homebrew and run 'brew install llvm'"
    else
        echo "install LLVM from your system's packages or name one you have in DRJIT_LIBLLVM_PATH"
    fi
}

provide_llvm() {
    if llvm_works; then return; fi
    say "Dr.Jit finds no libLLVM of version 15 or newer"
    for way in apt dnf brew conda; do
        if "llvm_by_$way" && llvm_works; then return; fi
    done
    fail "the CPU back end needs libLLVM 15 or newer, which could not be installed from here: $(llvm_advice), then run make again."
}

# ----

set_up() {
    rm -f "$stamp"
    is_venv_usable || make_venv
    say "installing the pinned packages (PyTorch is large: the first time takes minutes)"
    install_packages dev
    provide_llvm
    complete "$stamp"
}

set_up_docs() {
    rm -f "$docs_stamp"
    say "installing what the manual is made with"
    install_packages docs
    complete "$docs_stamp"
}

case ${1:-} in
'' | docs) ;;
*) fail "there is no '$1' to set up; say 'docs' or nothing." ;;
esac
is_complete "$stamp" || set_up
[ "${1:-}" != docs ] || is_complete "$docs_stamp" || set_up_docs
