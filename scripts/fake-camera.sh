#!/usr/bin/env bash
# Installs Debian's Aravis (libraries and the fake GigE Vision camera) and runs the tests of industrial cameras against
# it on loopback. Asks for root only to install what is missing.
#   scripts/fake-camera.sh           run the tests
#   scripts/fake-camera.sh install   install only
#   scripts/fake-camera.sh build     build the tests, too
#   scripts/fake-camera.sh shared    run those that may share the machine
#   scripts/fake-camera.sh alone     run the others, which track a bead or judge times
#   scripts/fake-camera.sh serve     serve the fake camera on 127.0.0.1 until interrupted, to try cellpos camera
set -euo pipefail
cd "$(dirname "$0")/.."

packages=(libaravis-dev libusb-1.0-0-dev aravis-tools)
missing=()
for p in "${packages[@]}"; do
    dpkg-query -W -f='${Status}' "$p" 2>/dev/null | grep -q 'ok installed' || missing+=("$p")
done
if ((${#missing[@]})); then
    as_root=()
    [[ $EUID -eq 0 ]] || as_root=(sudo)
    "${as_root[@]}" apt-get update
    "${as_root[@]}" apt-get install -y --no-install-recommends "${missing[@]}"
fi

[[ ${1:-} == install ]] && exit 0
if [[ ${1:-} == serve ]]; then
    echo "fake camera on 127.0.0.1; in another terminal: cargo run --release --features aravis -- camera --address 127.0.0.1 --region 64x64+0+0"
    exec arv-fake-gv-camera-0.8 -i 127.0.0.1
fi
# The fake camera sleeps for 100 ms whenever it is a millisecond late: real-time priority keeps it from being late.
fifo=()
if chrt -f 20 true 2>/dev/null; then fifo=(chrt -f 20); else echo "no real-time priority: expect stalls of 100 ms"; fi
# The whole workspace, whose features its tests have built: one package alone may have others, and is built anew.
build=(--locked --workspace --features cellpos-drivers/aravis --test fake_camera)
cargo test "${build[@]}" --no-run
timed=a_bead_drawn_into_the_stream
case ${1:-} in
    build) exit 0 ;;
    shared) which=(--skip "$timed") ;;
    alone) which=("$timed") ;;
    *) which=() ;;
esac
"${fifo[@]}" cargo test "${build[@]}" -- --ignored --nocapture --test-threads 1 "${which[@]}"
