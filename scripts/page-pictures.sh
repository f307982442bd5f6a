#!/usr/bin/env bash
# Pictures of the live page, to be looked at: 400, 1400 and 2560 px wide in light, dark and red, and the last word of runs that end,
# are parked, go safe or are killed.
#   scripts/page-pictures.sh [FOLDER]        default: target/page-pictures
# Needs Debian's chromium and chromium-driver.
set -euo pipefail
cd "$(dirname "$0")/.."
to=${1:-target/page-pictures}
# The tests find the programs beside themselves.
cargo build --locked -p cellpos --bins
cargo build --locked -p cellpos-firmware-sim --bins
cargo test --locked -p cellpos-tests --test all live_page::last_word:: -- --ignored --test-threads 1
mkdir -p "$to"
cp target/debug/live-page/{screen,word}-*.png "$to/"
ls "$to"
