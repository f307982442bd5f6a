#!/usr/bin/env bash
# The Python package: installed into a separate environment as a user would, then its tests, with the snippets of docs/python.md.
# Skipped with the reason where the environment cannot be made.
#   scripts/check-python.sh [WORDS]          all of it; the words are for pytest
#   scripts/check-python.sh source [WORDS]   not installed: the package from its sources, with the program of the workspace's tests,
#                                            or the one that CELLPOS_PROGRAM names. The package's own has fewer features, and is
#                                            built for minutes
#   scripts/check-python.sh install          the environment only
set -euo pipefail
cd "$(dirname "$0")/.."
env=target/python
if ! { [ -x "$env/bin/python" ] || python3 -m venv "$env"; } \
    || ! "$env/bin/pip" install -q --no-compile --disable-pip-version-check "maturin>=1.7,<2" numpy pandas matplotlib pytest pytest-xdist mypy pypylon imageio pyserial; then
    echo "check-python: skipped: maturin, numpy, pandas, matplotlib, pytest, pytest-xdist, mypy, pypylon, imageio and pyserial cannot be installed here"
    exit 0
fi
[ "${1:-}" = install ] && exit 0
# The programs come with the tests of the workspace. Alone they have fewer features, and half of it is built again.
[ -n "${CELLPOS_PROGRAM:-}" ] || cargo test -q --locked --workspace --no-run
if [ "${1:-}" = source ]; then
    shift
    "$env/bin/pip" uninstall -q -y cellpos
    export CELLPOS_PROGRAM="${CELLPOS_PROGRAM:-$PWD/target/debug/cellpos}" PYTHONPATH="$PWD/python/src"
    export PATH="${CELLPOS_PROGRAM%/*}:$PATH"
else
    unset CELLPOS_PROGRAM
    CARGO_TARGET_DIR="$PWD/target" MATURIN_PEP517_ARGS="--profile dev" PATH="$PWD/$env/bin:$PATH" \
        "$env/bin/pip" install -q --disable-pip-version-check --no-build-isolation --no-deps --force-reinstall ./python
fi
cd python
tests() {
    "../$env/bin/python" -m pytest -q "$@"
}
if [ $# -gt 0 ]; then
    tests "$@"
    exit
fi
# Three at once: most tests wait for rigs in real time. Those that hold a bead through a camera of 1000 frames/s have the machine to themselves.
tests -n 3 --dist loadfile -m "not alone"
tests -m alone
