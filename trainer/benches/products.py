"""Rates of the products of linear layers beside PyTorch's, on one core.

    trainer/benches/products.py PROGRAM [--rounds N]

PROGRAM is the bench `products` of the package `models`, as `cargo bench -p models --bench products --no-run` builds it.
The two programs alternate, and the best rate of each counts, so that other work on the machine counts little.
"""

from __future__ import annotations

import argparse
import subprocess
import time

# Rows, inputs, outputs: the quickstart's denoiser, MotionLCM, MoMask's tokenizer as windows of three taps, T2M-GPT.
LAYERS = ["576x96x192", "576x192x96", "400x256x1024", "400x1024x256", "512x1536x512", "408x1024x1024", "408x1024x4096", "408x4096x1024"]
PRODUCTS = ["output", "gradient of input", "gradient of weight"]


def ours(program: str) -> dict[str, list[float]]:
    text = subprocess.run([program, *LAYERS], check=True, capture_output=True, text=True).stdout
    return {line.split()[0]: [float(rate) for rate in line.split()[1:]] for line in text.splitlines()}


def theirs() -> dict[str, list[float]]:
    import torch

    torch.set_num_threads(1)
    rates = {}
    for layer in LAYERS:
        rows, inputs, outputs = (int(size) for size in layer.split("x"))
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
    found: list[list[dict[str, list[float]]]] = [[], []]
    for _ in range(asked.rounds):
        found[0].append(ours(asked.program))
        found[1].append(theirs())
    best = [{layer: [max(rates) for rates in zip(*(one[layer] for one in rounds))] for layer in LAYERS} for rounds in found]
    heads = [f"{product}, {whose}" for product in PRODUCTS for whose in ("Stride", "PyTorch", "share")]
    print("| rows x inputs x outputs | " + " | ".join(heads) + " |\n|---" + "|---:" * len(heads) + "|")
    for layer in LAYERS:
        cells = [f"{a:.0f} | {b:.0f} | {a / b:.2f}" for a, b in zip(best[0][layer], best[1][layer])]
        print(f"| {layer.replace('x', ' x ')} | " + " | ".join(cells) + " |")


if __name__ == "__main__":
    main()
