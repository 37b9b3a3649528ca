"""PyTorch programs for the kinds that `bench/pytorch/bench.py` of STRIDE_SHARED lacks. See compare.py.

The command line, the measuring and the output are bench.py's. Networks and losses are those of trainer/models and
trainer/stages; sizes are those of kinds.yaml (`_small`) and of the published recipes. Inputs are drawn once, and
everything that a step draws is drawn inside it.
"""

from __future__ import annotations

import math
import os
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
SHARED = Path(os.environ.get("STRIDE_SHARED", ROOT.parent / "shared")).resolve()
sys.path.insert(0, str(SHARED / "bench" / "pytorch"))

import bench  # noqa: E402

FEATURES, WORDS, CLASSES, WORD = 263, 22, 15, 300
# Captions have about twelve words.
SAID = 12


def cases() -> dict[str, tuple[str, dict]]:
    """name -> (kind, keyword arguments)."""
    table: dict[str, tuple[str, dict]] = {}

    def add(kind: str, small: dict, published: dict) -> None:
        table[f"{kind}_small"] = (kind, small)
        table[kind] = (kind, published)

    add("tokenizer",
        dict(codes=128, dim=64, layers=3, width=96, depth=3, growth=3, window=64, batch=32),
        dict(codes=512, dim=512, layers=6, width=512, depth=3, growth=3, window=64, batch=256))
    add("momask",
        dict(codes=128, layers=3, width=96, blocks=3, heads=4, ff=192, dropout=0.1, dim=64, batch=32),
        dict(codes=512, layers=6, width=384, blocks=8, heads=6, ff=1024, dropout=0.2, dim=512, batch=64))
    add("t2mgpt",
        dict(codes=128, width=96, half=2, heads=4, ff=384, dropout=0.1, batch=32),
        dict(codes=512, width=1024, half=9, heads=16, ff=4096, dropout=0.1, batch=128))
    add("mmm",
        dict(codes=128, dim=64, width=96, half=2, words=1, heads=4, ff=384, dropout=0.1, batch=32, said=SAID),
        dict(codes=8192, dim=32, width=1024, half=9, words=2, heads=16, ff=4096, dropout=0.1, batch=512, said=77))
    add("mdm",
        dict(width=128, blocks=4, heads=4, ff=256, dropout=0.0, batch=8, lengths="synthetic", masked=True),
        dict(width=512, blocks=8, heads=4, ff=1024, dropout=0.1, batch=64, lengths="whole", masked=False))
    add("stablemofusion",
        dict(width=32, multipliers=[1, 2], time=64, text=64, blocks=1, heads=4, ff=128, dropout=0.0, batch=8, said=SAID),
        dict(width=512, multipliers=[2, 2, 2, 2], time=512, text=256, blocks=4, heads=4, ff=2048, dropout=0.1, batch=64, said=77))
    add("flow",
        dict(width=64, condition=64, dim=64, codes=128, layers=3, tokenizer=96, window=64, batch=16),
        dict(width=512, condition=256, dim=512, codes=512, layers=6, tokenizer=512, window=64, batch=768))
    add("flow_student",
        dict(width=64, condition=64, dim=64, codes=128, layers=3, tokenizer=96, window=64, batch=16, student=True),
        dict(width=512, condition=256, dim=512, codes=512, layers=6, tokenizer=512, window=64, batch=768, student=True))
    add("movements", dict(hidden=128, movement=128, dropout=0.2, window=40, batch=32),
        dict(hidden=512, movement=512, dropout=0.2, window=40, batch=128))
    add("matching", dict(hidden=128, movement=128, motion=256, text=128, embedding=128, batch=64),
        dict(hidden=512, movement=512, motion=1024, text=512, embedding=512, batch=32))
    add("control",
        dict(base=(96, 5, 4, 192, 0.0), vae=(96, 1, 4, 192, 0.0), own=(64, 3, 4, 128, 0.0), embedding=96, batch=16),
        dict(base=(256, 9, 4, 1024, 0.1), vae=(256, 9, 4, 1024, 0.1), own=(256, 9, 4, 1024, 0.1), embedding=256, batch=128))
    return table


CASES = cases()
bench.CASES.update(CASES)


# --- layers -------------------------------------------------------------------------------------------------------------------


def sinusoids(length: int, width: int):
    import torch

    frequency = torch.exp(torch.arange(0, width, 2) * (-math.log(10000.0) / width))
    angles = torch.arange(length)[:, None] * frequency
    return torch.stack([angles.sin(), angles.cos()], 2).flatten(1)[None]


