"""Rates of the products of linear layers beside PyTorch's, on one core.

    python3 trainer/benches/products.py PROGRAM [--rounds N]

It needs PyTorch. PROGRAM is the bench `products` of the package `models`, as `cargo bench -p models --bench products --no-run` builds it.
The two programs alternate, and the best rate of each counts, so that other work on the machine counts little.
"""

from __future__ import annotations

import argparse
import subprocess
import time

PRODUCTS = ["output", "gradient of input", "gradient of weight"]


Layer = tuple[int, ...]


def ours(program: str) -> dict[Layer, list[float]]:
    """Rates by the rows, inputs and outputs of each layer."""
    lines = subprocess.run([program], check=True, capture_output=True, text=True).stdout.splitlines()
    return {tuple(int(size) for size in line.split()[:3]): [float(rate) for rate in line.split()[3:]] for line in lines}


def theirs(layers: list[Layer]) -> dict[Layer, list[float]]:
    import torch

    torch.set_num_threads(1)
    rates = {}
    for layer in layers:
        rows, inputs, outputs = layer
        x, w, dy = torch.randn(rows, inputs), torch.randn(outputs, inputs), torch.randn(rows, outputs)
        rates[layer] = []
        for product in (lambda: x @ w.T, lambda: dy @ w, lambda: dy.T @ x):
            least = float("inf")
            for _ in range(15):
                start = time.perf_counter()
                product()
                least = min(least, time.perf_counter() - start)
            rates[layer].append(2e-9 * rows * inputs * outputs / least)
    return rates


def main() -> None:
    parser = argparse.ArgumentParser(description="Products of linear layers beside PyTorch's.")
    parser.add_argument("program")
    parser.add_argument("--rounds", type=int, default=5)
    asked = parser.parse_args()
    found: list[list[dict[Layer, list[float]]]] = [[], []]
    for _ in range(asked.rounds):
        found[0].append(ours(asked.program))
        found[1].append(theirs(list(found[0][0])))
    layers = list(found[0][0])
    best = [{layer: [max(rates) for rates in zip(*(one[layer] for one in rounds))] for layer in layers} for rounds in found]
    heads = [f"{product}, {whose}" for product in PRODUCTS for whose in ("Stride", "PyTorch", "share")]
    print("| rows x inputs x outputs | " + " | ".join(heads) + " |\n|---" + "|---:" * len(heads) + "|")
    for layer in layers:
        cells = [f"{a:.0f} | {b:.0f} | {a / b:.2f}" for a, b in zip(best[0][layer], best[1][layer])]
        print(f"| {' x '.join(map(str, layer))} | " + " | ".join(cells) + " |")


if __name__ == "__main__":
    main()
