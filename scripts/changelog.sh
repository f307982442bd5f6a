#!/usr/bin/env bash
# Joins the fragments of changelog/ into a section of CHANGELOG.md and removes them.
# usage: scripts/changelog.sh VERSION [--dry]     --dry prints the section and changes nothing
set -euo pipefail
cd "$(dirname "$0")/.."
version=${1:?usage: scripts/changelog.sh VERSION [--dry]}
[[ $version =~ ^[0-9]+\.[0-9]+\.[0-9]+$ ]] || { echo "changelog: '$version' is no version such as 0.2.0" >&2; exit 2; }
! grep -q "^## $version\b" CHANGELOG.md || { echo "changelog: CHANGELOG.md has a section $version already" >&2; exit 2; }
section=$(mktemp)
trap 'rm -f "$section"' EXIT
printf '## %s, %s\n' "$version" "$(date -u +%F)" > "$section"
known='added|changed|fixed|removed'
for file in changelog/*.md; do
    name=$(basename "$file")
    [ "$name" = README.md ] || [[ $name =~ ^($known)-.+\.md$ ]] || { echo "changelog: $file begins with none of $known" >&2; exit 2; }
done
for kind in added changed fixed removed; do
    files=(changelog/"$kind"-*.md)
    [ -e "${files[0]}" ] || continue
    printf '\n### %s\n\n' "${kind^}" >> "$section"
    for file in "${files[@]}"; do
        # One item a file: its lines are one paragraph.
        printf -- '- %s\n' "$(tr '\n' ' ' < "$file" | sed 's/  */ /g; s/^[- ]*//; s/ *$//')" >> "$section"
    done
done
if [ "${2:-}" = --dry ]; then cat "$section"; exit 0; fi
# Below the introduction, above the newest version.
awk -v file="$section" '
    /^## / && !done { while ((getline line < file) > 0) print line; print ""; done = 1 }
    { print }
    END { if (!done) { print ""; while ((getline line < file) > 0) print line } }' CHANGELOG.md > CHANGELOG.new
mv CHANGELOG.new CHANGELOG.md
find changelog -name '*.md' ! -name README.md -delete
