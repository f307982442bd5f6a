#!/usr/bin/env bash
# Builds the parts of a release, checks each in a bare folder, and writes the SHA-256 sums.
# usage: scripts/release.sh [FOLDER]      archive, Debian package and Python wheel; FOLDER is target/release-files if left out
# Needs cargo-deb (cargo install cargo-deb) and Python 3 with venv. The version is that of Cargo.toml; all other files must agree with it.
set -euo pipefail
cd "$(dirname "$0")/.."
out=${1:-target/release-files}
version=$(sed -n 's/^version = "\(.*\)"/\1/p' Cargo.toml | head -1)
fail() { echo "release: $1" >&2; exit 1; }
for file in CITATION.cff python/pyproject.toml python/src/cellpos/__init__.py; do
    grep -Eq "version(__)?[\" ]*[:=] *\"?$version" "$file" || fail "$file has another version than Cargo.toml ($version)"
done
grep -q "^## $version\b" CHANGELOG.md || fail "CHANGELOG.md has no section $version: scripts/changelog.sh $version"
rm -rf "$out" && mkdir -p "$out" && out=$(cd "$out" && pwd)

packaging/build-deb.sh | tee target/release-deb.log
deb=$(tail -1 target/release-deb.log)
packaging/check-deb.sh "$deb"
cp "$deb" "$out/"

name=cellpos-$version-$(uname -m)-linux
tree=$(mktemp -d)
trap 'rm -rf "$tree"' EXIT
mkdir -p "$tree/$name/bin"
cp target/dist/cellpos target/dist/firmware-sim "$tree/$name/bin/"
cp -r README.md CHANGELOG.md LICENSE CITATION.cff docs examples "$tree/$name/"
tar -C "$tree" -czf "$out/$name.tar.gz" "$name"

python3 -m venv "$tree/env"
"$tree/env/bin/pip" install -q --disable-pip-version-check 'maturin>=1.7,<2'
(cd python && PATH="$tree/env/bin:$PATH" maturin build -q --out "$out" --profile dist)

# As a user would: nothing but the files, in an empty folder.
bare=$tree/bare
mkdir "$bare" && cd "$bare"
tar -xzf "$out/$name.tar.gz"
"$name/bin/cellpos" --version | grep -q "^cellpos $version " || fail "the archive's program has another version"
"$name/bin/cellpos" track --target 0um --duration 2s --clock virtual --seed 7 --runs runs --json > track.json
grep -q '"rms' track.json || fail "the archive's program holds no bead"
python3 -m venv env
env/bin/pip install -q --disable-pip-version-check "$out"/cellpos-*.whl
env/bin/python -c "import cellpos; assert cellpos.__version__ == '$version', cellpos.__version__"
cd "$out" && sha256sum -- * > SHA256SUMS
cat SHA256SUMS
