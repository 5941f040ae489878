#!/bin/sh
# Puts udkjax into a virtual environment of its own, .venv, with the newest Python of this machine that runs. Safe to repeat.
#
#   sh install.sh               what a user needs, with all extras
#   sh install.sh --test        and what the tests need
#   sh install.sh --dev         and what style and type checks need
#   sh install.sh --docs        and what builds the documentation
#   sh install.sh --python X    with this Python: a version (3.11), a name or a path
#   sh install.sh --venv DIR    in DIR instead of .venv
#
# Exit status: 0 installed, 1 failed, 2 wrong usage, 3 no suitable Python.
set -eu
cd "$(dirname "$0")"

oldest=11 # Python 3.x: what pyproject.toml requires
newest=13 # the newest that constraints.txt was tested with
fast=12   # the first that the fast JAX releases are made for

say() { printf 'udkjax: %s\n' "$*"; }
die() {
    status=$1
    shift
    printf 'udkjax: %s\n' "$*" >&2
    exit "$status"
}
usage() { sed -n '2,/^set /{s/^# \{0,1\}//p;}' "$0"; }

venv=.venv extras=all wanted=''
while [ $# -gt 0 ]; do
    case $1 in
    --test) extras=$extras,test ;;
    --dev) extras=$extras,dev ;;
    --docs) extras=$extras,docs ;;
    --python | --venv)
        [ $# -ge 2 ] || die 2 "$1 needs a value"
        if [ "$1" = --python ]; then wanted=$2; else venv=$2; fi
        shift
        ;;
    -h | --help) usage && exit 0 ;;
    *) die 2 "unknown option $1; --help lists them" ;;
    esac
    shift
done

# The minor version of a Python 3 that really runs: pyenv's shims exist for versions that are not active.
# Only 64-bit CPython, released, with the GIL: the others have no wheels.
minor_of() {
    "$1" -c '
import sys, sysconfig
ok = sys.version_info[0] == 3 and sys.implementation.name == "cpython" and sys.maxsize > 2**32
ok = ok and sys.version_info[3] == "final" and not sysconfig.get_config_var("Py_GIL_DISABLED")
print(sys.version_info[1]) if ok else sys.exit(1)' 2>/dev/null </dev/null
}

candidates() {
    for name in python3.13 python3.12 python3.14 python3.11 python3 python; do
        command -v "$name" || true
    done
    ls -d \
        "${PYENV_ROOT:-$HOME/.pyenv}"/versions/*/bin/python3 \
        "${UV_PYTHON_INSTALL_DIR:-${XDG_DATA_HOME:-$HOME/.local/share}/uv/python}"/*/bin/python3 \
        /opt/homebrew/bin/python3.1[1-9] /usr/local/bin/python3.1[1-9] /usr/bin/python3.1[1-9] 2>/dev/null || true
}

# Prints "RANK MINOR PATH" of every Python that will do, best first: the newest that the constraints know, then newer
# ones, then those that only slow JAX releases are made for.
ranked() {
    candidates | while IFS= read -r path; do
        minor=$(minor_of "$path") || continue
        [ "$minor" -ge $oldest ] || continue
        if [ "$minor" -gt $newest ]; then rank=$((100 - minor)); else rank=$((minor * 10)); fi
        if [ "$minor" -lt $fast ]; then rank=0; fi
        printf '%s %s %s\n' "$rank" "$minor" "$path"
    done | sort -s -k1,1nr
}

works() { command -v "$1" >/dev/null 2>&1 && "$1" --version >/dev/null 2>&1; }

# Makes the environment, with pip in it, also where Debian has taken ensurepip out of Python.
make_venv() {
    "$python" -m venv "$venv" >/dev/null 2>&1 && return
    rm -rf "$venv"
    say "this Python cannot bring pip along (no ensurepip): trying other ways"
    if works uv; then
        uv venv --quiet --seed --python "$python" "$venv" && return
        rm -rf "$venv"
    fi
    if works virtualenv; then
        virtualenv --quiet --python "$python" "$venv" && return
        rm -rf "$venv"
    fi
    "$python" -m venv --without-pip "$venv" || return
    candidates | while IFS= read -r other; do # any pip of this machine can install into another environment
        if "$other" -m pip --python "$venv/bin/python" install --quiet pip >/dev/null 2>&1 </dev/null; then break; fi
    done
    "$venv/bin/python" -m pip --version >/dev/null 2>&1 && return
    get='import urllib.request as u; print(u.urlopen("https://bootstrap.pypa.io/get-pip.py").read().decode())'
    "$venv/bin/python" -c "$get" 2>/dev/null | "$venv/bin/python" - --quiet
    "$venv/bin/python" -m pip --version >/dev/null 2>&1
}

case $wanted in
'') best=$(ranked | head -n 1) ;;
3.[0-9]*) best=$(ranked | awk -v minor="${wanted#3.}" '$2 == minor' | head -n 1) ;;
*)
    path=$(command -v "$wanted") || die 3 "there is no $wanted here"
    minor=$(minor_of "$path") || die 3 "$path does not run, or is not a 64-bit CPython 3"
    [ "$minor" -ge $oldest ] || die 3 "$path is Python 3.$minor; udkjax needs 3.$oldest or newer"
    best="0 $minor $path"
    ;;
esac

[ -n "$best" ] || [ -z "$wanted" ] || die 3 "found no Python $wanted in PATH, pyenv or uv that runs and will do"
reuse=''
if [ -e "$venv" ]; then
    minor=$(minor_of "$venv/bin/python") || minor=0
    if [ "$minor" -ge $oldest ] && "$venv/bin/python" -m pip --version >/dev/null 2>&1; then
        rest=${best#* }
        if [ -z "$wanted" ] || [ "$minor" = "${rest%% *}" ]; then reuse=yes; fi
    fi
    if [ -z "$reuse" ]; then
        [ -f "$venv/pyvenv.cfg" ] || die 1 "$venv is there but is no virtual environment; move it away, or give --venv"
        say "$venv is broken or has another Python: making it anew"
        rm -rf "$venv"
    fi
fi

if [ -n "$reuse" ]; then
    say "using the environment in $venv: $("$venv/bin/python" --version)"
else
    [ -n "$best" ] || die 3 "found no Python 3.$oldest or newer in PATH, pyenv or uv that runs; install one, or name it with --python"
    rest=${best#* } minor=${rest%% *} python=${rest#* }
    say "Python 3.$minor: $python"
    make_venv || die 1 "could not make an environment with pip in $venv; on Debian: apt install python3.$minor-venv"
fi
if [ "$minor" -gt $newest ]; then
    say "Python 3.$minor is newer than what the versions in constraints.txt were tested with"
fi

target=".[$extras]"
say "installing udkjax and what it needs into $venv"
if ! { works uv && uv pip install --quiet --python "$venv/bin/python" -c constraints.txt -e "$target" 2>/dev/null; }; then
    "$venv/bin/python" -m pip --disable-pip-version-check install --quiet -c constraints.txt -e "$target" ||
        die 1 "pip could not install; the reason stands above"
fi
# The first run, with bytecode of all that it imports: uv writes none, and where PYTHONDONTWRITEBYTECODE is set nobody would.
first='import numpy, udkjax.cli; udkjax.simulate(udkjax.library.parallelogram(), numpy.linspace(0.0, 1.0, 11))'
env -u PYTHONDONTWRITEBYTECODE "$venv/bin/python" -c "$first" || die 1 "installed, but a first run fails; the reason stands above"
"$venv/bin/udkjax" --help >/dev/null || die 1 "installed, but the command does not run"
say "ready: $venv/bin/udkjax --help"
