#!/usr/bin/env bash
# Builds the Debian package: program, firmware-sim, completions, manual pages, rules. Needs cargo-deb
# (cargo install cargo-deb). The file is named on the last line.
set -euo pipefail
cd "$(dirname "$0")/.."
cargo build --profile dist --locked -p cellpos-firmware-sim
# Functions that came out the same, of generic code above all, are linked once: what rustc links with on this architecture can do it.
fold=()
[ "$(uname -m)" != x86_64 ] || fold=(-C link-arg=-Wl,--icf=all)
cargo rustc --profile dist --locked -p cellpos --bin cellpos -- "${fold[@]}"
made=target/packaging
rm -rf "$made"
target/dist/cellpos generate --out "$made"
gzip -9n "$made"/man/*.1
cargo deb --no-build --no-strip --profile dist -p cellpos
