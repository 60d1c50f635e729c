# Sourced by the scripts: goes to the project's root, finds a Python that is new enough, and makes the environment.
# shellcheck shell=sh

here=$PWD
root=$(CDPATH='' cd -- "$(dirname -- "$0")/.." && pwd) || exit 1
cd "$root" || exit 1

# Without .pyc files each of the thousands of processes that the tests start compiles Pancakes again.
unset PYTHONDONTWRITEBYTECODE

# Prints a Python that is new enough; tries $PYTHON first if it is set.
find_python() {
    for name in "${PYTHON:-}" python3.14 python3.13 python3.12 python3.11 python3 python; do
        if [ -n "$name" ] && "$name" -c 'import sys; sys.exit(sys.version_info < (3, 11))' </dev/null >/dev/null 2>&1; then
            printf '%s\n' "$name"
            return 0
        fi
    done
    echo "Pancakes needs Python 3.11 or newer, but none was found: install python3.11, or set PYTHON to one." >&2
    return 1
}

# Makes .venv with the named extras, unless it is up to date, and sets $python to its Python.
use_environment() {
    found=$(find_python) || exit 1
    python=$("$found" scripts/lib/environment.py "$@" </dev/null) || exit 1
}
