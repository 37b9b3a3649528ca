#!/usr/bin/env python3
"""Counts shipped lines of Rust by crate: no blank lines, no comments, no tests.

    tests/lines.py [FOLDER]     crates and total of a checkout
    tests/lines.py --files N    the N longest files too
    tests/lines.py --functions  functions of more than 60 lines too, their signature included

Left out are the folders `tests`, `benches`, `examples` and `fuzz`, files named `tests.rs`, `*_tests.rs` or
`testing.rs`, and items behind `#[cfg(test)]`. A line counts if anything but a comment stands on it.
"""

import re
import sys
from collections import Counter
from pathlib import Path

TESTS = re.compile(r"(^|/)(tests|benches|examples|fuzz|target)/|(^|/)(tests|\w+_tests|testing)\.rs$")
LONG_FUNCTION = 60


def without_tests(text: str) -> list[str]:
    """The lines outside of items behind `#[cfg(test)]`. Relies on rustfmt: an item ends where it began."""
    kept, lines, i = [], text.splitlines(), 0
    while i < len(lines):
        if lines[i].strip() != "#[cfg(test)]":
            kept.append(lines[i])
            i += 1
            continue
        while lines[i].lstrip().startswith("#["):
            i += 1
        indent = lines[i][: len(lines[i]) - len(lines[i].lstrip())]
        if not lines[i].rstrip().endswith((";", "}")):
            while lines[i] not in (f"{indent}}}", f"{indent}}};"):
                i += 1
        i += 1
    return kept


def code(lines: list[str]) -> list[str]:
    return [line for line in lines if line.strip() and not line.strip().startswith("//")]


def long_functions(lines: list[str]) -> list[tuple[int, str]]:
    found, start, indent, name = [], None, "", ""
    for i, line in enumerate(lines):
        begins = re.match(r"( *)(?:pub(?:\([^)]*\))? )?(?:const |async |unsafe )*fn (\w+)", line)
        if begins and start is None:
            start, indent, name = i, begins[1], begins[2]
        if start is not None and (line == f"{indent}}}" or (i == start and line.rstrip().endswith((";", "}")))):
            if i + 1 - start > LONG_FUNCTION:
                found.append((i + 1 - start, name))
            start = None
    return found


def main() -> None:
    arguments = sys.argv[1:]
    longest = int(arguments[arguments.index("--files") + 1]) if "--files" in arguments else 0
    folders = [a for a in arguments if not a.startswith("--") and not a.isdigit()]
    root = Path(folders[0] if folders else ".")
    crates = sorted((p.parent.relative_to(root) for p in root.rglob("Cargo.toml")), key=lambda p: -len(p.parts))
    by_crate, by_file, functions = Counter(), Counter(), []
    for path in sorted(root.rglob("*.rs")):
        name = path.relative_to(root).as_posix()
        if TESTS.search(name):
            continue
        lines = without_tests(path.read_text())
        crate = next((c for c in crates if c in Path(name).parents), Path("."))
        by_crate[crate.as_posix()] += len(code(lines))
        by_file[name] = len(code(lines))
        functions += [(length, f"{name}: {function}") for length, function in long_functions(lines)]
    for crate, count in by_crate.most_common():
        print(f"{count:7} {crate}")
    print(f"{by_crate.total():7} all")
    for name, count in by_file.most_common(longest):
        print(f"{count:7} {name}")
    if "--functions" in arguments:
        for length, name in sorted(functions, reverse=True):
            print(f"{length:7} {name}")


if __name__ == "__main__":
    main()
