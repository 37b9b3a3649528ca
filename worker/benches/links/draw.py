#!/usr/bin/env python3
"""Draws the measured steps beside the formula: draw.py measured.json network.svg"""

import json
import math
import sys

LINES = {"gigabit": "1 Gbit/s", "late": "1 Gbit/s, 20 ms", "slow": "50 Mbit/s"}
COLOURS = {250_000: "#2f7f86", 2_000_000: "#b5651d", 10_000_000: "#6a4c93"}
MEMBERS = [2, 4, 8, 16]
TICKS = [1, 10, 100, 1_000, 10_000]
SIDE, HEIGHT, LEFT, TOP, GAP = 250, 260, 70, 84, 30


def number(milliseconds: float) -> str:
    return f"{milliseconds / 1000:g} s" if milliseconds >= 1000 else f"{milliseconds:g} ms"


def main(measured: str, drawing: str) -> None:
    rows = [row for row in json.load(open(measured))["exchange"] if row["members"] > 1]
    width, height = LEFT + 3 * SIDE + 2 * GAP + 20, TOP + HEIGHT + 50
    out = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" viewBox="0 0 {width} {height}" '
        'font-family="sans-serif" font-size="12" fill="#282a30">',
        f'<rect width="{width}" height="{height}" fill="#fafaf8"/>',
        f'<text x="{LEFT}" y="24" font-size="15">Time of an exchange, by members and parameters</text>',
    ]
    at = LEFT
    for parameters, colour in COLOURS.items():
        out.append(f'<circle cx="{at + 5}" cy="42" r="4" fill="{colour}"/>')
        out.append(f'<text x="{at + 14}" y="46">{parameters / 1e6:g} million</text>')
        at += 110
    out.append(f'<line x1="{at}" x2="{at + 24}" y1="42" y2="42" stroke="#282a30" stroke-width="1.5"/>')
    out.append(f'<text x="{at + 30}" y="46">the formula</text>')
    out.append(f'<circle cx="{at + 125}" cy="42" r="4" fill="none" stroke="#282a30" stroke-width="1.5"/>')
    out.append(f'<text x="{at + 134}" y="46">gloo</text>')

    low, high = math.log10(TICKS[0]), math.log10(TICKS[-1] * 3)

    def y(milliseconds: float) -> float:
        return TOP + HEIGHT * (high - math.log10(milliseconds)) / (high - low)

    for panel, (line, title) in enumerate(LINES.items()):
        left = LEFT + panel * (SIDE + GAP)

        def x(members: float, left: float = left) -> float:
            return left + 15 + (SIDE - 30) * (math.log2(members) - 1) / 3

        out.append(f'<text x="{left + SIDE / 2}" y="{TOP - 10}" text-anchor="middle">{title}</text>')
        for tick in TICKS:
            out.append(f'<line x1="{left}" x2="{left + SIDE}" y1="{y(tick):.1f}" y2="{y(tick):.1f}" stroke="#dedfe0"/>')
            if panel == 0:
                out.append(f'<text x="{left - 8}" y="{y(tick) + 4:.1f}" text-anchor="end">{number(tick)}</text>')
        for members in MEMBERS:
            out.append(f'<line x1="{x(members):.1f}" x2="{x(members):.1f}" y1="{TOP}" y2="{TOP + HEIGHT}" stroke="#dedfe0"/>')
            out.append(f'<text x="{x(members):.1f}" y="{TOP + HEIGHT + 18}" text-anchor="middle">{members}</text>')
        out.append(f'<text x="{left + SIDE / 2}" y="{TOP + HEIGHT + 38}" text-anchor="middle">members</text>')
        for parameters, colour in COLOURS.items():
            of = [row for row in rows if row["line"] == line and row["parameters"] == parameters]
            ours = [row for row in of if row["program"] == "stride"]
            points = " ".join(f'{x(row["members"]):.1f},{y(row["formula_ms"]):.1f}' for row in ours)
            out.append(f'<polyline points="{points}" fill="none" stroke="{colour}" stroke-width="1.5"/>')
            for row in of:
                place = f'cx="{x(row["members"]):.1f}" cy="{y(row["milliseconds"]):.1f}"'
                style = f'fill="{colour}"' if row["program"] == "stride" else f'fill="none" stroke="{colour}" stroke-width="1.5"'
                out.append(f'<circle {place} r="{4 if row["program"] == "stride" else 6}" {style}/>')
    out.append("</svg>")
    open(drawing, "w").write("\n".join(out) + "\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
