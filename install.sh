#!/bin/sh
# Puts udkjax, with all that it can use but Jupyter, into a virtual environment of its own. Safe to repeat.
#   sh install.sh [--notebook] [--test] [--browser] [--fmi] [--dev] [--docs] [--python VERSION | NAME | PATH] [--venv FOLDER]
# By default it takes the newest Python of this machine and makes .venv. uv is used where there is one, and not needed.
# Exit status: 0 installed, 1 failed, 2 wrong usage, 3 no suitable Python.
set -eu
cd "$(dirname "$0")"
die() { printf 'udkjax: %s\n' "$2" >&2 && exit "$1"; }
extras=all venv=.venv wanted='' other=python3
while [ $# -gt 0 ]; do
    case $1=${2-} in
    --notebook=* | --test=* | --browser=* | --fmi=* | --dev=* | --docs=*) extras=$extras,${1#--} ;;
    --python=3.*) wanted=$2 && shift ;;
    --python=?*) wanted=$2 other=$2 && shift ;;
    --venv=?*) venv=$2 && shift ;;
    *) sed -n '2,5s/^# *//p' "$0" && exit 2 ;;
    esac
    shift
done
[ ! -e "$venv" ] || [ -f "$venv/pyvenv.cfg" ] || die 1 "$venv is there, but is no virtual environment: move it away, or give --venv"

# A Python must run (pyenv has names of versions that are not active), and have wheels: 64-bit CPython from 3.11 on, with its global lock.
check='import sys as s, sysconfig as c; ok = s.version_info >= (3, 11) and s.implementation.name == "cpython" and s.maxsize > 2**32
s.exit(not ok or bool(c.get_config_var("Py_GIL_DISABLED")) or s.argv[1][:2] == "3." and s.argv[1] != "%d.%d" % s.version_info[:2])'
suits() { "$1" -c "$check" "${2:-any}" 2>/dev/null </dev/null; }
found() { # constraints.txt was tested up to 3.13; for 3.11 there is an older JAX only
    for version in ${wanted:-3.13 3.12 3.14 3.11}; do
        for name in "python$version" "${PYENV_ROOT:-${HOME:-}/.pyenv}/versions/$version".*/bin/python3 "$other"; do
            suits "$name" "$version" && return
        done
    done && return 1
}
new_uv() { uv venv --quiet --seed --clear --python "${wanted:-3.13}" "$venv" 2>/dev/null; } # it finds other Pythons, or brings one
new() { # Debian parts pip from Python: uv and `pip --python` bring it
    "$name" -m venv --clear "$venv" || { "$name" -m venv --clear --without-pip "$venv" && {
        "$name" -m pip --python "$venv/bin/python" install --quiet pip || uv pip install --quiet --python "$venv/bin/python" pip; }; }
} >/dev/null 2>&1
if [ "$other" != python3 ] || ! suits "$venv/bin/python" "$wanted" || ! "$venv/bin/python" -m pip --version >/dev/null 2>&1; then
    if found; then
        new || die 1 "there is no pip for $name; on Debian: apt install python3-venv"
    else
        new_uv || die 3 "found no Python ${wanted:-from 3.11 on} that runs and is a 64-bit CPython; install one, or name it with --python"
    fi
fi
printf 'udkjax: %s, with what it needs, goes into %s\n' "$("$venv/bin/python" --version)" "$venv"
uv pip install --quiet --python "$venv/bin/python" -c constraints.txt -e ".[$extras]" 2>/dev/null ||
    "$venv/bin/python" -m pip --disable-pip-version-check install --quiet --no-compile -c constraints.txt -e ".[$extras]"
# A first run, which leaves bytecode of all that it imports. Neither uv nor pip is to write any, which takes pip two thirds of its
# time, of many modules that nobody imports; and where PYTHONDONTWRITEBYTECODE is set Python would not, either.
env -u PYTHONDONTWRITEBYTECODE "$venv/bin/python" -c 'import numpy, udkjax.cli
udkjax.simulate(udkjax.library.parallelogram(), numpy.linspace(0.0, 1.0, 11))'
"$venv/bin/udkjax" --help >/dev/null
printf 'udkjax: ready: %s --help\n' "$venv/bin/udkjax"
