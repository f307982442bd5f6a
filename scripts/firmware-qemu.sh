#!/usr/bin/env bash
# The firmware for a Cortex-M4F: installs the tools from Debian, builds, reports the size, checks the linked symbols, and closes
# the loop on QEMU. The same for the RP2350 up to its size: no QEMU runs that. Tools that exist are not installed again.
#
#   scripts/firmware-qemu.sh          all of it
#   scripts/firmware-qemu.sh build    the firmware for QEMU only
#   scripts/firmware-qemu.sh loop     all but the firmware for the RP2350
#   scripts/firmware-qemu.sh rp2350   the firmware for the RP2350 only
#   scripts/firmware-qemu.sh install  the tools only
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
[ "${1:-all}" = install ] && exit 0
# Compiler, cargo and the library's source must be one release: -Zbuild-std compiles the one with the other.
versions=$(dpkg-query -W -f '${Version}\n' rustc-web cargo-web rust-web-src | sort -u)
[ "$(wc -l <<<"$versions")" = 1 ] || { echo "rustc-web, cargo-web and rust-web-src differ:" $versions >&2; exit 2; }

# Debian's own tools, whatever else is installed. Nightly features only for -Zbuild-std.
target="$PWD/target/firmware"
build() { # folder, triple, linker script and further arguments of the linker
  local folder=$1 triple=$2 flags="-C linker-flavor=ld.lld -C linker=/usr/bin/ld.lld -C link-arg=--gc-sections"
  shift 2
  for argument in "$@"; do flags="$flags -C link-arg=$argument"; done
  (
    cd "firmware/$folder"
    # The flags are for the linker alone: they go to the program, and its dependencies are built once for all.
    PATH="/usr/bin:$PATH" RUSTC=/usr/bin/rustc RUSTC_BOOTSTRAP=1 RUSTFLAGS="" CARGO_TARGET_DIR="$target" \
      /usr/bin/cargo rustc --release --locked --target "$triple" -Zbuild-std=core -- $flags
  )
}
section() { readelf -SW "$1" | awk -v name="$2" '{ sub(/^ *\[ *[0-9]+\]/, "") } $1 == name { print $5 }'; }
sum() { # file, sections: bytes of them together
  local file=$1 bytes=0 size
  shift
  for name in "$@"; do size=$(section "$file" "$name"); bytes=$((bytes + 16#${size:-0})); done
  echo "$bytes"
}

rp2350() {
  build rp2350 thumbv8m.main-none-eabihf -Tlink.x --nmagic
  local elf="$target/thumbv8m.main-none-eabihf/release/cellpos-firmware-rp2350"
  echo "firmware rp2350: $(sum "$elf" .vector_table .start_block .text .rodata .data) bytes of code and constants," \
    "$(sum "$elf" .data .bss .uninit) bytes of static RAM"
  # The boot ROM starts nothing without this block within the first 4 kB.
  [ "$(sum "$elf" .start_block)" -gt 0 ]
}
[ "${1:-all}" = rp2350 ] && { rp2350; exit 0; }

build mps2-an386 thumbv7em-none-eabihf -Tmemory.x
firmware="$target/thumbv7em-none-eabihf/release/cellpos-firmware-mps2-an386"
code=$(sum "$firmware" .vectors .text .rodata .data)
ram=$(sum "$firmware" .data .bss)
echo "firmware mps2-an386: $code bytes of code and constants (at most 65536), $ram bytes of static RAM (at most 8192, which" \
  "memory.x gives to stack and data together)"
[ "$code" -le 65536 ] && [ "$ram" -le 8192 ] || { echo "firmware: too large" >&2; exit 1; }
# A panic path would not have linked (see src/main.rs). On this core f64 means calls to these functions. There is no allocator
# either. A file without symbols would also show none, so the board's own symbols must be present.
symbols=$(readelf -sW "$firmware")
grep -q 'FUNC.*cellpos_board' <<<"$symbols" || { echo "firmware: no symbols to judge by" >&2; exit 1; }
if grep -E 'panic|__aeabi_(c?d|u?[il]2d|f2d)|__[a-z]*df|__rust_alloc|__rdl_alloc' <<<"$symbols"; then
  echo "firmware: a panic path, double precision or an allocator is linked" >&2; exit 1
fi
echo "firmware mps2-an386: no panic path, no double precision, no allocator"
[ "${1:-all}" = build ] && exit 0

[ "${1:-all}" = loop ] || rp2350
# The programs come with the tests. Alone they have fewer features, and half of the workspace is built again.
cargo test --workspace --locked --no-run
CELLPOS_FIRMWARE="$firmware" cargo test --workspace --locked --test all firmware_qemu:: -- --ignored --nocapture --test-threads 1
