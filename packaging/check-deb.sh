#!/usr/bin/env bash
# Unpacks a package into a separate folder and checks its content: programs that run and name their commit, at most 20 MB each;
# completions and manual pages of every command; a unit that systemd accepts. As root it also installs and removes it in a copy of
# this system (an overlay that is discarded): dpkg, its scripts, group and user.
# usage: packaging/check-deb.sh target/debian/cellpos_*.deb
set -euo pipefail
deb=$1
root=$(mktemp -d)
copy=$(mktemp -d)
trap 'rm -rf "$root"; rmdir "$copy"' EXIT
dpkg-deb --extract "$deb" "$root"
# (What is read whole before it is looked at does not end by a closed pipe.)
grep -q 'Package: cellpos' <<< "$(dpkg-deb --info "$deb")"
fail() { echo "check-deb: $1" >&2; exit 1; }
for program in cellpos firmware-sim; do
    file="$root/usr/bin/$program"
    [ -x "$file" ] || fail "$program is not there"
    size=$(stat -c %s "$file")
    [ "$size" -le 20000000 ] || fail "$program has $size bytes, more than 20 MB"
    echo "$program: $size bytes"
done
grep -Eq '^cellpos [0-9.]+ \(.+\)$' <<< "$("$root/usr/bin/cellpos" --version)" || fail "--version names no commit"
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
    # (It opens the manual page that the unit names, too.)
    said=$(MANPATH="$root/usr/share/man" systemd-analyze verify "$root/cellpos-run@night.service" 2>&1) || true
    ! grep -i 'cellpos-run' <<< "$said" || fail "systemd does not accept the unit"
fi
# The script for the copy, run by a shell with its own mounts.
installed() {
    set -euo pipefail
    copy=$1 deb=$2
    mount -t tmpfs tmpfs "$copy"
    mkdir "$copy/upper" "$copy/work" "$copy/root"
    mount -t overlay overlay -o "lowerdir=/,upperdir=$copy/upper,workdir=$copy/work" "$copy/root"
    mount --bind /proc "$copy/root/proc"
    mount --bind /dev "$copy/root/dev"
    mount -t tmpfs tmpfs "$copy/root/tmp"
    cp "$deb" "$copy/root/tmp/cellpos.deb"
    inside() { chroot "$copy/root" env -i PATH=/usr/sbin:/usr/bin:/sbin:/bin HOME=/root "$@"; }
    inside dpkg --install /tmp/cellpos.deb >/dev/null
    grep -q '^Status: install ok installed' <<< "$(inside dpkg --status cellpos)"
    inside cellpos --version
    inside getent group realtime >/dev/null
    grep -q realtime <<< "$(inside id cellpos)"
    inside sh -c 'cd /tmp && cellpos track --target 0um --duration 1s --clock virtual --frames off && cellpos report latest' >/dev/null
    inside dpkg --install /tmp/cellpos.deb >/dev/null
    inside dpkg --purge cellpos >/dev/null
    inside sh -c '! command -v cellpos && [ ! -e /etc/security/limits.d/cellpos.conf ]'
}
if [ "$(id -u)" != 0 ] || ! unshare -m true 2>/dev/null; then
    echo "not installed: that needs root"
elif unshare -m bash -c "$(declare -f installed); installed \"\$1\" \"\$2\"" bash "$copy" "$(realpath "$deb")"; then
    echo "installed, installed again, purged"
else
    fail "dpkg does not install it and purge it as it should"
fi
cd "$root"
"$root/usr/bin/cellpos" track --target 0um --duration 1s --clock virtual --frames off --name package >/dev/null
"$root/usr/bin/cellpos" report latest >/dev/null
echo "check-deb: as it should be"
