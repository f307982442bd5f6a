#!/usr/bin/env bash
# A loop of any period over a pseudo-terminal and a socket, in real time (firmware-sim in a separate process, rendered frames).
# Before and after it, the bare sleep loop at the same period.
#
#     cargo build --release -p cellpos -p cellpos-firmware-sim -p cellpos-benches --bin cellpos --bin firmware-sim --bin minute-table
#     scripts/minute-over-the-wire.sh              # 500 us, 60 s, lqg
#     scripts/minute-over-the-wire.sh 1000 10 pi   # period in us, seconds, controller
#
# Real-time rights as for every run (docs/real-time.md). The programs are looked for in target/release, or in $CELLPOS_BIN.
set -euo pipefail
period_us=${1:-500} seconds=${2:-60} controller=${3:-lqg}
bin=$(cd "${CELLPOS_BIN:-$(dirname "$0")/../target/release}" && pwd)
folder=$(mktemp -d)
box=
cleanup() {
    [ -z "$box" ] || { kill "$box" 2>/dev/null || true; wait "$box" 2>/dev/null || true; }
    rm -rf "$folder"
}
trap cleanup EXIT
part() { awk -v us="$period_us" -v x="$1" 'BEGIN { printf "%.4f", us * x }'; }
rate_hz=$(awk -v us="$period_us" 'BEGIN { printf "%.3f", 1e6 / us }')
cat > "$folder/rig.toml" <<EOF
[actuator]
kind = "serial"
port = "pzt"
[camera]
kind = "socket"
socket = "camera.sock"
rate_hz = $rate_hz
[vision]
window_px = 21
[vision.profile]
kind = "ring"
edge_px = 5.0
[calibration]
pixel_um = 0.1
origin_px = 127.5
sign = 1.0
[timing]
period_us = $period_us
budget_us = $(part 0.5)
solver_us = $(part 0.17)
faults_in_a_row = $(awk -v us="$period_us" 'BEGIN { printf "%d", 5000 / us }')
coast_ticks = $(awk -v us="$period_us" 'BEGIN { printf "%d", 20000 / us }')
lost_ticks = $(awk -v us="$period_us" 'BEGIN { printf "%d", 1000000 / us }')
[emulator]
rate_hz = $rate_hz
exposure_ms = $(part 0.0005)
EOF
bare() { "$bin/minute-table" "$((seconds / 2 > 0 ? seconds / 2 : 1))" --bare "${period_us}us"; }
echo "bare loop before:"
bare
cd "$folder"
"$bin/firmware-sim" --rig rig.toml --pty-link pzt --socket camera.sock > box.log 2>&1 &
box=$!
for _ in $(seq 100); do
    [ -S camera.sock ] && [ -e pzt ] && break
    sleep 0.05
done
"$bin/cellpos" track --target 0um --rig rig.toml --controller "$controller" --duration "${seconds}s" || cat box.log
echo "bare loop after:"
bare
