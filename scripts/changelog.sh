#!/usr/bin/env bash
# Joins the fragments of changelog/ into the section of a version in CHANGELOG.md and removes them.
# usage: scripts/changelog.sh VERSION [--dry]     --dry prints the section and changes nothing
# A section that exists is extended until the version is released; a section "Not yet released" becomes part of it.
set -euo pipefail
cd "$(dirname "$0")/.."
exec python3 - "$@" <<'END'
import datetime
import re
import sys
from pathlib import Path

KINDS = ["Added", "Changed", "Fixed", "Removed"]


def fail(why: str):
    sys.exit(f"changelog: {why}")


words = [word for word in sys.argv[1:] if word != "--dry"]
if len(words) != 1 or not re.fullmatch(r"\d+\.\d+\.\d+", words[0]):
    fail("usage: scripts/changelog.sh VERSION [--dry], with a version such as 0.2.0")
version = words[0]

page = Path("CHANGELOG.md").read_text()
introduction, *sections = re.split(r"(?m)^(?=## )", page)
items = {kind: [] for kind in KINDS}
others = []
for section in sections:
    title, _, body = section.partition("\n")
    if title != "## Not yet released" and not title.startswith(f"## {version},"):
        others.append(section)
        continue
    for part in re.split(r"(?m)^### ", body)[1:]:
        kind, _, text = part.partition("\n")
        items[kind] += [item.rstrip() for item in re.split(r"(?m)^(?=- )", text) if item.strip()]

fragments = [path for path in sorted(Path("changelog").glob("*.md")) if path.name != "README.md"]
for path in fragments:
    kind = path.name.split("-")[0].capitalize()
    if kind not in KINDS or "-" not in path.name:
        fail(f"{path} begins with none of {', '.join(kind.lower() for kind in KINDS)}")
    # One item a file: its lines are one paragraph.
    items[kind].append("- " + " ".join(path.read_text().split()).removeprefix("- "))

new = f"## {version}, {datetime.datetime.now(datetime.timezone.utc):%F}\n"
for kind in KINDS:
    if items[kind]:
        new += f"\n### {kind}\n\n" + "\n".join(items[kind]) + "\n"
if "--dry" in sys.argv:
    print(new, end="")
    sys.exit()
Path("CHANGELOG.md").write_text(introduction + new + "".join("\n" + section for section in others))
for path in fragments:
    path.unlink()
END