def networks():
    """The modules, which need torch."""
    import nets
    import torch
    import torch.nn.functional as F
    from torch import nn
    from types import SimpleNamespace

    class Channels(nn.Module):
        """A layer over [B, C, T], applied to [B, T, C]."""

        def __init__(self, inner):
            super().__init__()
            self.inner = inner

        def forward(self, x):
            return self.inner(x.transpose(1, 2)).transpose(1, 2)

    class ResidualBlock(nn.Module):
        def __init__(self, width, dilation):
            super().__init__()
            self.first, self.second = nn.Conv1d(width, width, 3, padding=dilation, dilation=dilation), nn.Conv1d(width, width, 1)

        def forward(self, x):
            return x + self.second(F.relu(self.first(F.relu(x))))

    def stack(width, depth, growth):
        return [ResidualBlock(width, growth**i) for i in reversed(range(depth))]

    class Tokenizer(nn.Module):
        """Encoder and decoder over [B, C, T]."""

        def __init__(self, width, dim, depth, growth):
            super().__init__()
            conv = lambda a, b: nn.Conv1d(a, b, 3, padding=1)
            down = [layer for _ in range(2) for layer in (nn.Conv1d(width, width, 4, 2, 1), *stack(width, depth, growth))]
            up = [layer for _ in range(2) for layer in (*stack(width, depth, growth), nn.Upsample(scale_factor=2), conv(width, width))]
            self.encoder = nn.Sequential(conv(FEATURES, width), nn.ReLU(), *down, conv(width, dim))
            self.decoder = nn.Sequential(conv(dim, width), nn.ReLU(), *up, conv(width, width), nn.ReLU(), conv(width, FEATURES))

    class Blocks(nn.Module):
        """Post-norm blocks over sequences with `mask` [B, 1, 1, T]."""

        def __init__(self, width, count, heads, ff, dropout):
            super().__init__()
            self.layers = nn.ModuleList(nets.Block(width, heads, ff, dropout, False) for _ in range(count))

        def forward(self, x, mask=None):
            for block in self.layers:
                x = block(x, None, mask)
            return x

    class Head(nn.Module):
        def __init__(self, width, out):
            super().__init__()
            self.dense, self.norm, self.final = nn.Linear(width, width), nn.LayerNorm(width, eps=1e-12), nn.Linear(width, out)

        def forward(self, x):
            return self.final(self.norm(F.gelu(self.dense(x))))

    class MaskedTransformer(nn.Module):
        def __init__(self, codes, width, blocks, heads, ff, dropout, dim):
            super().__init__()
            self.tokens, self.inner = nn.Embedding(codes + 2, dim), nn.Linear(dim, width)
            self.condition = nn.Linear(nets.TEXT_DIM, width)
            self.blocks, self.head, self.p = Blocks(width, blocks, heads, ff, dropout), Head(width, codes), dropout
            self.register_buffer("places", sinusoids(49, width), persistent=False)

        def forward(self, ids, text, mask):
            x = F.dropout(self.inner(self.tokens(ids)) + self.places, self.p, self.training)
            return self.head(self.blocks(torch.cat([self.condition(text)[:, None], x], 1), F.pad(mask, (1, 0), value=True)[:, None, None])[:, 1:])

    class ResidualTransformer(nn.Module):
        """Tables of inner layers are shared between inputs and outputs."""

        def __init__(self, codes, layers, width, blocks, heads, ff, dropout, dim):
            super().__init__()
            table = lambda rows: nn.Parameter(torch.randn(rows, codes + 1, dim) * 0.02)
            self.first, self.shared, self.last = table(1), table(layers - 2), table(1)
            self.inner, self.layer = nn.Linear(dim, width), nn.Linear(layers, width)
            self.condition = nn.Linear(nets.TEXT_DIM, width)
            self.blocks, self.head, self.p, self.layers = Blocks(width, blocks, heads, ff, dropout), Head(width, dim), dropout, layers
            self.register_buffer("places", sinusoids(49, width), persistent=False)

        def forward(self, ids, layer, text, mask):
            """`ids` [B, n, Q]; the ids of the layers below `layer` [B] are summed."""
            b, n, _ = ids.shape
            inputs = torch.cat([self.first, self.shared])
            below = torch.stack([inputs[q][ids[:, :, q]] for q in range(self.layers - 1)], 2)
            seen = torch.arange(self.layers - 1)[None] < layer[:, None]
            x = (below * seen[:, None, :, None]).sum(2)
            x = F.dropout(self.inner(x) + self.places, self.p, self.training)
            ahead = [self.condition(text)[:, None], self.layer(F.one_hot(layer, self.layers).float())[:, None]]
            out = self.head(self.blocks(torch.cat([*ahead, x], 1), F.pad(mask, (2, 0), value=True)[:, None, None])[:, 2:])
            return torch.bmm(out, torch.cat([self.shared, self.last])[layer - 1].transpose(1, 2))

    class SplitAttention(nn.Module):
        def __init__(self, width, heads, dropout):
            super().__init__()
            self.query, self.key, self.value, self.proj = (nn.Linear(width, width) for _ in range(4))
            self.heads, self.p = heads, dropout

        def forward(self, x, memory, mask=None, causal=False):
            split = lambda y: y.unflatten(2, (self.heads, -1)).transpose(1, 2)
            p = self.p if self.training else 0.0
            out = F.scaled_dot_product_attention(split(self.query(x)), split(self.key(memory)), split(self.value(memory)), mask, p, causal)
            return F.dropout(self.proj(out.transpose(1, 2).flatten(2)), self.p, self.training)

    class GptBlock(nn.Module):
        def __init__(self, width, heads, ff, dropout, cross=False):
            super().__init__()
            self.norm1, self.norm2 = nn.LayerNorm(width), nn.LayerNorm(width)
            self.norm3 = nn.LayerNorm(width) if cross else None
            self.attention = SplitAttention(width, heads, dropout)
            self.mlp = nn.Sequential(nn.Linear(width, ff), nn.GELU(), nn.Linear(ff, width), nn.Dropout(dropout))

        def forward(self, x, words=None, mask=None, causal=False):
            seen = self.norm1(x)
            x = x + self.attention(seen, seen if words is None else self.norm3(words), mask, causal)
            return x + self.mlp(self.norm2(x))

    class Gpt(nn.Module):
        def __init__(self, codes, width, half, heads, ff, dropout):
            super().__init__()
            self.tokens, self.condition = nn.Embedding(codes + 2, width), nn.Linear(nets.TEXT_DIM, width)
            self.blocks = nn.ModuleList(GptBlock(width, heads, ff, dropout) for _ in range(2 * half))
            self.norm, self.head = nn.LayerNorm(width), nn.Linear(width, codes + 1, bias=False)
            self.register_buffer("places", sinusoids(50, width), persistent=False)

        def forward(self, ids, text):
            x = torch.cat([self.condition(text)[:, None], self.tokens(ids)], 1) + self.places
            for block in self.blocks:
                x = block(x, causal=True)
            return self.head(self.norm(x))

    class Mmm(nn.Module):
        def __init__(self, codes, dim, width, half, words, heads, ff, dropout):
            super().__init__()
            self.own, self.inner = nn.Embedding(3, dim), nn.Linear(dim, width)
            self.condition, self.word = nn.Linear(nets.TEXT_DIM, width), nn.Linear(nets.TEXT_DIM, width)
            self.cross = nn.ModuleList(GptBlock(width, heads, ff, dropout, True) for _ in range(words))
            self.blocks = nn.ModuleList(GptBlock(width, heads, ff, dropout) for _ in range(2 * half - words))
            self.norm, self.head = nn.LayerNorm(width), nn.Linear(width, codes, bias=False)
            self.register_buffer("places", sinusoids(51, width), persistent=False)

        def forward(self, ids, book, text, words):
            n = ids.shape[1]
            x = self.inner(F.embedding(ids, torch.cat([book, self.own.weight]))) + self.places[:, :n]
            words = self.word(words)
            for block in self.cross:
                x = block(x, words)
            x = torch.cat([self.condition(text)[:, None], x], 1) + self.places[:, : n + 1]
            for block in self.blocks:
                x = block(x)
            return self.head(self.norm(x))[:, 1:]

    class Mdm(nn.Module):
        def __init__(self, width, blocks, heads, ff, dropout):
            super().__init__()
            self.inner, self.out = nn.Linear(FEATURES, width), nn.Linear(width, FEATURES)
            self.time = nn.Sequential(nn.Linear(width, width), nn.SiLU(), nn.Linear(width, width))
            self.text, self.blocks, self.p = nn.Linear(nets.TEXT_DIM, width), Blocks(width, blocks, heads, ff, dropout), dropout
            self.register_buffer("places", sinusoids(1000, width), persistent=False)

        def forward(self, x, t, text, valid):
            first = self.text(text) + self.time(self.places[0, t])
            x = torch.cat([first[:, None], self.inner(x)], 1) + self.places[:, : x.shape[1] + 1]
            mask = None if valid is None else F.pad(valid, (1, 0), value=True)[:, None, None]
            return self.out(self.blocks(F.dropout(x, self.p, self.training), mask)[:, 1:])

    class Groups(nn.Module):
        """A group norm over the channels of one frame."""

        def __init__(self, width):
            super().__init__()
            self.weight, self.bias = nn.Parameter(torch.ones(width)), nn.Parameter(torch.zeros(width))

        def forward(self, x):
            return F.layer_norm(x.unflatten(2, (8, -1)), (x.shape[2] // 8,)).flatten(2) * self.weight + self.bias

    class Conditioned(nn.Module):
        def __init__(self, inner, out, time, text, dropout):
            super().__init__()
            conv = lambda a, b, taps: Channels(nn.Conv1d(a, b, taps, padding=taps // 2))
            self.first, self.second, self.norm1, self.norm2 = conv(inner, out, 5), conv(out, out, 5), Groups(out), Groups(out)
            self.time = nn.Linear(time, 2 * out)
            self.skip = conv(inner, out, 1) if inner != out else nn.Identity()
            self.norm, self.text_norm = nn.LayerNorm(out), nn.LayerNorm(text)
            self.query, self.key, self.value = nn.Linear(out, out), nn.Linear(text, out), nn.Linear(text, out)
            self.p = dropout

        def forward(self, x, time, text, kept):
            scale, shift = self.time(time)[:, None].chunk(2, 2)
            h = F.mish(self.norm1(self.first(x)) * (scale + 1) + shift)
            x = F.dropout(F.mish(self.norm2(self.second(h))), self.p, self.training) + self.skip(x)
            split = lambda y: y.unflatten(2, (8, -1)).transpose(1, 2)
            text = self.text_norm(text)
            q, k, v = split(self.query(self.norm(x))).softmax(3), split(self.key(text)).softmax(2), split(self.value(text))
            context = F.dropout(k.transpose(2, 3) @ v, self.p, self.training)
            return x + (q @ context).transpose(1, 2).flatten(2) * kept

    class StableMoFusion(nn.Module):
        def __init__(self, width, multipliers, time, text, blocks, heads, ff, dropout):
            super().__init__()
            self.embed, self.encoder, self.norm = nn.Linear(nets.TEXT_DIM, text), Blocks(text, blocks, heads, ff, dropout), nn.LayerNorm(text)
            self.time = nn.Sequential(nn.Linear(time, 4 * time), nn.Mish(), nn.Linear(4 * time, time))
            self.register_buffer("places", sinusoids(1000, time), persistent=False)
            widths = [width * m for m in multipliers]
            make = lambda a, b: Conditioned(a, b, time, text, dropout)
            self.downs, self.ups = nn.ModuleList(), nn.ModuleList()
            for a, b in zip([FEATURES, *widths], widths):
                self.downs.append(nn.ModuleList([make(a, b), make(b, b), Channels(nn.Conv1d(b, b, 3, 2, 1))]))
            for a, b in zip([widths[-1], *reversed(widths)], reversed(widths)):
                self.ups.append(nn.ModuleList([Channels(nn.ConvTranspose1d(a, b, 4, 2, 1)), make(2 * b, b), make(b, b)]))
            self.middle = nn.ModuleList([make(widths[-1], widths[-1]) for _ in range(2)])
            self.final = nn.Linear(widths[0], FEATURES)

        def forward(self, x, t, words, kept):
            frames = x.shape[1]
            text = self.norm(self.encoder(self.embed(words)))
            time = F.mish(self.time(self.places[0, t]))
            x = F.pad(x, (0, 0, 0, -frames % 16))
            skips = []
            for first, second, down in self.downs:
                x = second(first(x, time, text, kept), time, text, kept)
                skips.append(x)
                x = down(x)
            for block in self.middle:
                x = block(x, time, text, kept)
            for up, first, second in self.ups:
                x = torch.cat([up(x), skips.pop()], 2)
                x = second(first(x, time, text, kept), time, text, kept)
            return self.final(x)[:, :frames]

    class Rms(nn.Module):
        def __init__(self, width):
            super().__init__()
            self.gain = nn.Parameter(torch.ones(1, width, 1))

        def forward(self, x):
            return F.normalize(x, dim=1) * self.gain * x.shape[1] ** 0.5

    class Timed(nn.Module):
        """Over [B, C, T]."""

        def __init__(self, inner, out, time):
            super().__init__()
            self.time = nn.Linear(time, 2 * out)
            self.first, self.norm1 = nn.Conv1d(inner, out, 3, padding=1), Rms(out)
            self.second, self.norm2 = nn.Conv1d(out, out, 3, padding=1), Rms(out)
            self.skip = nn.Conv1d(inner, out, 1) if inner != out else nn.Identity()

        def forward(self, x, time):
            scale, shift = self.time(F.silu(time))[:, :, None].chunk(2, 1)
            h = F.silu(self.norm1(self.first(x)) * (scale + 1) + shift)
            return F.silu(self.norm2(self.second(h))) + self.skip(x)

    class Flow(nn.Module):
        """The U-Net of two levels with one block each."""

        def __init__(self, width, condition, dim):
            super().__init__()
            time = 4 * width
            self.stacked, self.project = nn.Linear(4 * dim, 4 * dim), nn.Linear(dim, condition)
            self.first = nn.Conv1d(FEATURES + condition, width, 1)
            self.time = nn.Sequential(nn.Linear(width, time), nn.GELU(), nn.Linear(time, time))
            half = width // 2
            self.register_buffer("turns", torch.exp(torch.arange(half) * (-math.log(10000.0) / (half - 1))), persistent=False)
            self.down1, self.halve = Timed(width, width, time), nn.Conv1d(width, width, 4, 2, 1)
            self.down2, self.widen = Timed(width, width, time), nn.Conv1d(width, 2 * width, 3, padding=1)
            self.middle1, self.middle2 = Timed(2 * width, 2 * width, time), Timed(2 * width, 2 * width, time)
            self.up1, self.narrower = Timed(3 * width, 2 * width, time), nn.Conv1d(2 * width, width, 3, padding=1)
            self.up2, self.narrow = Timed(2 * width, width, time), nn.Conv1d(width, width, 3, padding=1)
            self.last, self.out = Timed(2 * width, width, time), nn.Conv1d(width, FEATURES, 1)

        def forward(self, x, t, codes):
            b, n, dim = codes.shape
            condition = self.project(self.stacked(codes.repeat(1, 1, 4)).view(b, 4 * n, dim))
            angles = t[:, None] * self.turns
            time = self.time(torch.cat([angles.sin(), angles.cos()], 1))
            first = self.first(torch.cat([x, condition], 2).transpose(1, 2))
            fine = self.down1(first, time)
            coarse = self.down2(self.halve(fine), time)
            x = self.middle2(self.middle1(self.widen(coarse), time), time)
            x = self.up1(torch.cat([x, coarse], 1), time)
            x = self.up2(torch.cat([self.narrower(F.interpolate(x, scale_factor=2)), fine], 1), time)
            return self.out(self.last(torch.cat([self.narrow(x), first], 1), time)).transpose(1, 2)

    class Movements(nn.Module):
        """The movement autoencoder over [B, T, C]."""

        def __init__(self, hidden, movement, dropout):
            super().__init__()
            leak = nn.LeakyReLU(0.2)
            down = lambda a, b: [Channels(nn.Conv1d(a, b, 4, 2, 1)), nn.Dropout(dropout), leak]
            up = lambda a, b: [Channels(nn.ConvTranspose1d(a, b, 4, 2, 1)), leak]
            self.encoder = nn.Sequential(*down(FEATURES - 4, hidden), *down(hidden, movement), nn.Linear(movement, movement))
            self.decoder = nn.Sequential(*up(movement, hidden), *up(hidden, FEATURES), nn.Linear(FEATURES, FEATURES))

    class Recurrent(nn.Module):
        def __init__(self, inner, width, embedding):
            super().__init__()
            self.inner, self.gru = nn.Linear(inner, width), nn.GRU(width, width, batch_first=True, bidirectional=True)
            self.start = nn.Parameter(torch.randn(2, 1, width))
            self.out = nn.Sequential(nn.Linear(2 * width, width), nn.LayerNorm(width), nn.LeakyReLU(0.2), nn.Linear(width, embedding))

        def forward(self, x, lengths):
            packed = nn.utils.rnn.pack_padded_sequence(self.inner(x), lengths, batch_first=True, enforce_sorted=False)
            _, last = self.gru(packed, self.start.expand(-1, len(lengths), -1).contiguous())
            return self.out(torch.cat([last[0], last[1]], 1))

    class Texts(nn.Module):
        def __init__(self, width, embedding):
            super().__init__()
            self.classes, self.words = nn.Linear(CLASSES, WORD), Recurrent(WORD, width, embedding)

        def forward(self, words, classes, lengths):
            return self.words(words + self.classes(classes), lengths)

    class Trajectory(nn.Module):
        """Tokens of the frames with targets; every frame has one here."""

        def __init__(self, width, layers, heads, ff, dropout, tokens=16, dim=32):
            super().__init__()
            self.tokens = nn.Parameter(torch.randn(tokens, width))
            self.joints, self.places = nn.Linear(3 * nets.JOINTS, width), nets.Positions(width)
            self.encoder, self.out = nets.SkipStack(width, layers, heads, ff, dropout, False), nn.Linear(width, dim)

        def forward(self, hints, mask):
            b, t, _ = hints.shape
            n = len(self.tokens)
            x = torch.cat([self.tokens.expand(b, -1, -1), self.joints(hints)], 1) + self.places(n + t)
            return self.out(self.encoder(x, None, F.pad(mask, (n, 0), value=True)[:, None, None])[:, :n])

    class Control(nn.Module):
        """The trained copy of a denoiser with its zero layers, and the trajectory encoder."""

        def __init__(self, base, own, embedding):
            super().__init__()
            width, layers, heads, ff, dropout = base
            self.copy = nets.Denoiser(width, layers, heads, ff, dropout, nets.GUIDANCE_DIM)
            self.copy.latent_post = self.copy.encoder.norm = nn.Identity()
            self.zeros = nn.ModuleList(nn.Linear(width, width) for _ in range(layers))
            self.trajectory = Trajectory(*own)
            self.condition = nn.Sequential(nn.Linear(32, embedding), nn.SiLU(), nn.Linear(embedding, embedding), nn.SiLU(), nn.Linear(embedding, 32))
            for layer in [*self.zeros, self.condition[4]]:
                nn.init.zeros_(layer.weight)
                nn.init.zeros_(layer.bias)

        def forward(self, z, t, text, guidance, hints, mask):
            tokens = self.trajectory(hints, mask)
            seen: list = []
            self.copy.through(z + self.condition(tokens), t, text, guidance, seen)
            return tokens, [zero(x) for zero, x in zip(self.zeros, seen)]

    def controlled(base, z, t, text, guidance, residuals):
        """The frozen denoiser with a residual added to each block's output."""
        time = base.time_embedding(nets.time_sinusoid(t, base.time_dim), guidance)[:, None]
        x = torch.cat([base.latent_pre(z), time, base.emb_proj["1"](text)], 1)
        x = x + base.query_pos(x.shape[1])
        stack, left, skips = base.encoder, list(residuals), []
        for block in stack.input_blocks:
            x = block(x, None, None) + left.pop(0)
            skips.append(x)
        x = stack.middle_block(x, None, None) + left.pop(0)
        for block, merge in zip(stack.output_blocks, stack.linear_blocks):
            x = block(merge(torch.cat([x, skips.pop()], 2)), None, None) + left.pop(0)
        return base.latent_post(stack.norm(x)[:, : base.tokens])

    return SimpleNamespace(**{name: value for name, value in locals().items() if name not in ("nets", "torch", "F", "nn", "SimpleNamespace")})


# --- steps --------------------------------------------------------------------------------------------------------------------


class Books:
    """Codebooks that follow the codes of every batch, with draws of codes and replacements of unused ones."""

    def __init__(self, codes: int, dim: int, layers: int):
        import torch

        self.codes = torch.randn(layers, codes, dim)
        self.sums, self.counts = self.codes.clone(), torch.ones(layers, codes)

    def nearest(self, rows, layer: int):
        book = self.codes[layer]
        return 2 * rows @ book.T - book.square().sum(1)

    def quantise(self, rows, active: int, drawn: bool):
        """Sum of codes, and (rows, ids) of each layer; without gradient."""
        import torch

        left, total, layers = rows, torch.zeros_like(rows), []
        for layer in range(active):
            near = self.nearest(left, layer)
            if drawn:
                near = near / 0.5 - torch.empty_like(near).uniform_().clamp_(min=1e-20).log_().neg_().clamp_(min=1e-20).log_()
            ids = near.argmax(1)
            layers.append((left, ids))
            found = self.codes[layer][ids]
            left, total = left - found, total + found
        return total, layers

    def follow(self, layers, decay: float = 0.99) -> None:
        import torch

        for layer, (rows, ids) in enumerate(layers):
            count = torch.bincount(ids, minlength=self.codes.shape[1]).float()
            sums = torch.zeros_like(self.codes[layer]).index_add_(0, ids, rows)
            self.sums[layer].lerp_(sums, 1 - decay)
            self.counts[layer].lerp_(count, 1 - decay)
            used = (self.counts[layer] >= 1)[:, None]
            spare = rows.repeat(-(-len(self.codes[layer]) // len(rows)), 1)[: len(self.codes[layer])]
            self.codes[layer] = torch.where(used, self.sums[layer] / self.counts[layer].clamp(min=1e-30)[:, None], spare)


def optimizer(module, lr: float, average=None, decay: float = 0.0):
    return bench.Optimizer(module, lr, average, decay)


def captions(mine: int, generator):
    import nets
    import torch

    return torch.randn(mine, nets.TEXT_DIM, generator=generator)


def token_lengths(mine: int):
    """Tokens of clips of the procedural set."""
    import torch

    return torch.tensor([n // 4 for n in bench.lengths_of("synthetic", mine)])


def make_tokenizer(n, args, generator, codes, dim, layers, width, depth, growth, window, batch):
    import torch
    import torch.nn.functional as F

    mine = bench.local(args, batch)
    net = n.Tokenizer(width, dim, depth, growth).train()

    class Both(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.net = net

        def forward(self, features, active):
            rows = self.net.encoder(features.transpose(1, 2)).transpose(1, 2).flatten(0, 1)
            with torch.no_grad():
                total, used = books.quantise(rows, active, layers > 1)
            passed = rows * active
            quantised = passed - passed.detach() + total
            commitment = sum(F.mse_loss(rows, (used[0][0] - left).detach()) for left in [*(r for r, _ in used[1:]), used[0][0] - total])
            decoded = self.net.decoder(quantised.view(len(features), -1, dim).transpose(1, 2)).transpose(1, 2)
            part = slice(4, 67)
            return F.smooth_l1_loss(decoded, features) + 0.5 * F.smooth_l1_loss(decoded[..., part], features[..., part]) + 0.02 * commitment / active, used

    books = Books(codes, dim, layers)
    model = bench.distributed(bench.compiled(Both(), args), args)
    adam = optimizer(net, bench.rate_of(args))
    features = torch.randn(mine, window, FEATURES, generator=generator)

    def step():
        active = int(torch.randint(1, layers + 1, ())) if layers > 1 and torch.rand(()) < 0.2 and args.ddp == 1 else layers
        loss, used = model(features, active)
        loss.backward()
        adam.step()
        with torch.no_grad():
            books.follow(used)
        return loss.detach()

    return step, {"tokenizer": net, "codebooks": books.codes}, batch


def make_momask(n, args, generator, codes, layers, width, blocks, heads, ff, dropout, dim, batch):
    import torch
    import torch.nn.functional as F

    mine = bench.local(args, batch)
    first = n.MaskedTransformer(codes, width, blocks, heads, ff, dropout, dim).train()
    above = n.ResidualTransformer(codes, layers, width, blocks, heads, ff, dropout, dim).train()
    one, two = (bench.distributed(bench.compiled(net, args), args) for net in (first, above))
    adams = [optimizer(net, bench.rate_of(args)) for net in (first, above)]
    ids = torch.randint(0, codes, (mine, 49, layers), generator=generator)
    valid = torch.arange(49)[None] < token_lengths(mine)[:, None]
    text = captions(mine, generator)

    def dropped(share):
        return text * (torch.rand(mine, 1) >= share)

    def step():
        share = torch.cos(torch.rand(mine, 1) * math.pi / 2)
        order = torch.rand(mine, 49).argsort(1)
        asked = (order < (49 * share).round().clamp(min=1)) & valid
        tokens = ids[..., 0]
        replace, hide = torch.rand(mine, 49) < 0.1, torch.rand(mine, 49) < 0.88
        hidden = torch.where(replace, torch.randint(0, codes, (mine, 49)), torch.where(hide, codes, tokens))
        seen = torch.where(valid, torch.where(asked, hidden, tokens), codes + 1)
        loss = F.cross_entropy(one(seen, dropped(0.1), valid)[asked], tokens[asked])
        loss.backward()
        adams[0].step()
        layer = 1 + ((1 - torch.cos(torch.rand(mine) * math.pi / 2)) * (layers - 2)).round().long()
        wanted = ids.gather(2, layer[:, None, None].expand(-1, 49, 1))[..., 0]
        later = F.cross_entropy(two(ids, layer, dropped(0.2), valid)[valid], wanted[valid])
        later.backward()
        adams[1].step()
        return (loss + later).detach()

    return step, {"first": first, "above": above}, batch


def make_t2mgpt(n, args, generator, codes, width, half, heads, ff, dropout, batch):
    import torch
    import torch.nn.functional as F

    mine = bench.local(args, batch)
    net = n.Gpt(codes, width, half, heads, ff, dropout).train()
    model, adam = bench.distributed(bench.compiled(net, args), args), optimizer(net, bench.rate_of(args))
    lengths, text = token_lengths(mine), captions(mine, generator)
    at = torch.arange(50)[None]
    target = torch.randint(0, codes, (mine, 50), generator=generator)
    target = torch.where(at < lengths[:, None], target, torch.where(at == lengths[:, None], codes, codes + 1))
    weights = ((at <= lengths[:, None]) / (lengths[:, None] + 1)).float() / mine

    def step():
        seen = torch.where(torch.rand(mine, 49) < 0.5, target[:, :49], torch.randint(0, codes, (mine, 49)))
        logits = model(seen, text)
        losses = F.cross_entropy(logits.flatten(0, 1), target.clamp(max=codes).flatten(), reduction="none")
        loss = (losses * weights.flatten()).sum()
        loss.backward()
        adam.step()
        return loss.detach()

    return step, {"gpt": net}, batch


def make_mmm(n, args, generator, codes, dim, width, half, words, heads, ff, dropout, batch, said):
    import nets
    import torch
    import torch.nn.functional as F

    mine = bench.local(args, batch)
    net = n.Mmm(codes, dim, width, half, words, heads, ff, dropout).train()
    model, adam = bench.distributed(bench.compiled(net, args), args), optimizer(net, bench.rate_of(args))
    lengths, text = token_lengths(mine), captions(mine, generator)
    spoken = torch.randn(mine, said, nets.TEXT_DIM, generator=generator)
    book = torch.randn(codes, dim, generator=generator)
    at = torch.arange(50)[None]
    valid = at < lengths[:, None]
    target = torch.where(valid, torch.randint(0, codes, (mine, 50), generator=generator), torch.where(at == lengths[:, None], codes, codes + 1))
    weights = (valid / lengths[:, None]).float() / mine

    def step():
        count = (lengths[:, None] * (0.5 + 0.5 * torch.rand(mine, 1))).round().clamp(min=1)
        order = (torch.rand(mine, 50) - valid.float()).argsort(1)
        noised = torch.where(valid & (torch.rand(mine, 50) < 0.5), torch.randint(0, codes, (mine, 50)), target)
        logits = model(torch.where(order < count, codes + 2, noised), book, text, spoken)
        losses = F.cross_entropy(logits.flatten(0, 1), target.clamp(max=codes - 1).flatten(), reduction="none")
        loss = (losses * weights.flatten()).sum()
        loss.backward()
        adam.step()
        return loss.detach()

    return step, {"mmm": net}, batch


def linear_betas(steps: int = 1000):
    import torch

    bar = torch.cumprod(1 - torch.linspace(1e-4, 0.02, steps, dtype=torch.float64), 0)
    return bar.sqrt().float(), (1 - bar).sqrt().float()


def make_mdm(n, args, generator, lengths, masked, batch, **size):
    import copy

    import torch

    net = n.Mdm(**size).train()
    kept = copy.deepcopy(net)
    model, adam = bench.distributed(bench.compiled(net, args), args), optimizer(net, bench.rate_of(args), kept, 0.998)
    alpha, sigma = linear_betas()
    groups = [[196] * batch] if lengths == "whole" else bench.batches_of(lengths, batch, 4)
    rank, data = args.rank, []
    for group in groups:
        mine = torch.tensor(group[rank :: args.ddp])
        frames = int(mine.max())
        valid = torch.arange(frames)[None] < mine[:, None]
        features = torch.randn(len(mine), frames, FEATURES, generator=generator) * valid[..., None]
        data.append((features, valid, (valid / mine[:, None])[..., None].float() / len(mine), captions(len(mine), generator)))
    turn = 0

    def step():
        nonlocal turn
        features, valid, weights, text = data[turn % len(data)]
        turn += 1
        mine = len(features)
        t = torch.randint(0, 1000, (mine,))
        noisy = features * alpha[t][:, None, None] + torch.randn_like(features) * sigma[t][:, None, None]
        found = model(noisy, t, text * (torch.rand(mine, 1) >= 0.1), valid if masked else None)
        loss = ((found - features).square() * weights).sum() / FEATURES
        loss.backward()
        adam.step()
        return loss.detach()

    return step, {"mdm": net}, batch, len(data)


def make_stablemofusion(n, args, generator, batch, said, **size):
    import copy

    import nets
    import torch

    mine = bench.local(args, batch)
    net = n.StableMoFusion(**size).train()
    model, adam = bench.distributed(bench.compiled(net, args), args), optimizer(net, bench.rate_of(args))
    kept = list(copy.deepcopy(net).parameters())
    alpha, sigma = linear_betas()
    lengths = torch.tensor(bench.lengths_of("synthetic", mine))
    valid = torch.arange(196)[None] < lengths[:, None]
    features = torch.randn(mine, 196, FEATURES, generator=generator) * valid[..., None]
    weights = (valid / lengths[:, None])[..., None].float() / mine
    words = torch.randn(mine, said, nets.TEXT_DIM, generator=generator)
    turn = 0

    def step():
        nonlocal turn
        turn += 1
        t = torch.randint(0, 1000, (mine,))
        noisy = features * alpha[t][:, None, None] + torch.randn_like(features) * sigma[t][:, None, None]
        found = model(noisy, t, words, (torch.rand(mine, 1, 1) >= 0.1).float())
        loss = ((found - features).square() * weights).sum() / FEATURES
        loss.backward()
        adam.step()
        if turn % 8 == 0:
            with torch.no_grad():
                torch._foreach_lerp_(kept, list(net.parameters()), 0.01)
        return loss.detach()

    return step, {"stablemofusion": net}, batch


def make_flow(n, args, generator, width, condition, dim, codes, layers, tokenizer, window, batch, student=False):
    import copy

    import torch
    import torch.nn.functional as F

    mine = bench.local(args, batch)
    encoder = n.Tokenizer(tokenizer, dim, 3, 3).eval().requires_grad_(False).encoder
    books = Books(codes, dim, layers)
    net = n.Flow(width, condition, dim).train()
    kept = copy.deepcopy(net).requires_grad_(False)
    teacher = copy.deepcopy(net).requires_grad_(False)
    model, adam = bench.distributed(bench.compiled(net, args), args), optimizer(net, bench.rate_of(args), kept, 0.95 if student else 0.999)
    features = torch.randn(mine, window, FEATURES, generator=generator)
    row = lambda t: t[:, None, None]
    field = lambda net, x, t, codes: (net(x, t, codes) - x) / row((1 - t).clamp(min=0.05))

    def step():
        with torch.inference_mode():
            rows = encoder(features.transpose(1, 2)).transpose(1, 2)
            total, _ = books.quantise(rows.flatten(0, 1), layers, False)
        seen = total.view(mine, -1, dim).clone()
        noise = torch.randn_like(features)
        if not student:
            t = torch.rand(mine)
            loss = F.mse_loss(model(features * row(t) + noise * row(1 - t), t, seen), features)
        else:
            t = torch.randint(0, 16, (mine,)) / 16.0
            noisy = features * row(t) + noise * row(1 - t)
            with torch.no_grad():
                middle = noisy + field(teacher, noisy, t, seen) / 32
                solved = noisy + field(teacher, middle, t + 1 / 32, seen) / 16
                goal = solved + row(1 - t - 1 / 16) * field(kept, solved, t + 1 / 16, seen)
            found = noisy + row(1 - t) * ((model(noisy, t, seen) - noisy) / row((1 - t).clamp(min=0.05)))
            loss = (((found - goal).square() + 0.25).sqrt() - 0.5).mean()
        loss.backward()
        adam.step()
        return loss.detach()

    return step, {"flow": net}, batch


def make_movements(n, args, generator, hidden, movement, dropout, window, batch):
    import torch

    mine = bench.local(args, batch)
    net = n.Movements(hidden, movement, dropout).train()

    class Both(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.net = net

        def forward(self, features):
            movements = self.net.encoder(features[..., :-4])
            made = self.net.decoder(movements)
            return (made - features).abs().mean() + 1e-3 * movements.abs().mean() + 1e-3 * (movements[:, 1:] - movements[:, :-1]).abs().mean()

    model, adam = bench.distributed(bench.compiled(Both(), args), args), optimizer(net, bench.rate_of(args))
    features = torch.randn(mine, window, FEATURES, generator=generator)

    def step():
        loss = model(features)
        loss.backward()
        adam.step()
        return loss.detach()

    return step, {"movements": net}, batch


def make_matching(n, args, generator, hidden, movement, motion, text, embedding, batch):
    import torch

    mine = bench.local(args, batch)
    encoder = n.Movements(hidden, movement, 0.0).eval().requires_grad_(False).encoder
    motions, texts = n.Recurrent(movement, motion, embedding).train(), n.Texts(text, embedding).train()

    class Both(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.motions, self.texts = motions, texts

        def forward(self, movements, lengths, words, classes, said):
            a, b = self.texts(words, classes, said), self.motions(movements, lengths)
            squared = (a[:, None] - b[None] + 1e-6).square().sum(2)
            near = (10 - squared.sqrt()).clamp(min=0).square()
            return (squared.diagonal().sum() + (near.sum() - near.diagonal().sum()) / (mine - 1)) / mine

    model = bench.distributed(bench.compiled(Both(), args), args)
    adams = [optimizer(net, bench.rate_of(args)) for net in (motions, texts)]
    frames = torch.tensor(bench.lengths_of("synthetic", mine))
    features = torch.randn(mine, int(frames.max()) // 4 * 4 + 4, FEATURES, generator=generator)
    words, classes = torch.randn(mine, WORDS, WORD, generator=generator), torch.eye(CLASSES)[torch.randint(0, CLASSES, (mine, WORDS), generator=generator)]
    said = torch.full((mine,), SAID)

    def step():
        with torch.inference_mode():
            movements = encoder(features[..., :-4])
        loss = model(movements.clone(), frames // 4, words, classes, said)
        loss.backward()
        for adam in adams:
            adam.step()
        return loss.detach()

    return step, {"motion": motions, "text": texts, "movements": encoder}, batch


def make_control(n, args, generator, base, vae, own, embedding, batch):
    import nets
    import torch
    import torch.nn.functional as F

    mine = bench.local(args, batch)
    width, layers, heads, ff, dropout = base
    frozen = nets.Denoiser(width, layers, heads, ff, dropout, nets.GUIDANCE_DIM).eval().requires_grad_(False)
    decoder = nets.Vae(vae[0], vae[1], vae[2], vae[3], 0.0).eval().requires_grad_(False)
    net = n.Control(base, own, embedding).train()
    model, adam = bench.distributed(bench.compiled(net, args), args), optimizer(net, bench.rate_of(args))
    noise = bench.Schedule()
    lengths = torch.tensor(sorted(bench.lengths_of("synthetic", mine)))
    frames = int(lengths.max())
    valid = torch.arange(frames)[None] < lengths[:, None]
    clean, text = torch.randn(mine, 16, 32, generator=generator), torch.randn(mine, 1, nets.TEXT_DIM, generator=generator)
    hints = torch.randn(mine, frames, 3 * nets.JOINTS, generator=generator)
    targets = torch.randn(mine, frames, 3, generator=generator)
    weights = (valid / lengths[:, None])[..., None].float() / mine

    def step():
        t = (torch.randint(0, 10, (mine,)) + 1) * 100 - 1
        guidance = nets.guidance_embedding(torch.empty(mine).uniform_(0.5, 5.0), nets.GUIDANCE_DIM)
        noisy = bench.affine(clean, torch.randn_like(clean), noise.add(t))
        tokens, residuals = model(noisy, t, text, guidance, hints, valid)
        found = bench.affine(noisy, n.controlled(frozen, noisy, t, text, guidance, residuals), noise.jump(t, torch.zeros_like(t)))
        joints = nets.joints(decoder.decode(found, valid, frames))[:, :, 0]
        loss = F.mse_loss(tokens, clean) + F.mse_loss(found, clean) + 0.3 * ((joints - targets).abs() * weights).sum()
        loss.backward()
        adam.step()
        return loss.detach()

    # Upstream's copy has the projection of its denoiser, unused.
    return step, {"control": net, "unused": torch.nn.Linear(width, 32)}, batch


MAKERS = {
    "tokenizer": make_tokenizer, "momask": make_momask, "t2mgpt": make_t2mgpt, "mmm": make_mmm, "mdm": make_mdm, "stablemofusion": make_stablemofusion,
    "flow": make_flow, "flow_student": make_flow, "movements": make_movements, "matching": make_matching, "control": make_control,
}


# --- running ------------------------------------------------------------------------------------------------------------------


def counted(part) -> int:
    import torch

    return part.numel() if isinstance(part, torch.Tensor) else bench.count(part)


def made(args, rank: int):
    import torch

    kind, settings = CASES[args.case]
    if args.batch:
        settings = {**settings, "batch": args.batch}
    args.rank = rank
    step, modules, batch, *cycle = MAKERS[kind](networks(), args, torch.Generator().manual_seed(5 + rank), **settings)
    return bench.Work(batch, settings, {name: counted(module) for name, module in modules.items()}, step, *cycle)


def process(rank, args, rendezvous):
    import json

    import torch
    import torch.distributed as dist

    torch.set_num_threads(args.threads)
    torch.set_num_interop_threads(1)
    if args.ddp > 1:
        os.environ.setdefault("GLOO_SOCKET_IFNAME", "lo")
        dist.init_process_group("gloo", init_method=f"file://{rendezvous}", rank=rank, world_size=args.ddp)
    torch.manual_seed(1)
    work = made(args, rank)
    torch.manual_seed(100 + rank)
    result = (bench.check if args.check else bench.measure)(work, args, rank)
    if rank == 0:
        line = {"case": args.case, "threads": args.threads, "ddp": args.ddp, **result, "batch": work.batch, "params": work.params, "mkl": args.mkl, "torch": torch.__version__}
        print(json.dumps(line), flush=True)
    if args.ddp > 1:
        dist.destroy_process_group()


if __name__ == "__main__":
    bench.process = process
    bench.main()
