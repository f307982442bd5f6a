#!/usr/bin/env bash
# Exports read by other programs, in a separate environment; skipped with the reason if that cannot be installed.
# usage: scripts/check-readers.sh target/debug/cellpos [CYCLES]; 20000 cycles are a run of a million ticks
#        scripts/check-readers.sh install, for the environment only
set -euo pipefail
program=$(realpath "$1")
cd "$(dirname "$0")/.."
readers=target/readers
if ! { [ -x "$readers/bin/python" ] || python3 -m venv "$readers"; } \
    || ! "$readers/bin/pip" install -q --no-compile --disable-pip-version-check pandas pyarrow polars h5py scipy dclab jsonschema; then
    echo "check-readers: skipped: the readers (pandas, pyarrow, polars, h5py, scipy, dclab, jsonschema) cannot be installed here"
    exit 0
fi
[ "$1" = install ] && exit 0
"$readers/bin/python" scripts/check_readers.py "$program" "${@:2}"
