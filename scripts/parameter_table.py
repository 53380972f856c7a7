#!/usr/bin/python3
"""Writes doc/parameters.md from the configuration structs, the one source of defaults.

Every `struct ...Config` under include/ gives a table: key, default, meaning. Keys are those that the
struct's Visit member names, so a key that cannot be set is not listed.

usage: parameter_table.py [--check]     --check: exit 1 when the file is out of date
"""
import pathlib
import re
import sys

ROOT = pathlib.Path(__file__).resolve().parent.parent
TARGET = ROOT / "doc" / "parameters.md"
HEAD = """# Parameters

One table per configuration struct; the YAML files in `config/` and the nodelets' private parameters
use the same keys. An unknown key is an error. Written by `scripts/parameter_table.py`; do not edit.
"""
FIELD = re.compile(r"^\s+(?:static )?(bool|int|double|std::string) (\w+) = (.+?);\s*(?:///<\s*(.*))?$")


def structs(text):
    """Yields (name, body) of every struct whose name ends with Config."""
    for m in re.finditer(r"^struct (\w+Config) \{\n(.*?)^\};", text, re.M | re.S):
        yield m.group(1), m.group(2)


def fields(body):
    """Yields (key, type, default, meaning) in the order of the struct."""
    visited = set(re.findall(r'v\("(\w+)", \w+\)', body))
    lines = body.splitlines()
    comment = []
    for i, line in enumerate(lines):
        if re.match(r"^\s*///(?!<)", line):
            comment.append(re.sub(r"^\s*///\s?", "", line))
            continue
        m = FIELD.match(line)
        if m:
            kind, key, default, meaning = m.groups()
            parts = [meaning] if meaning else []
            for follow in lines[i + 1:]:
                c = re.match(r"^\s*///<\s?(.*)$", follow)
                if not c:
                    break
                parts.append(c.group(1).strip())
            if not parts:
                parts = comment
            if key in visited:
                yield key, kind.replace("std::", ""), default, " ".join(parts)
        comment = []


def render():
    out = [HEAD]
    for header in sorted((ROOT / "include").rglob("*.h")):
        for name, body in structs(header.read_text()):
            rows = list(fields(body))
            if not rows:
                continue
            out.append(f"\n## {name}\n\n`{header.relative_to(ROOT / 'include')}`\n")
            out.append("| key | type | default | meaning |\n|---|---|---|---|")
            for key, kind, default, meaning in rows:
                meaning = meaning.replace("|", "\\|")
                out.append(f"| `{key}` | {kind} | `{default}` | {meaning} |")
    return "\n".join(out) + "\n"


def main():
    text = render()
    if "--check" in sys.argv[1:]:
        if not TARGET.exists() or TARGET.read_text() != text:
            print("doc/parameters.md is out of date; run scripts/parameter_table.py", file=sys.stderr)
            return 1
        return 0
    TARGET.write_text(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
