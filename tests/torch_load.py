"""Loads in PyTorch the files that `registry export --layout motionlcm|momask|t2mgpt|mdm` writes, and compares them with those that were imported.

By hand, in a virtual environment with `pip install torch numpy`:

    STRIDE_EXPORTS=out cargo test -p stages --test published_weights
    python tests/torch_load.py out

The test imports the checkpoints of the fixtures, writes each in its published layout, and lists in `out/pairs.tsv` what was written and what it was
imported from. Files are loaded with `weights_only=True`, which runs nothing; tensors have to be the same under the same keys, bit by bit.
Other files are compared with

    python tests/torch_load.py EXPORTED IMPORTED
"""

import os
import sys

import torch


def tensors(value, place=()):
    """Tensors by the keys that lead to them."""
    if isinstance(value, torch.Tensor):
        return {place: value}
    if isinstance(value, dict):
        return {key: tensor for name, item in value.items() for key, tensor in tensors(item, place + (name,)).items()}
    return {}


def load(path):
    return tensors(torch.load(path, map_location="cpu", weights_only=True))


def bits(tensor):
    return tensor.detach().contiguous().view(torch.uint8) if tensor.dim() else tensor.detach().reshape(1).view(torch.uint8)


def compare(ours, theirs, without=()):
    """What differs, in words; how many tensors and numbers were compared."""
    found, expected = load(ours), load(theirs)
    left_out = [key for key in expected if any(".".join(key).startswith(begin) for begin in without)]
    expected = {key: tensor for key, tensor in expected.items() if key not in left_out}
    wrong = [f"{'.'.join(key)} is missing" for key in expected.keys() - found.keys()]
    wrong += [f"{'.'.join(key)} is not in the original" for key in found.keys() - expected.keys()]
    for key in sorted(expected.keys() & found.keys()):
        a, b = found[key], expected[key]
        if (a.dtype, a.shape) != (b.dtype, b.shape):
            wrong.append(f"{'.'.join(key)} is {a.dtype} {tuple(a.shape)}, not {b.dtype} {tuple(b.shape)}")
        elif not torch.equal(bits(a), bits(b)):
            wrong.append(f"{'.'.join(key)} has other numbers")
        elif not a.is_contiguous():
            wrong.append(f"{'.'.join(key)} is laid out with strides {a.stride()}")
    return wrong, len(found), sum(tensor.numel() for tensor in found.values())


def main(arguments):
    if len(arguments) == 2:
        pairs = [(arguments[0], arguments[1], ())]
    elif len(arguments) == 1:
        folder = arguments[0]
        with open(os.path.join(folder, "pairs.tsv"), encoding="utf-8") as lines:
            rows = sorted({line.rstrip("\n") for line in lines})
        split = (row.split("\t") for row in rows)
        pairs = [(os.path.join(folder, ours), theirs, tuple(without)) for ours, theirs, *without in split]
    else:
        sys.exit(__doc__)
    if not pairs:
        sys.exit("nothing to compare")
    failed = False
    for ours, theirs, without in pairs:
        wrong, count, numbers = compare(ours, theirs, without)
        if not count:
            wrong.append("it holds no tensor")
        failed |= bool(wrong)
        print(f"{ours}: {count} tensors, {numbers} numbers: {'; '.join(wrong[:10]) or 'the same as ' + theirs}")
    print(f"torch {torch.__version__}, {len(pairs)} files")
    sys.exit(failed)


if __name__ == "__main__":
    main(sys.argv[1:])
