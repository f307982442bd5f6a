#!/usr/bin/env bash
# The firmware for a Cortex-M4F: installs what it takes from Debian, builds, reports its size, checks what is linked, and
# closes the loop through it on QEMU. Nothing is installed where it is there already.
#
#   scripts/firmware-qemu.sh          all of it
#   scripts/firmware-qemu.sh build    the firmware only
set -euo pipefail
cd "$(dirname "$0")/.."

need=()
for package in rustc-web cargo-web rust-web-src qemu-system-arm lld binutils; do
  dpkg-query -W -f '${Status}' "$package" 2>/dev/null | grep -q 'ok installed' || need+=("$package")
done
if [ ${#need[@]} -gt 0 ]; then
  [ "$(id -u)" = 0 ] || { echo "as root: apt-get install ${need[*]}" >&2; exit 2; }
  apt-get update -q && apt-get install -y -q --no-install-recommends "${need[@]}"
fi
# Compiler, cargo and the library's source must be one release: -Zbuild-std compiles the one with the other.
versions=$(dpkg-query -W -f '${Version}\n' rustc-web cargo-web rust-web-src | sort -u)
[ "$(wc -l <<<"$versions")" = 1 ] || { echo "rustc-web, cargo-web and rust-web-src differ:" $versions >&2; exit 2; }

# Debian's own tools, whatever else is installed. Nightly features only for -Zbuild-std.
export CARGO_TARGET_DIR="$PWD/target/firmware"
(
  cd firmware/mps2-an386
  PATH="/usr/bin:$PATH" RUSTC=/usr/bin/rustc RUSTC_BOOTSTRAP=1 \
    RUSTFLAGS="-C linker-flavor=ld.lld -C linker=/usr/bin/ld.lld -C link-arg=-Tmemory.x -C link-arg=--gc-sections" \
    /usr/bin/cargo build --release --locked --target thumbv7em-none-eabihf -Zbuild-std=core
)
firmware="$CARGO_TARGET_DIR/thumbv7em-none-eabihf/release/cellpos-firmware-mps2-an386"
unset CARGO_TARGET_DIR

section() { readelf -SW "$firmware" | awk -v name="$1" '{ sub(/^ *\[ *[0-9]+\]/, "") } $1 == name { print $5 }'; }
code=0
for name in .vectors .text .rodata .data; do size=$(section $name); code=$((code + 16#${size:-0})); done
data=$(section .data) bss=$(section .bss)
ram=$((16#${data:-0} + 16#${bss:-0}))
echo "firmware: $code bytes of code and constants (at most 65536), $ram bytes of static RAM; stack and static RAM together 8192 bytes"
[ "$code" -le 65536 ]
# A panic path would not have linked (see src/main.rs); f64 on this core is calls to these.
if readelf -sW "$firmware" | grep -E 'panic|__aeabi_[di]2?d|__aeabi_d(add|sub|mul|div|cmp)|(add|sub|mul|div)df3'; then
  echo "firmware: a panic path or double precision is linked" >&2; exit 1
fi
echo "firmware: no panic path, no double precision"
[ "${1:-all}" = build ] && exit 0

cargo build --workspace --bins --locked
CELLPOS_FIRMWARE="$firmware" cargo test -p cellpos-tests --locked --test firmware_qemu -- --ignored --nocapture --test-threads 1
