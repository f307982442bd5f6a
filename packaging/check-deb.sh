#!/usr/bin/env bash
# Unpacks a package into a folder of its own and looks at what a user would get: programs that run and name their commit,
# at most 20 MB each, completions and manual pages of every command, a unit that systemd accepts.
# usage: packaging/check-deb.sh target/debian/cellpos_*.deb
set -euo pipefail
deb=$1
root=$(mktemp -d)
trap 'rm -rf "$root"' EXIT
dpkg-deb --extract "$deb" "$root"
dpkg-deb --info "$deb" | grep -q 'Package: cellpos'
fail() { echo "check-deb: $1" >&2; exit 1; }
for program in cellpos firmware-sim; do
    file="$root/usr/bin/$program"
    [ -x "$file" ] || fail "$program is not there"
    size=$(stat -c %s "$file")
    [ "$size" -le 20971520 ] || fail "$program has $size bytes, more than 20 MB"
    echo "$program: $size bytes"
done
"$root/usr/bin/cellpos" --version | grep -Eq '^cellpos [0-9.]+ \(.+\)$' || fail "--version names no commit"
for command in $("$root/usr/bin/cellpos" --help | sed -n '/^Commands:/,/^$/p' | awk 'NR > 1 && NF { print $1 }'); do
    [ "$command" = help ] || [ -f "$root/usr/share/man/man1/cellpos-$command.1.gz" ] || fail "no manual page of $command"
done
for file in \
    usr/share/bash-completion/completions/cellpos usr/share/zsh/vendor-completions/_cellpos \
    usr/share/fish/vendor_completions.d/cellpos.fish usr/share/man/man1/cellpos.1.gz \
    lib/udev/rules.d/60-cellpos.rules etc/security/limits.d/cellpos.conf lib/systemd/system/cellpos-run@.service \
    usr/share/doc/cellpos/examples/rig.toml usr/share/doc/cellpos/CHANGELOG.md; do
    [ -f "$root/$file" ] || fail "$file is not there"
done
if command -v systemd-analyze >/dev/null; then
    sed "s#/usr/bin/cellpos#$root/usr/bin/cellpos#" "$root/lib/systemd/system/cellpos-run@.service" > "$root/cellpos-run@night.service"
    systemd-analyze verify "$root/cellpos-run@night.service" 2>&1 | grep -i 'cellpos-run' && fail "systemd does not accept the unit"
fi
cd "$root"
"$root/usr/bin/cellpos" track --target 0um --duration 1s --clock virtual --frames off --name package >/dev/null
"$root/usr/bin/cellpos" report latest >/dev/null
echo "check-deb: as it should be"
