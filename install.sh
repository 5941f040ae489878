#!/bin/sh
# Puts udkjax, with all that it can use but Jupyter, into a virtual environment of its own. Safe to repeat.
#   sh install.sh [--notebook] [--test] [--dev] [--docs] [--python VERSION | NAME | PATH] [--venv FOLDER]
# By default it takes the newest Python of this machine and makes .venv. uv is used where there is one, and not needed.
# Exit status: 0 installed, 1 failed, 2 wrong usage, 3 no suitable Python.
set -eu
cd "$(dirname "$0")"
die() { printf 'udkjax: %s\n' "$2" >&2 && exit "$1"; }
extras=all venv=.venv wanted=''
while [ $# -gt 0 ]; do
    case $1 in
    --notebook | --test | --dev | --docs) extras=$extras,${1#--} ;;
    --python | --venv)
        [ $# -ge 2 ] || die 2 "$1 needs a value"
        if [ "$1" = --python ]; then wanted=$2; else venv=$2; fi
        shift
        ;;
    *) sed -n '2,5s/^# *//p' "$0" && exit 2 ;;
    esac
    shift
done
# It must run (pyenv has names of versions that are not active), and have wheels: 64-bit CPython from 3.11 on, with its global lock.
check='import sys as s, sysconfig as c; ok = s.version_info >= (3, 11) and s.implementation.name == "cpython" and s.maxsize > 2**32
s.exit(not ok or bool(c.get_config_var("Py_GIL_DISABLED")) or s.argv[1][:2] == "3." and s.argv[1] != "%d.%d" % s.version_info[:2])'
suits() { "$1" -c "$check" "${2:-any}" 2>/dev/null </dev/null; }
has_uv() { uv --version >/dev/null 2>&1; }

if [ -e "$venv" ] && [ ! -f "$venv/pyvenv.cfg" ]; then die 1 "$venv is there, but is no virtual environment: move it away, or give --venv"; fi
case $wanted in '' | 3.*) suits "$venv/bin/python" "$wanted" && "$venv/bin/python" -m pip --version >/dev/null 2>&1 ;; *) false ;; esac || {
    case $wanted in # constraints.txt was tested up to 3.13; for 3.11 there is an older JAX only
    '' | 3.*)
        for version in ${wanted:-3.13 3.12 3.14 3.11}; do
            for name in "python$version" "${PYENV_ROOT:-$HOME/.pyenv}/versions/$version".*/bin/python3 python3; do
                suits "$name" "$version" && break 2
            done
        done || name=''
        ;;
    *) suits "$wanted" && name=$wanted || name='' ;;
    esac
    if [ -z "$name" ]; then # uv finds others, or brings one
        has_uv && uv venv --quiet --seed --clear --python "${wanted:-3.13}" "$venv" ||
            die 3 "found no Python ${wanted:-from 3.11 on} that runs and is a 64-bit CPython; install one, or name it with --python"
    elif ! "$name" -m venv --clear "$venv" >/dev/null 2>&1; then # Debian parts pip from Python: any other pip can bring it
        get='import urllib.request as u; exec(u.urlopen("https://bootstrap.pypa.io/get-pip.py").read())'
        "$name" -m venv --clear --without-pip "$venv" && python=$venv/bin/python && { "$name" -m pip --python "$python" install --quiet pip ||
            uv pip install --quiet --python "$python" pip || "$python" -c "$get" --quiet; } 2>/dev/null ||
            die 1 "there is no pip for $name; on Debian: apt install python3-venv"
    fi
}
printf 'udkjax: %s, with what it needs, goes into %s\n' "$("$venv/bin/python" --version)" "$venv"
{ has_uv && uv pip install --quiet --python "$venv/bin/python" -c constraints.txt -e ".[$extras]" 2>/dev/null; } ||
    "$venv/bin/python" -m pip --disable-pip-version-check install --quiet -c constraints.txt -e ".[$extras]"
# A first run, which leaves bytecode of all that it imports: uv writes none, and where PYTHONDONTWRITEBYTECODE is set nobody would.
env -u PYTHONDONTWRITEBYTECODE "$venv/bin/python" -c 'import numpy, udkjax.cli
udkjax.simulate(udkjax.library.parallelogram(), numpy.linspace(0.0, 1.0, 11))'
"$venv/bin/udkjax" --help >/dev/null
printf 'udkjax: ready: %s --help\n' "$venv/bin/udkjax"
